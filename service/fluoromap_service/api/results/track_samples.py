"""Samples of a site followed in one view: positions from the chosen origin, with what they are worth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array, BoolArray, Grade, LocatedSite, Track, View, grade_of
from fluoromap.geometry import Camera
from fluoromap.reasons import Reason


@dataclass(frozen=True, slots=True)
class Sample:
    """One electrode in one frame (counted from 1).

    position_mm, baseline_mm, covariance_mm2 : (3,), (3,), (3, 3); None where there is no position.
    along_ray_sd_mm : standard deviation along the ray of this view; lateral_sd_mm : across it, root mean square of the
    two directions. pixel_uv : where the electrode was seen; None in frames without it.
    """

    frame: int
    position_mm: Array | None
    baseline_mm: Array | None
    covariance_mm2: Array | None
    along_ray_sd_mm: float | None
    lateral_sd_mm: float | None
    pixel_uv: Array | None
    grade: Grade
    reasons: tuple[Reason, ...]


@dataclass(frozen=True, eq=False)
class FrameOrigins:
    """What is subtracted in each frame: positions_mm (n, 3) from the isocentre; known (n,), False where there is none;
    borrowed (n,), True where it is the mean over the other sites; same_frame (n,), True where it is the reference
    catheter's mean in that very frame, which shares its errors with the position it is subtracted from.
    """

    positions_mm: Array
    known: BoolArray
    borrowed: BoolArray
    same_frame: BoolArray


def isocentre(frames: int) -> FrameOrigins:
    """The isocentre in every frame."""
    never = np.zeros(frames, dtype=np.bool_)
    return FrameOrigins(np.zeros((frames, 3)), ~never, never, never)


def reference(track: Track, site: LocatedSite, catheter: str, others_mm: Array | None) -> FrameOrigins:
    """Mean of the reference catheter's electrodes in each frame.

    Where only some are located, each tells of the mean by where it stands from it at diastole. Frames in which none is
    located take the site's own diastolic mean, or where the site has none that over the other sites ``others_mm``.
    """
    electrodes = [index for index, (name, _) in enumerate(track.labels) if name == catheter]
    from_mean, told = np.zeros((len(electrodes), 3)), np.ones(len(electrodes), dtype=np.bool_)
    if site.reference_mm is not None:
        for row, index in enumerate(electrodes):
            point = site.point(*track.labels[index])
            told[row] = point is not None
            if point is not None:
                from_mean[row] = point.position_mm - site.reference_mm
    located = track.located[:, electrodes] & told
    count = located.sum(axis=1)
    total = np.where(located[..., None], track.positions_mm[:, electrodes] - from_mean, 0.0).sum(axis=1)
    mean: Array = total / np.maximum(count, 1)[:, None]
    seen: BoolArray = count > 0
    fallback = site.reference_mm if site.reference_mm is not None else others_mm
    if fallback is None:
        return FrameOrigins(mean, seen, np.zeros_like(seen), seen)
    mean[~seen] = fallback
    borrowed = ~seen if site.reference_mm is None else np.zeros_like(seen)
    return FrameOrigins(mean, np.ones_like(seen), borrowed, seen)


def camera_of(site: LocatedSite, view: View) -> Camera:
    """The camera a view ended with, self-calibrated or not."""
    return site.camera_a if view == "a" else site.camera_b


def samples(track: Track, index: int, camera: Camera, origins: FrameOrigins) -> Iterator[Sample]:
    """The samples of the electrode that stands at ``index`` in ``track.labels``, one a frame.

    Where the reference's mean of the same frame is subtracted, the covariance is that of the difference, if the solver
    tells it: breathing and the gantry's errors cancel. Else it is that of the position from the isocentre.
    """
    doubts = track.reasons[index]
    source = camera.source_world_mm
    for frame, located in enumerate(track.located[:, index]):
        if not located:
            yield _without_position(frame, None, (*doubts, Reason.TRACK_INTERRUPTED))
            continue
        pixel = track.pixels_uv[frame, index]
        if not origins.known[frame]:
            yield _without_position(frame, pixel, (*doubts, Reason.NO_REFERENCE))
            continue
        reasons = (*doubts, Reason.NO_REFERENCE) if origins.borrowed[frame] else doubts
        position, covariance = track.positions_mm[frame, index], track.covariance_mm2[frame, index]
        if origins.same_frame[frame] and track.relative_covariance_mm2 is not None:
            covariance = track.relative_covariance_mm2[frame, index]
        along, lateral = split_along_ray(covariance, position - source)
        origin = origins.positions_mm[frame]
        yield Sample(
            frame + 1, position - origin, track.baseline_mm[frame, index] - origin, covariance, along, lateral, pixel,
            grade_of(covariance), tuple(dict.fromkeys(reasons)),
        )  # fmt: skip


def _without_position(frame: int, pixel: Array | None, reasons: tuple[Reason, ...]) -> Sample:
    return Sample(frame + 1, None, None, None, None, None, pixel, Grade.REJECTED, tuple(dict.fromkeys(reasons)))


def split_along_ray(covariance_mm2: Array, ray: Array) -> tuple[float, float]:
    """Standard deviation along a ray, and across it (root mean square of the two directions), in mm."""
    direction = ray / np.linalg.norm(ray)
    along = float(direction @ covariance_mm2 @ direction)
    across = (float(np.trace(covariance_mm2)) - along) / 2
    return float(np.sqrt(max(along, 0.0))), float(np.sqrt(max(across, 0.0)))
