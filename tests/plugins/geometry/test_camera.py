"""Cameras and projections against formulas written out on their own."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from fluoromap.geometry import LEAST_SOURCE_MM, Camera, Gantry, camera_from_gantry, ray_angle_deg, view_axes

angles = st.floats(-179, 179)
tilts = st.floats(-89, 89)
coordinates = st.floats(-80, 80)
points = st.tuples(coordinates, coordinates, coordinates).map(np.array)


def gantry(primary: float = 0.0, secondary: float = 0.0, **changes: object) -> Gantry:
    values: dict[str, object] = {
        "primary_deg": primary, "secondary_deg": secondary, "source_detector_mm": 1000.0, "source_isocentre_mm": 500.0,
        "pixel_spacing_mm": (178 / 512, 178 / 512), "rows": 512, "columns": 512,
    }  # fmt: skip
    return Gantry(**{**values, **changes})  # type: ignore[arg-type]


def pixel_by_hand(g: Gantry, point: np.ndarray) -> tuple[float, float]:
    """Turn the patient under a frontal C-arm, then divide by depth.

    A real C-arm turns round the patient instead.
    """
    a, b = math.radians(g.primary_deg), math.radians(g.secondary_deg)
    x, y, z = (float(value) for value in point)
    # Undo the primary turn about the patient's long axis, then the secondary about the patient's left-right axis.
    x, y = x * math.cos(a) + y * math.sin(a), -x * math.sin(a) + y * math.cos(a)
    y, z = y * math.cos(b) - z * math.sin(b), y * math.sin(b) + z * math.cos(b)
    # A frontal C-arm: source behind the patient (+Y), detector in front; left on the right, head at the top.
    magnification = g.source_detector_mm / (g.source_isocentre_mm - y)
    row_mm, column_mm = g.pixel_spacing_mm
    return (g.columns - 1) / 2 + magnification * x / column_mm, (g.rows - 1) / 2 - magnification * z / row_mm


@given(angles, tilts, points)
def test_equation_1_agrees_with_turning_the_patient_instead(a: float, b: float, point: np.ndarray) -> None:
    g = gantry(a, b, pixel_spacing_mm=(0.3, 0.4), rows=400, columns=600)
    assert camera_from_gantry(g).project(point) == pytest.approx(pixel_by_hand(g, point), abs=1e-8)


@given(angles, tilts)
def test_view_axes_are_left_handed_unit_vectors(a: float, b: float) -> None:
    axes = view_axes(a, b)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(-1.0)
    np.testing.assert_allclose(camera_from_gantry(gantry(a, b)).axis_world, axes[2], atol=1e-12)


def test_a_source_nearer_than_any_c_arm_s_is_refused() -> None:
    assert gantry(source_isocentre_mm=LEAST_SOURCE_MM).source_isocentre_mm == 200.0
    with pytest.raises(ValueError, match="source distances are 199 mm"):
        gantry(source_isocentre_mm=199.0)


def test_frontal_view_shows_the_left_on_the_right_and_the_head_at_the_top() -> None:
    camera = camera_from_gantry(gantry())
    u, v = camera.project([10.0, 0.0, 20.0])
    assert u > 255.5
    assert v < 255.5


@pytest.mark.parametrize(
    ("primary", "secondary", "detector"),
    [
        (0, 0, (0, -1, 0)),  # in front of the patient
        (90, 0, (1, 0, 0)),  # LAO 90: at the patient's left
        (-90, 0, (-1, 0, 0)),  # RAO 90: at the patient's right
        (0, 90, (0, 0, 1)),  # cranial 90: at the head
        (0, -45, (0, -math.sqrt(0.5), -math.sqrt(0.5))),  # caudal: towards the feet
    ],
)
def test_the_detector_is_where_the_angles_say(
    primary: float, secondary: float, detector: tuple[float, float, float]
) -> None:
    camera = camera_from_gantry(gantry(primary, secondary))
    assert camera.axis_world == pytest.approx(detector, abs=1e-12)
    assert camera.source_world_mm == pytest.approx(-500 * np.array(detector), abs=1e-9)


@given(angles, tilts)
def test_rotation_block_is_left_handed_with_determinant_minus_one(a: float, b: float) -> None:
    camera = camera_from_gantry(gantry(a, b))
    principal = camera.principal_point_uv
    assert principal == pytest.approx([255.5, 255.5])
    rotation = camera.matrix[:, :3].copy()
    rotation[:2] -= principal[:, None] * rotation[2]
    rotation[:2] /= 1000 / (178 / 512)
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(-1)


def test_isocentre_scale_is_magnification_over_pixel_spacing() -> None:
    assert camera_from_gantry(gantry(30, 10)).px_per_mm == pytest.approx(2 * 512 / 178)


@given(angles, tilts, points)
def test_equation_2_knows_no_depth(a: float, b: float, point: np.ndarray) -> None:
    camera = camera_from_gantry(gantry(a, b))
    along = camera.axis_world
    pixel = camera.project_parallel(point)
    assert camera.project_parallel(point + 37 * along) == pytest.approx(pixel, abs=1e-8)
    in_the_isocentre_plane = point - along * (along @ point)
    assert pixel == pytest.approx(camera.project(in_the_isocentre_plane), abs=1e-8)


@given(angles, tilts, st.lists(points, min_size=2, max_size=6))
def test_equation_3_uses_the_depth_of_the_centroid(a: float, b: float, cloud: list[np.ndarray]) -> None:
    camera = camera_from_gantry(gantry(a, b))
    array = np.array(cloud)
    weak = camera.project_weak(array)
    along = camera.axis_world
    flattened = array - ((array - array.mean(axis=0)) @ along)[:, None] * along
    assert weak == pytest.approx(camera.project(flattened), abs=1e-8)


@pytest.mark.parametrize(
    ("axes", "turned"),
    [
        (((-1, 0), (0, 1)), lambda u, v: (-u, v)),
        (((1, 0), (0, -1)), lambda u, v: (u, -v)),
        (((0, 1), (-1, 0)), lambda u, v: (v, -u)),
    ],
)
def test_flips_and_turns_of_the_stored_image_go_into_the_camera(axes: object, turned: object) -> None:
    upright, stored = camera_from_gantry(gantry(20, 10)), camera_from_gantry(gantry(20, 10, image_axes=axes))
    point = np.array([12.0, -7.0, 30.0])
    offset = upright.project(point) - 255.5
    assert stored.project(point) - 255.5 == pytest.approx(turned(*offset))  # type: ignore[operator]


@given(angles, tilts, points)
def test_jacobian_is_the_derivative_of_the_projection(a: float, b: float, point: np.ndarray) -> None:
    camera = camera_from_gantry(gantry(a, b))
    step = 1e-4
    slopes = [(camera.project(point + step * e) - camera.project(point - step * e)) / (2 * step) for e in np.eye(3)]
    assert camera.jacobian(point) == pytest.approx(np.array(slopes).T, abs=1e-5)


@given(angles, tilts, points)
def test_back_projection_at_the_right_depth_returns_the_point(a: float, b: float, point: np.ndarray) -> None:
    camera = camera_from_gantry(gantry(a, b))
    assert camera.back_project(camera.project(point), camera.depth_mm(point)) == pytest.approx(point, abs=1e-8)


@given(angles, tilts, points, points)
def test_translated_camera_sees_shifted_points_where_they_were(
    a: float, b: float, point: np.ndarray, shift: np.ndarray
) -> None:
    camera = camera_from_gantry(gantry(a, b))
    assert camera.translated(shift).project(point - shift) == pytest.approx(camera.project(point), abs=1e-7)


@given(angles, angles)
def test_ray_angle_is_folded_to_ninety_degrees(a: float, b: float) -> None:
    apart = abs(a - b) % 180
    assume(0.1 < apart < 179.9)
    angle = ray_angle_deg(camera_from_gantry(gantry(a)), camera_from_gantry(gantry(b)))
    assert angle == pytest.approx(min(apart, 180 - apart), abs=1e-5)


@pytest.mark.parametrize(
    "changes",
    [
        {"primary_deg": 181.0}, {"secondary_deg": float("nan")}, {"source_isocentre_mm": 1000.0},
        {"source_isocentre_mm": 50.0}, {"pixel_spacing_mm": (0.0, 0.3)}, {"rows": 0}, {"image_axes": ((1, 0), (1, 0))},
        {"image_axes": ((1, 1), (0, 1))}, {"image_axes": ((2, 1), (1, 1))},
    ],
)  # fmt: skip
def test_impossible_gantries_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(ValueError):
        gantry(**changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("matrix", [np.zeros((3, 4)), np.ones((3, 3)), np.full((3, 4), np.nan)])
def test_a_matrix_without_a_centre_of_projection_is_refused(matrix: np.ndarray) -> None:
    with pytest.raises(ValueError):
        Camera(matrix, 512, 512)


def test_scale_of_the_matrix_does_not_matter() -> None:
    camera = camera_from_gantry(gantry(40, -20))
    assert Camera(3.5 * camera.matrix, 512, 512).matrix == pytest.approx(camera.matrix)
