"""The paper's simulation against the paper and against plain arithmetic."""

import numpy as np
import pytest

from fluoromap.paper.tables.helix import HELICES, helix_camera, motion_mm, next_points_mm


def test_equation_11_turns_about_x_then_y_then_z_and_shifts() -> None:
    c, s = np.cos(np.radians(0.5)), np.sin(np.radians(0.5))
    x, y, z = 30.0, -20.0, 10.0
    y, z = c * y - s * z, s * y + c * z
    x, z = c * x + s * z, -s * x + c * z
    x, y = c * x - s * y, s * x + c * y
    assert next_points_mm(np.array([[30.0, -20.0, 10.0]]))[0] == pytest.approx([x + 1, y + 1, z + 1], abs=1e-12)


@pytest.mark.parametrize("name", ["H77", "H18"])
def test_the_motion_is_rigid_and_applied_again_from_image_to_image(name: str) -> None:
    points = motion_mm(HELICES[name], 5)  # type: ignore[index]
    assert points.shape == (5, 30, 3)
    apart = np.linalg.norm(points[:, :, None] - points[:, None], axis=3)
    assert apart == pytest.approx(np.broadcast_to(apart[0], apart.shape), abs=1e-9)
    assert next_points_mm(points[3]) == pytest.approx(points[4])


def test_a_helix_lies_on_its_cylinder_and_winds_twice() -> None:
    helix = HELICES["H18"]
    points = helix.points_mm() - helix.centre_mm
    assert np.hypot(points[:, 2], points[:, 0]) == pytest.approx(18.0)
    assert (points[0, 1], points[-1, 1]) == pytest.approx((-30.0, 30.0))
    angle = np.unwrap(np.arctan2(points[:, 0], points[:, 2]))
    assert angle[-1] - angle[0] == pytest.approx(4 * np.pi)


def test_displacements_in_the_image_are_the_paper_s() -> None:
    """Check signs of the mean displacement, which show the views' directions, and its size, to which H77 was fitted."""
    points = motion_mm(HELICES["H77"], 6)
    for view, mean in (("AP", (4.97, 7.12)), ("LAT", (-6.82, -6.03))):
        pixels = helix_camera(view).project(points)  # type: ignore[arg-type]
        assert np.diff(pixels, axis=0).mean(axis=(0, 1)) == pytest.approx(mean, abs=0.7)
