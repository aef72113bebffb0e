"""The fit of cylinders, on a loop whose rings are all seen from different sides."""

import numpy as np
import pytest

from fluoromap.catheters import catheter_type
from fluoromap.segmenter.places.cylinder_fit import fit_cylinders

PX_PER_MM = 4.0


def ring_picture(places_uv, axes, shape=(160, 160)):
    """Return a log image of thin rings.

    Points on their walls are projected. ``places_uv`` : middles. ``axes`` : of the rings, in space.
    """
    random = np.random.default_rng(1)
    image = np.zeros(shape)
    for place, axis in zip(places_uv, axes, strict=True):
        side = np.cross(axis, [0.3, 0.5, 0.8])
        side /= np.linalg.norm(side)
        other = np.cross(axis, side)
        angle, along = random.uniform(0.0, 2 * np.pi, 40_000), random.uniform(-0.5, 0.5, 40_000)
        wall = np.outer(np.cos(angle), side) + np.outer(np.sin(angle), other) + np.outer(along, axis)
        u, v = (place[way] + PX_PER_MM * wall[:, way] for way in range(2))
        seen, _, _ = np.histogram2d(v, u, bins=[np.arange(size + 1) - 0.5 for size in shape])
        image -= seen
    return (0.6 * image / -image.min() + random.normal(0.0, 0.01, shape)).astype(np.float32)


@pytest.mark.parametrize("tilt_rad", [0.5, 0.9])
def test_rings_on_a_loop_are_found_although_each_is_seen_from_another_side(tilt_rad):
    catheter = catheter_type("circular-10", "loop")
    angles = catheter.angles_on_loop_rad
    radius_mm = 1.0 / catheter.curvature_per_mm
    squeeze = np.array([1.0, np.cos(tilt_rad)])
    places = 80.0 + PX_PER_MM * radius_mm * np.stack([np.cos(angles), np.sin(angles)], axis=1) * squeeze
    tangents = np.stack([-np.sin(angles), np.cos(angles) * np.cos(tilt_rad), np.cos(angles) * np.sin(tilt_rad)], axis=1)
    image = ring_picture(places, tangents)
    random = np.random.default_rng(2)
    steps = np.gradient(places, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    wrong = places + random.uniform(-0.5, 0.5, (10, 1)) * PX_PER_MM * steps
    fit = fit_cylinders(image, wrong, catheter, PX_PER_MM, 1.0, np.zeros(10, np.bool_))
    before, after = (
        np.sqrt(((found - places) ** 2).sum(axis=1).mean()) / PX_PER_MM for found in (wrong, fit.points_uv)
    )
    assert after < 0.6 * before
    assert fit.log_likelihood > 0.0


@pytest.mark.parametrize("stays", [False, True])
def test_an_image_without_anything_moves_no_electrode_for_its_sake(stays):
    catheter = catheter_type("quadripolar-2-5-2", "rv")
    places = 60.0 + 0.7 * PX_PER_MM * np.stack([catheter.arc_lengths_mm, np.zeros(4)], axis=1)
    fit = fit_cylinders(np.ones((120, 160), np.float32), places, catheter, PX_PER_MM, 1.0, np.full(4, stays))
    assert fit.log_likelihood == pytest.approx(0.0)
    # Places are searched in steps of half a pixel.
    assert np.abs(fit.points_uv - places).max() < (1e-9 if stays else 1.5)
