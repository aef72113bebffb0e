"""Pictures of electrodes: what a ray crosses, against volumes and symmetry."""

import math

import numpy as np
import pytest

from fluoromap.segmenter.places.cylinder_pictures import STEP_PX, draw_electrode, half_length_px

HALF, RADIUS = 3.0, 6.0


def picture(cosine, inner=0.86, is_tip=False, half=HALF):
    seen = np.zeros((101, 31))
    draw_electrode(seen, half, RADIUS, inner, is_tip, cosine)
    return seen


@pytest.mark.parametrize("cosine", [0.15, 0.4, 0.7, 0.95])
@pytest.mark.parametrize("inner", [0.0, 0.86])
def test_all_rays_together_cross_the_volume_of_the_metal(cosine, inner):
    volume = 2 * HALF * math.pi * RADIUS**2 * (1.0 - inner**2)
    # Four rays a pixel are few for a thin wall.
    assert picture(cosine, inner).sum() * STEP_PX == pytest.approx(volume, rel=0.04)


@pytest.mark.parametrize("cosine", [0.3, 0.8])
def test_a_ring_looks_the_same_from_both_ends_and_sides(cosine):
    seen = picture(cosine)
    assert np.allclose(seen, seen[::-1])
    assert np.allclose(seen, seen[:, ::-1])


def test_a_ring_that_is_seen_obliquely_is_bright_in_its_middle_and_as_long_as_its_openings():
    cosine = 0.4
    seen = picture(cosine)[:, 15]
    dark = int(seen[51:].argmax()) + 1
    assert seen[50] < 0.5 * seen[50 + dark]
    shown = np.flatnonzero(seen > 0.02 * seen.max())
    expected = float(half_length_px(np.array([HALF]), RADIUS, np.array([cosine]))[0])
    assert 0.5 * np.ptp(shown) * STEP_PX == pytest.approx(expected, abs=1.0)


def test_from_the_side_a_ring_is_a_band():
    seen = picture(1.0)[:, 15]
    shown = np.flatnonzero(seen > 0.5 * seen.max())
    assert 0.5 * np.ptp(shown) * STEP_PX == pytest.approx(HALF, abs=0.6)


def test_a_tip_is_dark_in_its_middle_and_narrows_towards_its_dome():
    seen = picture(0.9, is_tip=True, half=12.0)
    width = np.count_nonzero(seen > 0.05 * seen.max(), axis=1)
    shown = np.flatnonzero(width)
    assert seen[50, 15] > 0.8 * seen.max()
    assert width[shown[0] + 1] < 0.7 * width[50]
    assert abs(0.5 * (shown[0] + shown[-1]) - 50) < 4.0
