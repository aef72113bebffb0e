"""The place of the map on a frame: it follows the reference catheter, and the star marks the tip."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fluoromap.contracts import Array, ElectrodePoint, LocatedSite, NamedChain
from fluoromap.drawing.map_placement import displacement_mm, map_shift_mm, tip_pixel
from fluoromap.geometry import Camera, Gantry, camera_from_gantry

FRONTAL = camera_from_gantry(Gantry(0.0, 0.0, 1000.0, 700.0, (0.3, 0.3), 512, 512))
LATERAL = camera_from_gantry(Gantry(90.0, 0.0, 1000.0, 700.0, (0.3, 0.3), 512, 512))
REFERENCE_MM = np.array([[10.0, 20.0, 30.0], [12.0, 22.0, 26.0]])
MEAN_MM = REFERENCE_MM.mean(axis=0)
TIP_MM = np.array([-15.0, 5.0, 8.0])


def _point(catheter: str, electrode: int, position_mm: Array, relative_mm: Array | None) -> ElectrodePoint:
    covariance = None if relative_mm is None else np.eye(3)
    return ElectrodePoint(catheter, electrode, position_mm, np.eye(3), relative_mm, covariance, (0.1, 0.1), 90.0)


SITE = LocatedSite(
    "S01",
    FRONTAL,
    LATERAL,
    frame_a=4,
    frame_b=7,
    points=(
        _point("mapping", 1, TIP_MM, TIP_MM - MEAN_MM),
        *(_point("reference", number, at, at - MEAN_MM) for number, at in enumerate(REFERENCE_MM, start=1)),
    ),
    reference_mm=MEAN_MM,
    cycle=None,
)


def _shown(camera: Camera, displacement_mm: Array, electrodes: tuple[int, ...] = (1, 2)) -> NamedChain:
    """Return the reference catheter as a camera shows it after a displacement."""
    rows = [number - 1 for number in electrodes]
    pixels = camera.project(REFERENCE_MM[rows] + displacement_mm)
    return NamedChain("reference", electrodes, pixels, np.tile(np.eye(2), (len(rows), 1, 1)))


@pytest.mark.parametrize(("camera", "hidden_axis"), [(FRONTAL, 1), (LATERAL, 0)])
def test_a_view_shows_displacements_across_its_rays_only(camera: Camera, hidden_axis: int) -> None:
    displacement = np.array([1.5, -2.0, 1.0])
    found = displacement_mm(SITE, camera, _shown(camera, displacement))
    across = [axis for axis in range(3) if axis != hidden_axis]
    np.testing.assert_allclose(found[across], displacement[across], atol=0.15)
    assert abs(found[hidden_axis]) < 0.15
    assert np.linalg.norm(found) <= np.linalg.norm(displacement)


def test_electrodes_without_a_position_give_no_displacement() -> None:
    stranger = NamedChain("reference", (3,), np.array([[7.0, 7.0]]), np.eye(2)[None])
    np.testing.assert_array_equal(displacement_mm(SITE, FRONTAL, stranger), 0)
    both = _shown(FRONTAL, np.array([0.0, 0.0, 3.0]), (2,))
    np.testing.assert_allclose(displacement_mm(SITE, FRONTAL, both)[2], 3.0, atol=0.15)


def test_the_shift_is_the_first_position_that_exists() -> None:
    tracked, mean = np.array([1.0, 2.0, 3.0]), np.array([9.0, 9.0, 9.0])
    shown = _shown(FRONTAL, np.array([0.0, 0.0, 3.0]))
    np.testing.assert_array_equal(map_shift_mm(SITE, FRONTAL, shown, tracked, mean), tracked)
    expected = MEAN_MM + displacement_mm(SITE, FRONTAL, shown)
    np.testing.assert_array_equal(map_shift_mm(SITE, FRONTAL, shown, None, mean), expected)
    np.testing.assert_array_equal(map_shift_mm(SITE, FRONTAL, None, None, mean), MEAN_MM)
    lost = replace(SITE, reference_mm=None)
    np.testing.assert_array_equal(map_shift_mm(lost, FRONTAL, shown, None, mean), mean)


def test_the_tip_is_where_the_frame_shows_it_else_where_the_map_has_it() -> None:
    shift = MEAN_MM + np.array([0.0, 0.0, 3.0])
    shown = NamedChain("mapping", (1, 2), np.array([[100.0, 50.0], [110.0, 60.0]]), np.tile(np.eye(2), (2, 1, 1)))
    np.testing.assert_array_equal(tip_pixel(SITE, FRONTAL, "mapping", shown, shift), [100.0, 50.0])
    without_tip = NamedChain("mapping", (2,), np.array([[110.0, 60.0]]), np.eye(2)[None])
    on_the_map = FRONTAL.project(TIP_MM + np.array([0.0, 0.0, 3.0]))
    for chain in (None, without_tip):
        np.testing.assert_allclose(tip_pixel(SITE, FRONTAL, "mapping", chain, shift), on_the_map)
    absolute = replace(SITE, points=(_point("mapping", 1, TIP_MM, None),), reference_mm=None)
    np.testing.assert_allclose(tip_pixel(absolute, FRONTAL, "mapping", None, shift), FRONTAL.project(TIP_MM))
    assert tip_pixel(SITE, FRONTAL, "pacing", None, shift) is None


def test_a_site_gives_camera_and_diastolic_frame_of_each_view() -> None:
    assert (SITE.camera("a"), SITE.diastolic_frame("a")) == (FRONTAL, 4)
    assert (SITE.camera("b"), SITE.diastolic_frame("b")) == (LATERAL, 7)
