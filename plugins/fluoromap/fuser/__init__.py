"""Fusers: the chamber's surface and activation map from located sites and their times."""
