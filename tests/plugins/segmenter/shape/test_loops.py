"""Loops of circular catheters as images of circles: their shape, and the search for them."""

import numpy as np
import pytest

from fluoromap.catheters import Catalogue, catheter_type
from fluoromap.segmenter.chains.families import catheter_families
from fluoromap.segmenter.chains.path_search import find_paths
from fluoromap.segmenter.shape.loops import loop_fit, off_ellipse
from fluoromap.segmenter.shape.spacings import searched_spacing_px

PX = 3.2
LOOPS = ["circular-10", "circular-20", "circular-20-2-6-2"]


def image_of(loop, axes=1.0, turn_deg=0.0, size=1.0):
    """Return the electrodes of a loop that is seen as an ellipse.

    They are pixels; ``axes`` is the ratio of the axes.
    """
    angles = loop.angles_on_loop_rad + np.deg2rad(turn_deg)
    radius = size * PX / loop.curvature_per_mm
    return 120.0 + radius * np.stack([np.cos(angles), axes * np.sin(angles)], axis=1)


def straight(catheter, ratio=0.95):
    return 40.0 + np.outer(catheter.arc_lengths_mm * PX * ratio, [np.cos(0.3), np.sin(0.3)])


def fit_of(catheter, places):
    spacing_px = np.array(catheter.spacing_mm) * PX
    return float(loop_fit(places[None], spacing_px, catheter.curvature_per_mm, PX)[0])


@pytest.mark.parametrize("name", LOOPS)
@pytest.mark.parametrize("turn_deg", [0.0, 50.0])
@pytest.mark.parametrize("axes", [1.0, 0.7, 0.45])
def test_a_circle_from_any_side_fits_a_loop_and_a_straight_row_does_not(name, axes, turn_deg):
    loop = catheter_type(name, "loop")
    places = image_of(loop, axes, turn_deg)
    assert fit_of(loop, places) > 1.5
    assert fit_of(loop, places) == pytest.approx(fit_of(loop, places[:, ::-1]))
    assert fit_of(loop, straight(loop)) < -5.0


def test_a_straight_catheter_has_no_loop():
    catheter = catheter_type("decapolar-5-5-5", "cs")
    assert catheter.curvature_per_mm == 0.0
    assert catheter.angles_on_loop_rad is None
    assert fit_of(catheter, straight(catheter)) == 0.0


def test_a_loop_and_a_straight_catheter_of_the_same_spacings_do_not_look_alike():
    loop, row = catheter_type("circular-10", "loop"), catheter_type("decapolar-5-5-5", "cs")
    assert not loop.looks_like(row)
    assert len(catheter_families(Catalogue((row, loop), "cs", "loop"))) == 2


@pytest.mark.parametrize("name", LOOPS)
def test_every_affine_image_of_a_circle_is_an_ellipse(name):
    rng = np.random.default_rng(4)
    loop = catheter_type(name, "loop")
    places = image_of(loop) @ rng.normal(size=(5, 2, 2)) + rng.normal(size=(5, 1, 2))
    assert np.allclose(off_ellipse(places, loop.angles_on_loop_rad), 0.0, atol=1e-6)
    assert np.all(off_ellipse(places + rng.normal(0.0, 2.0, places.shape), loop.angles_on_loop_rad) > 1.0)


@pytest.mark.parametrize("size", [0.8, 1.25])
def test_the_search_finds_a_loop_of_another_size_among_many_candidates(size):
    rng = np.random.default_rng(7)
    loop = catheter_type("circular-10", "loop")
    places = image_of(loop, 0.8, 20.0, size)
    points = np.concatenate([places, rng.uniform(places.min(axis=0), places.max(axis=0), (30, 2))])
    weights = np.repeat([1.5, 0.5], [10, 30])
    spacing_px = searched_spacing_px(loop, PX)
    paths = find_paths(points, weights, spacing_px, PX, loop.angles_on_loop_rad)
    assert any((path == np.arange(10)).all() for path in paths)
    straight_px = np.array(catheter_type("decapolar-5-5-5", "cs").spacing_mm) * PX
    assert np.array_equal(searched_spacing_px(catheter_type("decapolar-5-5-5", "cs"), PX), straight_px)
