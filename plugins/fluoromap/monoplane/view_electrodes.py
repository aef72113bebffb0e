"""One view's named chains as arrays over frames and electrodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array, BoolArray, ElectrodePoint, MonoplaneView, Refusal
from fluoromap.geometry import Camera
from fluoromap.reasons import Reason


@dataclass(frozen=True, eq=False)
class ViewElectrodes:
    """The m electrodes with an a-priori position in the n frames of one view.

    labels : (catheter, electrode). a_priori : their points from two views. visible : (n, m), True where the frame shows the
    electrode. pixels_uv : (n, m, 2), covariance_px2 : (n, m, 2, 2); 0 px and 1 px^2 where the electrode is hidden.
    phases : (n,), NaN where no cycle is known.
    """

    labels: tuple[tuple[str, int], ...]
    a_priori: tuple[ElectrodePoint, ...]
    visible: BoolArray
    pixels_uv: Array
    covariance_px2: Array
    phases: Array

    @property
    def a_priori_mm(self) -> Array:
        """World positions (m, 3) from two views, mm."""
        return np.array([point.position_mm for point in self.a_priori])

    @property
    def catheters(self) -> tuple[str, ...]:
        return tuple(catheter for catheter, _ in self.labels)

    def interrupted(self) -> tuple[bool, ...]:
        """Return for each electrode whether some frame does not show it."""
        return tuple(not bool(column.all()) for column in self.visible.T)


def gather_electrodes(view: MonoplaneView) -> ViewElectrodes:
    """Gather a view's observations of the electrodes with an a-priori position as arrays.

    Raises
    ------
    Refusal
        NO_A_PRIORI where no position is known from two views.
    """
    if not view.a_priori:
        raise Refusal(Reason.NO_A_PRIORI)
    labels = tuple((point.catheter, point.electrode) for point in view.a_priori)
    place = {label: index for index, label in enumerate(labels)}
    n, m = len(view.observations), len(labels)
    visible = np.zeros((n, m), dtype=np.bool_)
    pixels = np.zeros((n, m, 2))
    covariance = np.broadcast_to(np.eye(2), (n, m, 2, 2)).copy()
    phases = np.full(n, np.nan)
    for row, observation in enumerate(view.observations):
        if observation.phase is not None:
            phases[row] = observation.phase
        for chain in observation.chains:
            for k, electrode in enumerate(chain.electrodes):
                column = place.get((chain.catheter, electrode))
                if column is not None:
                    visible[row, column] = True
                    pixels[row, column] = chain.pixels_uv[k]
                    covariance[row, column] = chain.covariance_px2[k]
    return ViewElectrodes(labels, view.a_priori, visible, pixels, covariance, phases)


def outwards(frames: int, start: int) -> tuple[tuple[int, int], ...]:
    """Return (frame, previous frame) pairs on the way from the a-priori frame to both ends of the run."""
    forth = [(frame, frame - 1) for frame in range(start + 1, frames)]
    back = [(frame, frame + 1) for frame in range(start - 1, -1, -1)]
    return (*forth, *back)


def gantry_angle_covariance_mm2(points_world_mm: Array, angle_sd_deg: float) -> Array:
    """Return the covariance (..., 3, 3) of points (..., 3) from an error of the gantry's angles about any axis."""
    squares = (points_world_mm**2).sum(axis=-1)[..., None, None] * np.eye(3)
    outer = points_world_mm[..., :, None] * points_world_mm[..., None, :]
    covariance: Array = np.radians(angle_sd_deg) ** 2 * (squares - outer)
    return covariance


def isocentre_covariance_mm2(camera: Camera, sd_mm: float) -> Array:
    """Return the covariance (3, 3) that an error of the isocentre causes.

    The error is across the view's central ray.
    """
    covariance: Array = sd_mm**2 * (np.eye(3) - np.outer(camera.axis_world, camera.axis_world))
    return covariance


def lateral_covariance_mm2(jacobians: Array, covariance_px2: Array) -> Array:
    """Return pixel covariances (..., 2, 2) as covariances (..., 3, 3) across the rays.

    ``jacobians`` (..., 2, 3) are in px/mm.
    """
    across = np.linalg.pinv(jacobians)
    covariance: Array = across @ covariance_px2 @ np.swapaxes(across, -1, -2)
    return covariance
