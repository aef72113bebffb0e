"""Result of a triangulator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from fluoromap.contracts.arrays import Array, frozen
from fluoromap.contracts.matching import RejectedSite
from fluoromap.contracts.segmentation import View
from fluoromap.geometry import Camera
from fluoromap.reasons import AT_BEST_C, Reason


@dataclass(frozen=True, eq=False)
class ElectrodePoint:
    """One electrode in 3D at diastole.

    position_mm : (3,), covariance_mm2 : (3, 3), from the isocentre.
    relative_mm, relative_covariance_mm2 : the same from the reference catheter's mean; None where that was not located.
    residual_px : reprojection residual in view a and b. A shift of the whole heart between the runs is subtracted where
    the triangulator estimates one.
    reasons : why the point deserves less trust.
    alternative_mm : (3,) position from the isocentre for the other possible pairing of the catheters; None where it was
    ruled out. The covariance contains it, weighted with ``alternative_probability``.
    """

    catheter: str
    electrode: int
    position_mm: Array
    covariance_mm2: Array
    relative_mm: Array | None
    relative_covariance_mm2: Array | None
    residual_px: tuple[float, float]
    ray_angle_deg: float
    reasons: tuple[Reason, ...] = ()
    alternative_mm: Array | None = None
    alternative_probability: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "position_mm", frozen(self.position_mm, (3,), "position_mm"))
        object.__setattr__(self, "covariance_mm2", frozen(self.covariance_mm2, (3, 3), "covariance_mm2"))
        if self.alternative_mm is not None:
            object.__setattr__(self, "alternative_mm", frozen(self.alternative_mm, (3,), "alternative_mm"))
        if (self.relative_mm is None) != (self.relative_covariance_mm2 is None):
            raise ValueError("a relative position needs its covariance")
        if self.relative_mm is not None:
            object.__setattr__(self, "relative_mm", frozen(self.relative_mm, (3,), "relative_mm"))
            covariance = frozen(self.relative_covariance_mm2, (3, 3), "relative_covariance_mm2")  # type: ignore[arg-type]
            object.__setattr__(self, "relative_covariance_mm2", covariance)

    @classmethod
    def of_moment(
        cls,
        labels: Sequence[tuple[str, int]],
        positions_mm: Array,
        covariances_mm2: Array,
        relative_mm: Array | None,
        relative_covariances_mm2: Array | None,
        residuals_px: Sequence[tuple[float, float]],
        ray_angles_deg: Sequence[float],
        reasons: Sequence[tuple[Reason, ...]],
    ) -> tuple[ElectrodePoint, ...]:
        """Return the points of n electrodes from arrays (n, ...), each checked once.

        A study has thousands of points, and the checks of single ones take longer than their location.
        """
        n = len(labels)
        if (relative_mm is None) != (relative_covariances_mm2 is None):
            raise ValueError("a relative position needs its covariance")
        checked = {
            "position_mm": frozen(positions_mm, (n, 3), "positions_mm"),
            "covariance_mm2": frozen(covariances_mm2, (n, 3, 3), "covariances_mm2"),
        }
        if relative_mm is not None and relative_covariances_mm2 is not None:
            checked["relative_mm"] = frozen(relative_mm, (n, 3), "relative_mm")
            checked["relative_covariance_mm2"] = frozen(relative_covariances_mm2, (n, 3, 3), "relative_covariances_mm2")
        # Lists of rows: indexing an array takes longer than the rest.
        nothing = [None] * n
        columns = [
            list(checked[name]) if name in checked else nothing
            for name in ("position_mm", "covariance_mm2", "relative_mm", "relative_covariance_mm2")
        ]
        points = []
        for (catheter, electrode), residual, angle, own, place, covariance, relative, its_covariance in zip(
            labels, residuals_px, ray_angles_deg, reasons, *columns, strict=True
        ):
            point = object.__new__(cls)
            point.__dict__.update(
                catheter=catheter, electrode=electrode, position_mm=place, covariance_mm2=covariance, relative_mm=relative,
                relative_covariance_mm2=its_covariance, residual_px=residual, ray_angle_deg=angle, reasons=own,
                alternative_mm=None, alternative_probability=0.0,
            )  # fmt: skip
            points.append(point)
        return tuple(points)


@dataclass(frozen=True, eq=False)
class SiteCycle:
    """A site's electrodes in 3D over one cardiac cycle.

    phases : (p,), rising within 0..1. labels : (catheter, electrode) of each of the m electrodes.
    positions_mm : (p, m, 3). covariance_mm2 : (p, m, 3, 3).
    """

    stored_apart: ClassVar[bool] = True
    """Each cycle is stored by itself: it is long, and a correction at another site does not change it."""

    phases: Array
    labels: tuple[tuple[str, int], ...]
    positions_mm: Array
    covariance_mm2: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "phases", frozen(self.phases, (None,), "phases"))
        p, m = len(self.phases), len(self.labels)
        object.__setattr__(self, "positions_mm", frozen(self.positions_mm, (p, m, 3), "positions_mm"))
        object.__setattr__(self, "covariance_mm2", frozen(self.covariance_mm2, (p, m, 3, 3), "covariance_mm2"))


@dataclass(frozen=True, slots=True)
class StudyVariation:
    """Variation that a study shows, as multiples of the assumed standard deviations.

    breathing : between runs. beats : of a catheter's place from beat to beat. gantry_angle, gantry_offset : remaining error of
    the gantry. The defaults hold where no study shows anything: any heart, and the root mean square over all kinds of gantry.
    """

    breathing: float = 1.0
    beats: float = 1.0
    gantry_angle: float = 1.124
    gantry_offset: float = 2.169


@dataclass(frozen=True, eq=False)
class APriori:
    """A site's points at diastole with the covariances of any gantry and any heart."""

    stored_apart: ClassVar[bool] = True
    """They are stored by themselves: a correction at another site does not change them."""

    points: tuple[ElectrodePoint, ...]


@dataclass(frozen=True, eq=False)
class LocatedSite:
    """A site in 3D: points at diastole, cycle and final cameras (self-calibrated or not).

    frame_a, frame_b : the diastolic frames. reference_mm : (3,) the reference catheter's mean, None where not located.
    variation : of the study that contains the site. a_priori : the points with the covariances of any gantry and any heart;
    None where a triangulator does not distinguish them. cycle has such covariances too. A correction at another site changes
    neither, so that no track has to be computed again.
    """

    site: str
    camera_a: Camera
    camera_b: Camera
    frame_a: int
    frame_b: int
    points: tuple[ElectrodePoint, ...]
    reference_mm: Array | None
    cycle: SiteCycle | None
    reasons: tuple[Reason, ...] = ()
    variation: StudyVariation = StudyVariation()
    a_priori: APriori | None = None

    def __post_init__(self) -> None:
        if self.reference_mm is not None:
            object.__setattr__(self, "reference_mm", frozen(self.reference_mm, (3,), "reference_mm"))

    @property
    def a_priori_points(self) -> tuple[ElectrodePoint, ...]:
        """The points of ``a_priori``, or ``points`` where there is none."""
        return self.points if self.a_priori is None else self.a_priori.points

    def point(self, catheter: str, electrode: int) -> ElectrodePoint | None:
        """Return the point of an electrode, or None where it was not located."""
        for point in self.points:
            if point.catheter == catheter and point.electrode == electrode:
                return point
        return None

    def reasons_of(self, catheter: str, electrode: int, reference: str | None = None) -> tuple[Reason, ...]:
        """Return the reasons of an electrode's position: its own and the site's.

        With the name of the reference catheter, for a position relative to it, the doubts about that catheter belong to
        them.
        """
        point = self.point(catheter, electrode)
        own = point.reasons if point is not None else ()
        origin = self.doubts_about(reference) if reference is not None else ()
        return tuple(dict.fromkeys((*own, *self.reasons, *origin)))

    def doubts_about(self, catheter: str | None) -> tuple[Reason, ...]:
        """Return the reasons of a catheter's points, and of the whole site, that limit the grade.

        Without a catheter, those of the whole site.
        """
        own = [reason for point in self.points if point.catheter == catheter for reason in point.reasons]
        reasons = (*own, *self.reasons)
        return tuple(dict.fromkeys(reason for reason in reasons if reason in AT_BEST_C))

    def camera(self, view: View) -> Camera:
        """Return the camera of a view."""
        return self.camera_a if view == "a" else self.camera_b

    def diastolic_frame(self, view: View) -> int:
        """Return the diastolic frame of a view, counted from 0."""
        return self.frame_a if view == "a" else self.frame_b


@dataclass(frozen=True, eq=False)
class Calibration:
    """Rotation and shift of view b against view a, beyond their headers.

    They are estimated from the study's electrodes. No electrode shows which view is wrong, so that each camera takes its expected
    share.
    applied : whether the cameras of the located sites contain it. rotation_deg : (3,) rotation vector about the isocentre;
    offset_mm : (3,), both in the world frame. epipolar_before_px, epipolar_after_px : Sampson RMS over the study.
    """

    applied: bool
    rotation_deg: Array
    offset_mm: Array
    epipolar_before_px: float
    epipolar_after_px: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "rotation_deg", frozen(self.rotation_deg, (3,), "rotation_deg"))
        object.__setattr__(self, "offset_mm", frozen(self.offset_mm, (3,), "offset_mm"))


@dataclass(frozen=True, slots=True)
class ErrorBudget:
    """Contribution of each source of error to the study's located electrodes.

    Millimetres, RMS, 3D, at diastole.
    """

    pixels_mm: float
    angles_mm: float
    source_distances_mm: float
    phase_mismatch_mm: float
    breathing_mm: float


@dataclass(frozen=True, slots=True)
class Triangulation:
    """All sites of a study in 3D, and the rejected ones.

    notes : sentences for the report. calibration, budget : None where the triangulator makes none.
    """

    sites: tuple[LocatedSite, ...]
    rejected: tuple[RejectedSite, ...]
    notes: tuple[str, ...] = ()
    calibration: Calibration | None = None
    budget: ErrorBudget | None = None
