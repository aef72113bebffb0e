"""The samples of a tracked view: positions from a chosen origin, with their uncertainty and grade."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple, dataclass, replace

import numpy as np

from fluoromap.contracts import Array, BoolArray, Grade, LocatedSite, StudyVariation, Track, grades_of
from fluoromap.geometry import Camera
from fluoromap.reasons import Reason


@dataclass(frozen=True, slots=True)
class Sample:
    """One electrode in one frame (counted from 1).

    position_mm, baseline_mm, covariance_mm2 : (3,), (3,), (3, 3); None in frames without a position.
    along_ray_sd_mm : standard deviation along the ray of this view. lateral_sd_mm : across it, root mean square of the
    two directions. pixel_uv : (2,) the electrode's pixel; None in frames that do not show it.
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
    """The origin of coordinates in each of n frames.

    positions_mm : (n, 3) from the isocentre; subtract it from a position. known : (n,), False in frames without an origin.
    borrowed : (n,), True where the origin is the mean over the other sites. same_frame : (n,), True where the origin is the
    reference catheter's mean in that frame; then it shares its errors with the positions of that frame.
    """

    positions_mm: Array
    known: BoolArray
    borrowed: BoolArray
    same_frame: BoolArray


def isocentre_origins(frames: int) -> FrameOrigins:
    """Return the isocentre as the origin of every frame."""
    never = np.zeros(frames, dtype=np.bool_)
    return FrameOrigins(np.zeros((frames, 3)), ~never, never, never)


def reference_origins(track: Track, site: LocatedSite, catheter: str | None, others_mm: Array | None) -> FrameOrigins:
    """Return the mean of the reference catheter's electrodes in each frame.

    A frame may show only some of the electrodes. Then each of them gives an estimate of the mean, by subtracting its
    diastolic offset from the mean. A frame without any takes the site's own diastolic mean.

    Parameters
    ----------
    track : Track
    site : LocatedSite
        The site of the track.
    catheter : str or None
        Name of the reference catheter, where the study has one.
    others_mm : (3,) or None
        Mean over the other sites, from the isocentre, for a site that has no diastolic mean of its own.
    """
    electrodes = [index for index, (name, _) in enumerate(track.labels) if name == catheter]
    offsets_mm, has_offset = np.zeros((len(electrodes), 3)), np.ones(len(electrodes), dtype=np.bool_)
    if site.reference_mm is not None:
        for row, index in enumerate(electrodes):
            point = site.point(*track.labels[index])
            has_offset[row] = point is not None
            if point is not None:
                offsets_mm[row] = point.position_mm - site.reference_mm
    located = track.located[:, electrodes] & has_offset
    count = located.sum(axis=1)
    total = np.where(located[..., None], track.positions_mm[:, electrodes] - offsets_mm, 0.0).sum(axis=1)
    mean: Array = total / np.maximum(count, 1)[:, None]
    same_frame: BoolArray = count > 0
    fallback = site.reference_mm if site.reference_mm is not None else others_mm
    if fallback is None:
        return FrameOrigins(mean, same_frame, np.zeros_like(same_frame), same_frame)
    mean[~same_frame] = fallback
    borrowed = ~same_frame if site.reference_mm is None else np.zeros_like(same_frame)
    return FrameOrigins(mean, np.ones_like(same_frame), borrowed, same_frame)


def in_study(track: Track, camera: Camera, reference: str | None, variation: StudyVariation) -> Track:
    """Return the track with the covariances of a study with this variation.

    A solver assumes any gantry and any heart, so that its result depends on one site alone. A study shows how far its heart
    breathes and how wrong its gantry can be: its tracks are more certain, or less.

    Parameters
    ----------
    track : Track
    camera : Camera
        Camera of the tracked view.
    reference : str or None
        Name of the reference catheter, where the study has one.
    variation : StudyVariation
        Of the study.
    """
    shares = track.shares
    if shares is None:
        return track
    change = np.square(np.array(astuple(variation)) / np.array(astuple(StudyVariation()))) - 1
    rays = track.positions_mm - camera.source_world_mm
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    along = rays[..., :, None] * rays[..., None, :]
    across = np.eye(3) - along
    angle, offset = change[2] * shares.angle_sd_rad**2, change[3] * shares.offset_sd_mm**2
    turned = angle * _turned_mm2(track.positions_mm - camera.isocentre_world_mm) + offset * np.eye(3)
    depth = np.einsum("c,cnm->nm", change, shares.depth_mm2)
    absolute = track.covariance_mm2 + depth[..., None, None] * along + across @ turned @ across
    relative = track.relative_covariance_mm2
    if relative is not None:
        is_reference = np.array([name == reference for name, _ in track.labels])
        shown = track.located & is_reference
        count = shown.sum(axis=1)
        mean = np.einsum("nm,nmi->ni", shown, track.positions_mm) / np.maximum(count, 1)[:, None]
        from_reference = angle * _turned_mm2(track.positions_mm - mean[:, None])
        relative_turned = np.where((count > 0)[:, None, None, None], from_reference, turned)
        depth = np.einsum("c,cnm->nm", change, shares.relative_depth_mm2)
        relative = relative + depth[..., None, None] * along + across @ relative_turned @ across
        relative = np.where(track.located[..., None, None], relative, 0.0)
    absolute = np.where(track.located[..., None, None], absolute, 0.0)
    return replace(track, covariance_mm2=absolute, relative_covariance_mm2=relative, shares=None)


def _turned_mm2(points_mm: Array) -> Array:
    """Return the covariance (..., 3, 3) of turned points (..., 3), mm^2.

    The rotation has unit variance about every axis.
    """
    squares = (points_mm**2).sum(axis=-1)[..., None, None] * np.eye(3)
    covariance: Array = squares - points_mm[..., :, None] * points_mm[..., None, :]
    return covariance


def track_samples(
    track: Track, index: int, camera: Camera, origins: FrameOrigins, doubts: tuple[Reason, ...] = ()
) -> Iterator[Sample]:
    """Return the samples of one electrode, one for each frame.

    Where the origin is the reference of the same frame, the covariance is that of the difference, if the solver gives it:
    breathing and the gantry's errors cancel. Otherwise it is the covariance of the position from the isocentre.

    Parameters
    ----------
    track : Track
    index : int
        Place of the electrode in ``track.labels``.
    camera : Camera
        Camera of the tracked view.
    origins : FrameOrigins
        For all frames of the track.
    doubts : tuple of Reason
        Reasons of the electrode's point at its site: they apply to the track too.
    """
    doubts = tuple(dict.fromkeys((*track.reasons[index], *doubts)))
    positions, covariances = track.positions_mm[:, index], track.covariance_mm2[:, index]
    if track.relative_covariance_mm2 is not None:
        same_frame = origins.same_frame[:, None, None]
        covariances = np.where(same_frame, track.relative_covariance_mm2[:, index], covariances)
    along, lateral = (sd.tolist() for sd in split_along_ray(covariances, positions - camera.source_world_mm))
    from_origin = positions - origins.positions_mm
    baseline = track.baseline_mm[:, index] - origins.positions_mm
    without_origin = tuple(dict.fromkeys((*doubts, Reason.NO_REFERENCE)))
    grades, borrowed_grades = (grades_of(covariances, reasons) for reasons in (doubts, without_origin))
    for frame, located in enumerate(track.located[:, index].tolist()):
        if not located:
            yield _without_position(frame, None, (*doubts, Reason.TRACK_INTERRUPTED))
            continue
        pixel = track.pixels_uv[frame, index]
        if not origins.known[frame]:
            yield _without_position(frame, pixel, without_origin)
            continue
        borrowed = origins.borrowed[frame]
        yield Sample(
            frame + 1, from_origin[frame], baseline[frame], covariances[frame], along[frame], lateral[frame], pixel,
            borrowed_grades[frame] if borrowed else grades[frame], without_origin if borrowed else doubts,
        )  # fmt: skip


def _without_position(frame: int, pixel: Array | None, reasons: tuple[Reason, ...]) -> Sample:
    return Sample(frame + 1, None, None, None, None, None, pixel, Grade.REJECTED, tuple(dict.fromkeys(reasons)))


def split_along_ray(covariance_mm2: Array, ray: Array) -> tuple[Array, Array]:
    """Return the standard deviations along a ray and across it, in mm.

    Parameters
    ----------
    covariance_mm2 : (..., 3, 3)
    ray : (..., 3)
        Direction of any length.

    Returns
    -------
    tuple of ndarray (...)
        Along the ray; and the root mean square of the two directions across it.
    """
    direction = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    along = np.einsum("...i,...ij,...j->...", direction, covariance_mm2, direction)
    across = (np.trace(covariance_mm2, axis1=-2, axis2=-1) - along) / 2
    return np.sqrt(np.maximum(along, 0.0)), np.sqrt(np.maximum(across, 0.0))
