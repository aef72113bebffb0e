"""Monoplane solvers: electrodes tracked in 3D through one view."""
