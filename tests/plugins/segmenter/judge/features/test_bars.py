"""Chains on rows of parallel bars, on drawn pictures."""

import numpy as np
import pytest

from fluoromap.segmenter.judge.features.bars import ACROSS_MM, follows_bars, has_other_wall, products_beside
from fluoromap.segmenter.picture.shaft_image import ShaftImage

PX = 3.2
START = np.array([120.0, 40.0])
ALONG_MM = np.array([0.0, 4.4, 8.8, 13.2])
ON_BARS = START + np.outer(ALONG_MM * PX, [0.0, 1.0])
PAIR = np.array([0.0, 0.9 * PX])
V, U = np.mgrid[:160, :240].astype(np.float64)


def shafts(dark, reduction=1, noise=0.0):
    """Return the image in which ``dark`` (rows, columns) is taken from bright surroundings, with noise."""
    image = 6.0 - dark + np.random.default_rng(3).normal(0.0, noise, dark.shape)
    image = image.reshape(160 // reduction, reduction, 240 // reduction, reduction).mean(axis=(1, 3))
    return ShaftImage(image.astype(np.float32), reduction, 0.1, PX)


def on_bars(chain_uv, shaft_image):
    return follows_bars(products_beside(chain_uv, shaft_image))


def bars(left_mm, right_mm, ends=1.0, count=4, depth=0.3):
    """Draw bars at the chain's places, to both sides of it.

    Each is 3.2 mm thick, and its ends are darker by the factor ``ends``.
    """
    beside = (U - START[0]) / PX
    within = (beside > -left_mm) & (beside < right_mm)
    near = np.min([np.abs(V - v) for v in ON_BARS[:count, 1]], axis=0) < 1.6 * PX
    is_end = (beside < 1.0 - left_mm) | (beside > right_mm - 1.0)
    return depth * (near & within) * np.where(is_end, ends, 1.0)


def rings(points=ON_BARS, depth=0.3):
    return depth * (np.min([np.hypot(U - u, V - v) for u, v in points], axis=0) < 1.1 * PX)


@pytest.mark.parametrize("reduction", [1, 2])
@pytest.mark.parametrize(("left_mm", "right_mm"), [(1.0, 8.0), (8.0, 1.0), (4.5, 4.5)])
def test_ends_and_middles_of_bars_are_no_electrodes(left_mm, right_mm, reduction):
    assert on_bars(ON_BARS, shafts(bars(left_mm, right_mm, ends=2.0), reduction))


def test_bars_may_show_two_places_each_and_noise():
    pairs = np.sort(np.concatenate([ON_BARS - PAIR, ON_BARS + PAIR]), axis=0)
    assert on_bars(pairs, shafts(bars(1.0, 8.0), noise=0.03))


def test_bars_in_strong_noise_are_no_electrodes():
    assert on_bars(ON_BARS, shafts(bars(1.0, 8.0, ends=2.0), noise=0.15))


def test_three_of_four_electrodes_are_enough_and_two_are_not():
    assert on_bars(ON_BARS, shafts(bars(1.0, 8.0, count=3) + rings(ON_BARS[3:])))
    assert not on_bars(ON_BARS, shafts(bars(1.0, 8.0, count=2) + rings(ON_BARS[2:])))


@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_rings_of_a_catheter_are_no_bars(noise):
    assert not on_bars(ON_BARS, shafts(rings(), noise=noise))


@pytest.mark.parametrize("beside_mm", [2.5, 3.0, 3.5, 5.0])
def test_a_catheter_beside_another_one_is_no_row_of_bars(beside_mm):
    assert not on_bars(ON_BARS, shafts(rings() + rings(ON_BARS + np.array([beside_mm * PX, 0.0]))))


def test_a_shaft_along_a_catheter_is_no_row_of_bars():
    assert not on_bars(ON_BARS, shafts(rings() + 0.3 * (np.abs(U - START[0] - 3.0 * PX) < 1.2 * PX)))


@pytest.mark.parametrize("electrode", range(4))
def test_a_cable_across_a_catheter_is_no_row_of_bars(electrode):
    assert not on_bars(ON_BARS, shafts(rings() + 0.4 * (np.abs(V - ON_BARS[electrode, 1]) < PX)))


def test_a_catheter_over_an_edge_of_the_spine_is_no_row_of_bars():
    assert not on_bars(ON_BARS, shafts(rings() + 0.5 * (ON_BARS[1, 1] + 4.0 < V)))


def test_faint_rings_where_anatomy_darkens_evenly_are_no_bars():
    assert not on_bars(ON_BARS, shafts(rings(depth=0.05) + 0.1 * V / PX))


def test_an_even_image_shows_no_bars():
    assert not on_bars(ON_BARS, shafts(np.zeros(U.shape)))


def test_electrodes_at_one_place_have_an_answer():
    assert not on_bars(np.repeat(ON_BARS[:1], 4, axis=0), shafts(rings()))


def other_wall(shaft_image):
    return has_other_wall(products_beside(ON_BARS, shaft_image, ACROSS_MM))


@pytest.mark.parametrize("wide_mm", [7.0, 9.0])
def test_ends_of_bars_have_an_other_wall(wide_mm):
    beside = (U - START[0]) / PX
    is_end = (np.abs(beside) < 1.0) | (np.abs(beside - wide_mm) < 1.0)
    near = np.min([np.abs(V - v) for v in ON_BARS[:, 1]], axis=0) < PX
    assert other_wall(shafts(0.3 * (near & is_end), noise=0.05))


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_a_catheter_has_no_other_wall(noise):
    assert not other_wall(shafts(rings(), noise=noise))
    uneven = START + np.outer([0.0, 2.5, 9.0, 11.5], [0.0, PX]) + np.array([8.0 * PX, 6.0])
    assert not other_wall(shafts(rings() + rings(uneven), noise=noise))


@pytest.mark.parametrize("electrode", range(4))
def test_a_cable_across_a_catheter_is_no_other_wall(electrode):
    assert not other_wall(shafts(rings() + 0.4 * (np.abs(V - ON_BARS[electrode, 1]) < PX)))
