"""Covariance of the motion prior: all ways in which electrodes deviate from their expected motion."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Self

import numpy as np
from pydantic import BaseModel, Field

from fluoromap.catheters import Catalogue, follows_tip
from fluoromap.contracts import Array, MonoplaneView, StudyVariation
from fluoromap.monoplane.expected_motion import READING_SD_FRAMES, SYSTOLE_PHASE, ExpectedMotion
from fluoromap.monoplane.gaussian_path import PathPrior
from fluoromap.monoplane.view_electrodes import isocentre_covariance_mm2

FIXED, OFFSET, TILT, BEND = range(4)
BREATHING, BEATS, ANGLE, ISOCENTRE, OTHER = range(5)
"""Causes of deviations: the first four in the order of :class:`~fluoromap.contracts.StudyVariation`."""
_FOLLOWS_INTERVAL = 0.5
"""Change of a beat's amplitude with the interval before it, both as shares."""
_ALIGNED_SD_CYCLE = 0.01
_OFFSET_HARMONICS, _SHAPE_HARMONICS = 4, 3
_LASTING_SHARE = 0.7
_STRAY_CYCLE_MM, _STRAY_POINT_MM = 0.03, 0.05
"""An electrode's own error from pixel noise: averaged over the moments of a cycle, not averaged in a single point."""


class MotionParams(BaseModel, extra="forbid"):
    """Deviations of heart, breathing, catheters and gantry from the expectation; standard deviations."""

    respiration_head_feet_sd_mm: float = Field(
        4.0, ge=0, le=30, description="Breathing position of the heart in this run along the patient's long axis, mm."
    )
    respiration_other_sd_mm: float = Field(
        1.0, ge=0, le=30, description="Breathing position of the heart in this run along the other two axes, mm."
    )
    respiration_drift_sd_mm: float = Field(
        0.4, ge=0, le=30, description="Breathing within one beat, in the direction in which it is largest, mm."
    )
    beat_amplitude_sd: float = Field(
        0.04, ge=0, le=1, description="Variation of the motion's amplitude from beat to beat, as a share of it."
    )
    beat_timing_sd: float = Field(
        0.017, ge=0, le=0.5, description="Variation of the contraction's moment from beat to beat, in cycles."
    )
    beat_sd_mm: float = Field(
        0.25, ge=0, le=10, description="Variation of a catheter's place from beat to beat, mm an axis."
    )
    tip_centre_sd_mm: float = Field(
        0.2,
        ge=0,
        le=5,
        description="Distance along the shaft from the middle of a tip of 4 mm or less to its centre in the image, mm.",
    )
    mapping_motion_sd_mm: float = Field(
        2.9, ge=0, le=30, description="Motion of the mapping catheter over the cycle where no cycle is known, mm."
    )
    other_motion_sd_mm: float = Field(
        1.5, ge=0, le=30, description="Motion of the other catheters over the cycle where no cycle is known, mm."
    )
    gantry_angle_sd_deg: float = Field(0.5, ge=0, le=10, description="Error of each gantry angle, degrees.")
    magnification_sd: float = Field(
        0.003, ge=0, le=0.2, description="Relative error of the source-to-detector distance in each view."
    )
    isocentre_sd_mm: float = Field(0.5, ge=0, le=20, description="Error of the isocentre's place in this view, mm.")

    def with_any_gantry(self) -> Self:
        """Return the parameters with the root mean square errors over all kinds of gantry."""
        any_study = StudyVariation()
        return self.model_copy(
            update={
                "gantry_angle_sd_deg": any_study.gantry_angle * self.gantry_angle_sd_deg,
                "isocentre_sd_mm": any_study.gantry_offset * self.isocentre_sd_mm,
                "magnification_sd": any_study.gantry_angle * self.magnification_sd,
            }
        )

    def respiration_sd_mm(self) -> Array:
        """Return the breathing standard deviations (3,) along the patient's axes, mm."""
        other, head = self.respiration_other_sd_mm, self.respiration_head_feet_sd_mm
        return np.array([other, other, head])


class MotionCovariance:
    """The prior of one run, window by window.

    expected : for all its frames. phases : (n,). rays : (n, m, 3) unit directions from the source through the mean.
    """

    def __init__(
        self, view: MonoplaneView, labels: tuple[tuple[str, int], ...], expected: ExpectedMotion, phases: Array,
        params: MotionParams,
    ) -> None:  # fmt: skip
        self._expected, self._phases, self._params = expected, phases, params
        self._camera, self._axis = view.camera, view.camera.axis_world
        self._names = np.array([name for name, _ in labels])
        self._catheters = tuple(dict.fromkeys(self._names))
        self._mapping = view.catalogue.mapping
        self._shapes = [_shapes(view.catalogue, labels, name) for name in self._catheters]
        self._follows = follows_tip(expected.mean_mm, labels, view.catalogue)
        rays = expected.mean_mm - view.camera.source_world_mm
        self.rays: Array = rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def window(self, frames: slice) -> PathPrior:
        """Return the prior of consecutive frames, about one beat."""
        columns, unseen, parts, causes = [], [], [], []
        rays = self.rays[frames]
        for part, cause, seen_along, block in self._parts(frames):
            along = np.zeros_like(block) if seen_along else _along(rays, block)
            columns.append(block - along)
            unseen.append(along)
            parts += [part] * block.shape[-1]
            causes += [cause] * block.shape[-1]
        mean = self._expected.mean_mm[frames]
        return PathPrior(
            mean,
            np.concatenate(columns, axis=-1),
            np.concatenate(unseen, axis=-1),
            np.array(parts),
            np.array(causes),
            self._white(frames),
        )

    def _parts(self, frames: slice) -> Iterator[tuple[int, int, bool, Array]]:
        """Yield part, cause, True where the view shows its depth, and columns.

        The columns are (n, m, 3, k).

        A view shows the depth of a beat by its motion across the rays, and the depth of a tilt by the catheter's lengths. It
        does not show the depth of a catheter as a whole, nor that of breathing: 1 mm changes the size of the image by 0.2 %.
        """
        p, expected = self._params, self._expected
        mean = expected.mean_mm[frames]
        n, m = mean.shape[:2]
        breath = p.respiration_sd_mm()
        everywhere = np.ones((n, m, 1, 1))
        isocentre = isocentre_covariance_mm2(self._camera, p.isocentre_sd_mm)
        breathing, offset, rest = self._common_shares()
        whole = _root(expected.common_mm2)
        yield (
            FIXED,
            BREATHING,
            False,
            everywhere * np.concatenate([np.sqrt(breathing) * whole, np.diag(breath)], axis=1),
        )
        yield FIXED, ISOCENTRE, False, everywhere * np.concatenate([np.sqrt(offset) * whole, _root(isocentre)], axis=1)
        yield FIXED, OTHER, False, everywhere * np.sqrt(rest) * whole
        # Biplane positions are those at the middle of the two runs' breathing positions. This run's breathing position is
        # as far from the middle as the other run's. The other run alone measured the depth, so that the error along the
        # ray is twice the distance to the middle.
        depth = min(self._axis @ expected.common_mm2 @ self._axis, self._axis @ np.diag(breath**2) @ self._axis / 2)
        yield FIXED, BREATHING, False, everywhere * np.sqrt(depth) * self._axis[:, None]
        if breath.max() > 0:
            drift = p.respiration_drift_sd_mm * breath / breath.max()
            yield FIXED, BREATHING, False, np.linspace(-0.5, 0.5, n)[:, None, None, None] * everywhere * np.diag(drift)
        # The other view measured the depth; its wrong gantry angle rotates that depth about the isocentre.
        from_isocentre = mean - self._camera.isocentre_world_mm
        turned = np.cross(np.eye(3), from_isocentre[:, :, None]).swapaxes(-1, -2)
        yield FIXED, ANGLE, False, _along(self.rays[frames], turned) * np.radians(p.gantry_angle_sd_deg)
        # This view's wrong angle is a source of its own, else its effect would be taken for another size, that is depth.
        # It displaces the image, not the electrode: only its part across the rays counts.
        rays = self.rays[frames]
        yield FIXED, ANGLE, False, _across(rays, turned) * np.radians(p.gantry_angle_sd_deg)
        yield FIXED, ANGLE, False, _across(rays, from_isocentre[..., None]) * p.magnification_sd
        yield from self._beats(frames, self.rays[frames])
        if expected.beats:
            yield from self._free(frames)

    def _common_shares(self) -> tuple[float, float, float]:
        """Return the shares of breathing, isocentre and others in the common depth."""
        p, axis = self._params, self._axis
        common = float(axis @ self._expected.common_mm2 @ axis)
        if common <= 0:
            return 0.0, 0.0, 1.0
        breathing = min(common, float(axis @ np.diag(p.respiration_sd_mm() ** 2) @ axis) / 2)
        offset = min(common - breathing, p.isocentre_sd_mm**2)
        return breathing / common, offset / common, (common - breathing - offset) / common

    def _beats(self, frames: slice, rays: Array) -> Iterator[tuple[int, int, bool, Array]]:
        """Yield the deviations of this beat from the mean beat.

        The mean beats of the two views differ too.
        """
        p, expected = self._params, self._expected
        if not expected.beats:
            return
        moved, velocity = expected.moved_mm[frames, ..., None], expected.velocity_mm[frames, ..., None]
        reading = READING_SD_FRAMES / expected.frames_per_cycle
        timing = np.hypot(p.beat_timing_sd, reading)
        uneven = SYSTOLE_PHASE * expected.cycle_spread
        # A long interval fills the heart: the beat after it is stronger.
        amplitude = np.hypot(p.beat_amplitude_sd, _FOLLOWS_INTERVAL * expected.cycle_spread)
        yield FIXED, OTHER, True, moved * amplitude
        yield FIXED, OTHER, True, velocity * np.hypot(timing, uneven)
        averaged = 1 / np.sqrt(expected.beats)
        for name in self._catheters:
            yield FIXED, BEATS, False, self._of(name) * self._follows[frames] * p.beat_sd_mm * averaged
        if expected.own_cycle:
            # A shift in phase is more than its first order where the cycles differ much, here and in the cycle itself.
            yield FIXED, OTHER, False, np.sqrt(2) * _along(rays, expected.curved_mm[frames, ..., None])
            # Depth comes from the other view's run, and this view cannot show how that run's beats differ.
            yield FIXED, OTHER, False, _along(rays, moved * amplitude * averaged)
            yield (
                FIXED,
                OTHER,
                False,
                _along(rays, velocity * np.hypot(p.beat_timing_sd * averaged, np.hypot(uneven, _ALIGNED_SD_CYCLE))),
            )

    def _free(self, frames: slice) -> Iterator[tuple[int, int, bool, Array]]:
        """Yield each catheter's offset, tilt and bend over the beat.

        The view itself determines their sizes.
        """
        offset_sd = np.hypot(self._expected.offset_sd_mm[frames], self._params.beat_sd_mm)
        slow, fast = (_over_cycle(self._phases[frames], k) for k in (_SHAPE_HARMONICS, _OFFSET_HARMONICS))
        for name, (tilt, bend) in zip(self._catheters, self._shapes, strict=True):
            own = self._names == name
            tilt_sd, bend_sd = self._looseness(name)
            # With a cycle of its own, a catheter's offset is that of beats. Else other sites' motion dominates it.
            cause = BEATS if self._expected.own_cycle else OTHER
            yield (
                OFFSET,
                cause,
                False,
                _in_time(fast, np.where(own, offset_sd, 0.0)[..., None, None] * self._follows[frames]),
            )
            yield TILT, OTHER, True, _in_time(slow, (tilt_sd * tilt)[:, None, None] * np.eye(3))
            yield BEND, OTHER, True, _in_time(slow, (bend_sd * bend)[:, None, None] * np.eye(3))

    def _looseness(self, name: str) -> tuple[float, float]:
        """Return a catheter's deviation from its expected shape.

        Tilt in radians, and bend in mm at the ends.
        """
        if self._expected.own_cycle:
            return 0.02, 0.08
        return (0.045, 0.2) if name == self._mapping else (0.02, 0.05)

    def _white(self, frames: slice) -> Array:
        """Return the covariance (n, 3 m, 3 m) of each frame's own deviation.

        It is small where a cycle is known, and contains all of the motion where none is.
        """
        known = bool(self._expected.beats)
        offset_sd = self._expected.offset_sd_mm[frames]
        n, m = offset_sd.shape
        spatial = np.zeros((n, m, m))
        for name, (tilt, bend) in zip(self._catheters, self._shapes, strict=True):
            own = (self._names == name).astype(np.float64)
            tilt_sd, bend_sd = (0.003, 0.02) if known else (0.09, 0.25) if name == self._mapping else (0.04, 0.08)
            level = own * (np.full_like(offset_sd, 0.05) if known else offset_sd)
            spatial += level[:, :, None] * level[:, None, :]
            spatial += tilt_sd**2 * np.outer(tilt, tilt) + bend_sd**2 * np.outer(bend, bend)
        spatial += (_STRAY_CYCLE_MM if self._expected.own_cycle else _STRAY_POINT_MM) ** 2 * np.eye(m)
        white: Array = np.einsum("nab,ij->naibj", spatial, np.eye(3)).reshape(n, 3 * m, 3 * m)
        return white

    def _of(self, name: str) -> Array:
        own: Array = (self._names == name).astype(np.float64)[:, None, None]
        return own


def _shapes(catalogue: Catalogue, labels: tuple[tuple[str, int], ...], name: str) -> tuple[Array, Array]:
    """Return patterns (m,) of a catheter's tilt (mm from its middle) and bend (1 at its ends); 0 for other catheters."""
    own = np.array([catheter == name for catheter, _ in labels])
    along = np.array(
        [catalogue[name].arc_lengths_mm[electrode - 1] if catheter == name else 0.0 for catheter, electrode in labels]
    )
    middle = along[own].mean()
    tilt = np.where(own, along - middle, 0.0)
    half = max(float(np.abs(tilt).max()), 1.0)
    bowed = (tilt / half) ** 2
    return tilt, np.where(own, bowed - bowed[own].mean(), 0.0)


def _over_cycle(phases: Array, harmonics: int) -> Array:
    """Return unit-variance courses (n, 1 + 2 h) over the cycle.

    They are a constant, and waves whose strength falls as h^-1.5.
    """
    order = np.arange(1, harmonics + 1)
    shares = order**-3.0 / (order**-3.0).sum() * (1 - _LASTING_SHARE)
    angle = 2 * np.pi * phases[:, None] * order
    waves = np.concatenate([np.cos(angle), np.sin(angle)], axis=1) * np.sqrt(np.tile(shares, 2))
    return np.concatenate([np.full((len(phases), 1), np.sqrt(_LASTING_SHARE)), waves], axis=1)


def _in_time(courses: Array, displacements: Array) -> Array:
    """Return columns (n, m, 3, 3 k): each course (n, k) times each displacement (n, m, 3, 3) or (m, 3, 3)."""
    n, m = len(courses), displacements.shape[-3]
    everywhere = np.broadcast_to(displacements, (n, m, 3, 3))
    columns: Array = np.einsum("nk,nmij->nmijk", courses, everywhere).reshape(n, m, 3, -1)
    return columns


def _along(rays: Array, columns: Array) -> Array:
    """Return the part of columns (n, m, 3, k) along the rays (n, m, 3)."""
    share: Array = rays[..., None] * np.einsum("nmi,nmik->nmk", rays, columns)[..., None, :]
    return share


def _across(rays: Array, columns: Array) -> Array:
    """Return the part of columns (n, m, 3, k) across the rays (n, m, 3)."""
    across: Array = columns - _along(rays, columns)
    return across


def _root(covariance: Array) -> Array:
    values, axes = np.linalg.eigh(covariance)
    root: Array = axes * np.sqrt(np.maximum(values, 0.0))
    return root
