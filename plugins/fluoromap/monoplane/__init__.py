"""Electrodes in 3D through one view."""
