"""Error of a rigid-body model over a cardiac cycle known from two views.

The single view cannot show this error: a heart that contracts looks like a heart that moves away from the source. The
electrodes at their wrong places then agree with the pixels within noise.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from fluoromap.contracts import SiteCycle
from fluoromap.geometry import Camera
from fluoromap.monoplane.body_pose import determines_pose, solve_poses

_ITERATIONS = 20
_LONGEST_GAP = 0.25
"""Longest gap between moments, as a share of the cycle; systole may lie in a longer one."""


def rigid_error_mm(camera: Camera, cycle: SiteCycle, labels: Collection[tuple[str, int]]) -> float | None:
    """Return the RMS 3D error of rigid poses in one view.

    Two views know the cycle that it is measured over.

    Parameters
    ----------
    labels : collection of (catheter, electrode)
        The electrodes of the body; electrodes that the cycle lacks are left out.

    Returns
    -------
    float or None
        Millimetres, over all electrodes and all phases after the first; the first phase gives the body's shape. None where
        the cycle has fewer than two phases or too few electrodes for a pose.
    """
    points = cycle.positions_mm[:, [label in labels for label in cycle.labels]]
    if len(points) < 2 or not determines_pose(points[0]):
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


def covers_body(cycle: SiteCycle, labels: Collection[tuple[str, int]]) -> bool:
    """Return whether a cycle contains all electrodes and no long gap.

    Only such a cycle can show that the electrodes keep their distances.
    """
    if not len(cycle.phases) or not set(labels) <= set(cycle.labels):
        return False
    gaps = np.diff(cycle.phases, append=cycle.phases[0] + 1.0)
    return bool(gaps.max() <= _LONGEST_GAP)
