"""Fixtures of the science: maps for several tests, made once a process."""

from __future__ import annotations

import pytest
from chambers import fused, sphere
from hypothesis import settings

from fluoromap.contracts import ChamberMap

# Property tests of the science are about truth, not about how fast the machine is.
settings.register_profile("science", deadline=None)
settings.load_profile("science")


@pytest.fixture(scope="session")
def ball() -> ChamberMap:
    """Return 40 sites on a sphere of 25 mm about (10, -20, 5), a plane wave of 1 ms/mm along X, -25 to 25 ms."""
    return fused(sphere(40), edge_mm=4)


@pytest.fixture(scope="session")
def sparse_ball() -> ChamberMap:
    """Return 10 sites on the same sphere, which leave part of it uncovered."""
    return fused(sphere(10), fill_mm=10.0)
