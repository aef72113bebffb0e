"""Dark lines that cross a chain, on drawn lines."""

import numpy as np
import pytest

from fluoromap.segmenter.judge.features.crossings import are_crossings
from fluoromap.segmenter.picture.shaft_image import ShaftImage

PX = 3.2
CHAIN = np.array([[60.0, 100.0], [80.0, 100.0], [110.0, 100.0], [130.0, 100.0]])
PLACE = np.array([[95.0, 100.0]])


def line(angle_deg, start_mm=-8.0, end_mm=8.0):
    along = np.linspace(start_mm * PX, end_mm * PX, 60)
    return PLACE[0] + np.outer(along, [np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))])


def drawn(*paths, reduction=1):
    """Draw dark lines, and the catheter with a faint shaft, into a bright log image."""
    v, u = np.mgrid[:200, :200].astype(np.float64)
    image = 6.0 - 0.1 * ((np.abs(v - 100.0) < 0.9 * PX) & (u > 60.0))
    for path in paths:
        image -= 0.2 * (np.min([np.hypot(u - x, v - y) for x, y in path], axis=0) < 0.8 * PX)
    image = image.reshape(200 // reduction, reduction, 200 // reduction, reduction).mean(axis=(1, 3))
    return ShaftImage(image.astype(np.float32), reduction, 0.1, PX)


@pytest.mark.parametrize("angle_deg", [45.0, 70.0, 90.0, 120.0, 135.0])
@pytest.mark.parametrize("reduction", [1, 2])
def test_a_line_through_the_chain_crosses_it_in_one_place(angle_deg, reduction):
    crossed = are_crossings(np.concatenate([PLACE, CHAIN]), CHAIN, drawn(line(angle_deg), reduction=reduction))
    assert crossed.tolist() == [True, False, False, False, False]


def test_the_catheter_itself_crosses_nothing():
    assert not are_crossings(np.concatenate([PLACE, CHAIN]), CHAIN, drawn()).any()


def test_a_line_that_ends_at_the_chain_does_not_cross_it():
    assert not are_crossings(PLACE, CHAIN, drawn(line(80.0, start_mm=0.0))).any()


def test_a_line_along_the_chain_does_not_cross_it():
    assert not are_crossings(PLACE, CHAIN, drawn(line(12.0))).any()


def test_a_corner_is_no_crossing():
    assert not are_crossings(PLACE, CHAIN, drawn(line(50.0, start_mm=0.0), line(130.0, end_mm=0.0))).any()


def test_no_points_have_no_crossings():
    assert are_crossings(np.zeros((0, 2)), CHAIN, drawn()).shape == (0,)


def test_a_line_far_beyond_the_chain_does_not_cross_it():
    far = CHAIN[-1] + np.array([[40.0, 0.0]])
    assert not are_crossings(far, CHAIN, drawn(line(90.0) + far - PLACE)).any()
    assert are_crossings(
        CHAIN[-1:] + 15.0 * np.eye(2)[:1], CHAIN, drawn(line(90.0) + CHAIN[-1] + [15.0, 0.0] - PLACE)
    ).all()
