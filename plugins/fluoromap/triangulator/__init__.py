"""Electrodes in 3D from two views."""
