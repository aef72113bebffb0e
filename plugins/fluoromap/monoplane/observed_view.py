"""One view's named chains as arrays over frames and electrodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array, BoolArray, ElectrodePoint, MonoplaneView, Refusal
from fluoromap.geometry import Camera
from fluoromap.reasons import Reason


@dataclass(frozen=True, eq=False)
class ObservedView:
    """What one view shows of the m electrodes that have an a-priori position.

    labels : (catheter, electrode). a_priori : their points from two views.
    seen : (n, m). pixels_uv : (n, m, 2) and covariance_px2 : (n, m, 2, 2), 0 and 1 px^2 where not seen.
    phases : (n,), NaN where no cycle is known.
    """

    labels: tuple[tuple[str, int], ...]
    a_priori: tuple[ElectrodePoint, ...]
    seen: BoolArray
    pixels_uv: Array
    covariance_px2: Array
    phases: Array

    @property
    def a_priori_mm(self) -> Array:
        """(m, 3) in the world."""
        return np.array([point.position_mm for point in self.a_priori])

    @property
    def catheters(self) -> tuple[str, ...]:
        return tuple(catheter for catheter, _ in self.labels)

    def interrupted(self) -> tuple[bool, ...]:
        """Whether each electrode is missing in some frame."""
        return tuple(not bool(column.all()) for column in self.seen.T)


def observe(view: MonoplaneView) -> ObservedView:
    """Gather a view's observations of the electrodes with an a-priori position.

    Raises
    ------
    Refusal
        NO_A_PRIORI when no position is known from two views.
    """
    if not view.a_priori:
        raise Refusal(Reason.NO_A_PRIORI)
    labels = tuple((point.catheter, point.electrode) for point in view.a_priori)
    place = {label: index for index, label in enumerate(labels)}
    n, m = len(view.observations), len(labels)
    seen = np.zeros((n, m), dtype=np.bool_)
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
                    seen[row, column] = True
                    pixels[row, column] = chain.pixels_uv[k]
                    covariance[row, column] = chain.covariance_px2[k]
    return ObservedView(labels, view.a_priori, seen, pixels, covariance, phases)


def outwards(frames: int, start: int) -> tuple[tuple[int, int], ...]:
    """(frame, the frame before it on the way) from the a-priori frame to both ends of the run."""
    forth = [(frame, frame - 1) for frame in range(start + 1, frames)]
    back = [(frame, frame + 1) for frame in range(start - 1, -1, -1)]
    return (*forth, *back)


def turned_covariance_mm2(points_world_mm: Array, angle_sd_deg: float) -> Array:
    """Covariance (..., 3, 3) of points (..., 3) when the gantry's angles are wrong by this about any axis."""
    squares = (points_world_mm**2).sum(axis=-1)[..., None, None] * np.eye(3)
    outer = points_world_mm[..., :, None] * points_world_mm[..., None, :]
    covariance: Array = np.radians(angle_sd_deg) ** 2 * (squares - outer)
    return covariance


def isocentre_covariance_mm2(camera: Camera, sd_mm: float) -> Array:
    """Covariance (3, 3) of what a view shows when its isocentre stands elsewhere by this in any direction across the view."""
    covariance: Array = sd_mm**2 * (np.eye(3) - np.outer(camera.axis_world, camera.axis_world))
    return covariance


def lateral_covariance_mm2(jacobians: Array, covariance_px2: Array) -> Array:
    """Pixel covariances (..., 2, 2) as covariances (..., 3, 3) across the rays, by the jacobians (..., 2, 3) in px/mm."""
    across = np.linalg.pinv(jacobians)
    covariance: Array = across @ covariance_px2 @ np.swapaxes(across, -1, -2)
    return covariance
