"""Whether electrodes that two views saw move over a cardiac cycle would pass for one rigid body in a single view.

The image itself does not tell: a heart that contracts looks like one that moves away from the source, and the electrodes fit
their wrong places within the pixel noise.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from fluoromap.contracts import SiteCycle
from fluoromap.geometry import Camera
from fluoromap.monoplane.body_pose import solve_poses, spans

_ITERATIONS = 20
_LONGEST_GAP = 0.25
"""Of the cycle between moments that were seen, above which systole may lie in it."""


def rigid_error_mm(camera: Camera, cycle: SiteCycle, labels: Collection[tuple[str, int]]) -> float | None:
    """RMS 3D error that rigid poses in one view would have over a cycle known from two views.

    Parameters
    ----------
    labels : collection of (catheter, electrode)
        The electrodes that make up the body; those the cycle does not hold are left out.

    Returns
    -------
    float or None
        Millimetres, over all electrodes and the phases after the first, whose positions are taken for the body's shape;
        None where the cycle has fewer than two phases or too few electrodes for a pose.
    """
    points = cycle.positions_mm[:, [label in labels for label in cycle.labels]]
    if len(points) < 2 or not spans(points[0]):
        return None
    batch = len(points) - 1
    centre = points[0].mean(axis=0)
    model = points[0] - centre
    rotations, centres = solve_poses(
        camera,
        model,
        camera.project(points[1:]),
        np.broadcast_to(np.eye(3), (batch, 3, 3)),
        np.broadcast_to(centre, (batch, 3)),
        _ITERATIONS,
    )
    errors = model @ np.swapaxes(rotations, 1, 2) + centres[:, None] - points[1:]
    return float(np.sqrt((errors**2).sum(axis=2).mean()))


def tells_of_body(cycle: SiteCycle, labels: Collection[tuple[str, int]]) -> bool:
    """Whether a cycle can show that electrodes keep their distances: it holds all of them, and no large part of it is missing."""
    if not len(cycle.phases) or not set(labels) <= set(cycle.labels):
        return False
    gaps = np.diff(cycle.phases, append=cycle.phases[0] + 1.0)
    return bool(gaps.max() <= _LONGEST_GAP)
