"""The data that travels between stages, and the four stage protocols.

Everything here is a frozen dataclass that is validated once when built: an object that exists is valid. Frames are
counted from 0 inside the project (from 1 in files and in the API). Pixels are (u, v) = (column, row), (0, 0) the centre
of the top-left pixel. World points are millimetres along DICOM patient axes (LPS) from the isocentre. Where a name says
``relative``, the mean of the reference catheter's electrodes in the same frames has been subtracted.
"""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from types import MappingProxyType
from typing import Any, ClassVar, Literal, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel

from fluoromap.catheters import Catalogue
from fluoromap.geometry import Camera
from fluoromap.reasons import AT_BEST_B, AT_BEST_C, Reason

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
View = Literal["a", "b"]
T = TypeVar("T")

CHI2_95_3D = 7.814727903251179
"""95th percentile of the chi-squared distribution with 3 degrees of freedom: a 95 % ellipsoid's squared radius."""

ADDED_LATER = MappingProxyType({"added later": True})
"""Metadata of a field that earlier versions lack: the store reads their results with the field's default."""


class StageStopped(Exception):
    """Raised by :meth:`Context.check` when the job was cancelled or taken over.

    A stage must not catch it.
    """


class Refusal(Exception):
    """Raised by a stage when the data cannot support a result.

    ``reason`` is the code; the message describes the remedy to the user.
    """

    def __init__(self, reason: Reason, message: str | None = None) -> None:
        super().__init__(message or reason.sentence)
        self.reason = reason


class Context(Protocol):
    """The connection of a running stage to its worker."""

    def progress(self, fraction: float) -> None:
        """Report the finished share of the work, 0 to 1.

        Frequent calls are cheap.
        """

    def check(self) -> None:
        """Raise :class:`StageStopped` when the work is no longer wanted."""

    def recall(self, kind: type[T], inputs: tuple[object, ...], compute: Callable[[], T]) -> T:
        """Return a partial result from an earlier job of the study, or compute it.

        A correction changes one run. With this method a stage computes again only the parts that depend on that run.

        Parameters
        ----------
        kind : type
            Dataclass of the partial result: numbers, strings, enums, arrays, tuples and dataclasses of them.
        inputs : tuple
            Everything that the partial result depends on, besides the plugin, its version and its parameters. A dataclass counts
            with all its fields.
        compute : callable
            Computes the partial result.
        """


class Silent:
    """A :class:`Context` for notebooks and tests: it reports nothing, never stops and remembers nothing."""

    def progress(self, fraction: float) -> None:
        pass

    def check(self) -> None:
        pass

    def recall(self, kind: type[T], inputs: tuple[object, ...], compute: Callable[[], T]) -> T:
        return compute()


class Grade(StrEnum):
    """Trust in a position: by the largest semi-axis of its 95 % ellipsoid, and by the doubts about it."""

    A = "A"
    B = "B"
    C = "C"
    REJECTED = "rejected"


def grade_of(covariance_mm2: ArrayLike, reasons: Iterable[Reason] = ()) -> Grade:
    """Return the grade of a 3x3 position covariance with the reasons of the position.

    A up to 2 mm, B up to 4 mm, C beyond (largest semi-axis of the 95 % ellipsoid). Reasons that no covariance contains limit
    the grade: see ``AT_BEST_C`` and ``AT_BEST_B``.
    """
    return grades_of(np.asarray(covariance_mm2)[None], reasons)[0]


def grades_of(covariances_mm2: ArrayLike, reasons: Iterable[Reason] = ()) -> list[Grade]:
    """Return the grades of covariances (n, 3, 3) that have the same reasons; see :func:`grade_of`."""
    own = tuple(reasons)
    return [grade_of_axis(axis, own) for axis in largest_semi_axes_mm(covariances_mm2)]


def largest_semi_axes_mm(covariances_mm2: ArrayLike) -> list[float]:
    """Return the largest semi-axis of the 95 % ellipsoid of each covariance (n, 3, 3)."""
    largest = np.maximum(np.linalg.eigvalsh(np.asarray(covariances_mm2, dtype=np.float64))[:, -1], 0.0)
    semi_axes_mm: list[float] = np.sqrt(CHI2_95_3D * largest).tolist()
    return semi_axes_mm


def grade_of_axis(semi_axis_mm: float, reasons: Iterable[Reason]) -> Grade:
    """Return the grade for a largest semi-axis and reasons.

    See :func:`grade_of`.
    """
    doubts = set(reasons)
    if semi_axis_mm > 4.0 or doubts & AT_BEST_C:
        return Grade.C
    return Grade.B if semi_axis_mm > 2.0 or doubts & AT_BEST_B else Grade.A


def frozen(value: ArrayLike, shape: tuple[int | None, ...], name: str, dtype: type = np.float64) -> NDArray[Any]:
    """Return a read-only copy of ``value`` after checking shape and numbers.

    A length of None in ``shape`` allows any length. Floating-point values must be finite. An array that is already a
    read-only copy is returned unchanged.

    Raises
    ------
    ValueError
        When shape or numbers are wrong. The message has the name of the field.
    """
    array: NDArray[Any]
    if isinstance(value, np.ndarray) and _is_frozen(value) and value.dtype == dtype:
        array = value
    else:
        # The order in memory is always by rows, so that an array read from the store equals the original in memory too.
        array = np.array(value, dtype=dtype, order="C")
    if array.shape != shape and (
        array.ndim != len(shape)
        or any(want is not None and have != want for have, want in zip(array.shape, shape, strict=True))
    ):
        raise ValueError(f"{name} has shape {array.shape}; it must have shape {shape}")
    if array.dtype.kind == "f" and np.count_nonzero(np.isfinite(array)) < array.size:
        raise ValueError(f"{name} contains numbers that are not finite")
    array.setflags(write=False)
    return array


def _is_frozen(array: NDArray[Any]) -> bool:
    """Return whether nobody can write to the array.

    Neither the array nor the memory that it shows is writeable.
    """
    if array.flags.writeable or not array.flags.c_contiguous:
        return False
    owner = array.base
    while isinstance(owner, np.ndarray):
        if owner.flags.writeable:
            return False
        owner = owner.base
    return owner is None or isinstance(owner, bytes)


# --- input and result of a segmenter -----------------------------------------------------------------------------------


class FrameSource(Protocol):
    """The frames of one run, decoded one at a time.

    Indexing and iteration can be repeated.
    """

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> NDArray[np.generic]:
        """Return the stored pixels of frame ``index`` (from 0).

        The array has shape (rows, columns) and an unsigned integer type.
        """

    def __iter__(self) -> Iterator[NDArray[np.generic]]: ...


@dataclass(frozen=True, slots=True)
class Shutter:
    """The exposed part of the image, from the shutter or collimator attributes.

    rectangle : (left, right, upper, lower) edges; circle : (centre_u, centre_v, radius); polygon : vertices (u, v); all in
    pixels.
    The field is the intersection of all given shapes.
    """

    rectangle: tuple[float, float, float, float] | None = None
    circle: tuple[float, float, float] | None = None
    polygon: tuple[tuple[float, float], ...] | None = None


@dataclass(frozen=True, slots=True)
class PixelFacts:
    """The meaning of the stored pixel values.

    logarithmic : the logarithm was already applied (PixelIntensityRelationship LOG, DISP or DRM).
    bits_stored : significant bits. monochrome1 : high values are dark, as in MONOCHROME1, and must be inverted first.
    """

    logarithmic: bool
    bits_stored: int
    monochrome1: bool
    shutter: Shutter | None = None


@dataclass(frozen=True, eq=False)
class Run:
    """One cine as a segmenter gets it.

    frames : decoded one at a time. frame_times_ms : (n,), from the first frame on.
    px_per_mm : at the isocentre. r_wave_frames : frames with R waves, where the file has them. content : hash of the file with
    the frames; None where there is no file.
    """

    frames: FrameSource
    frame_times_ms: Array
    px_per_mm: float
    pixels: PixelFacts
    r_wave_frames: tuple[int, ...] = ()
    content: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "frame_times_ms", frozen(self.frame_times_ms, (len(self.frames),), "frame_times_ms"))
        if not self.px_per_mm > 0:
            raise ValueError(f"px_per_mm is {self.px_per_mm}; it must be positive")


@dataclass(frozen=True, eq=False)
class Chain:
    """The electrodes of one catheter in one image.

    electrodes : their numbers, 1 = tip, ascending; a chain set by hand may have only some.
    pixels_uv : (m, 2). covariance_px2 : (m, 2, 2). scores : (m,), contrast over noise.
    kinds : catheter name -> probability (the sum is at most 1); look-alikes share theirs.
    track : chains of one run with the same track number are the same catheter in different frames; -1 without a track.
    manual : set by hand (then ``kinds`` has one name with probability 1).
    tip_odds : log-odds that the numbers begin at the catheter's tip and not at its other end; None where that is no question.
    """

    electrodes: tuple[int, ...]
    pixels_uv: Array
    covariance_px2: Array
    scores: Array
    kinds: tuple[tuple[str, float], ...]
    track: int = -1
    manual: bool = False
    tip_odds: float | None = field(default=None, metadata=ADDED_LATER)

    def __post_init__(self) -> None:
        m = len(self.electrodes)
        if m < 1 or list(self.electrodes) != sorted(set(self.electrodes)) or self.electrodes[0] < 1:
            raise ValueError(f"electrodes are {self.electrodes}; they must be different numbers from 1 on, ascending")
        object.__setattr__(self, "pixels_uv", frozen(self.pixels_uv, (m, 2), "pixels_uv"))
        object.__setattr__(self, "covariance_px2", frozen(self.covariance_px2, (m, 2, 2), "covariance_px2"))
        object.__setattr__(self, "scores", frozen(self.scores, (m,), "scores"))
        if sum(probability for _, probability in self.kinds) > 1 + 1e-6:
            raise ValueError(f"probabilities of kinds {self.kinds} add up to more than 1")
        if self.tip_odds is not None and not math.isfinite(self.tip_odds):
            raise ValueError(f"tip_odds is {self.tip_odds}; it must be finite, or None")

    @functools.cached_property
    def extent_px(self) -> tuple[float, float, float, float]:
        """Left, upper, right and lower edge of the electrodes' places."""
        (left, upper), (right, lower) = self.pixels_uv.min(axis=0).tolist(), self.pixels_uv.max(axis=0).tolist()
        return left, upper, right, lower

    def on_track(self, track: int) -> Chain:
        """Return the same chain with another track number."""
        # The other fields were checked when this chain was made, and tracking renumbers every chain of a run.
        chain = copy.copy(self)
        object.__setattr__(chain, "track", track)
        return chain

    def from_other_end(self, electrodes: int) -> Chain:
        """Return the chain of a catheter with so many electrodes, numbered from the other end."""
        return replace(
            self,
            electrodes=tuple(electrodes + 1 - number for number in reversed(self.electrodes)),
            pixels_uv=self.pixels_uv[::-1],
            covariance_px2=self.covariance_px2[::-1],
            scores=self.scores[::-1],
            tip_odds=None if self.tip_odds is None else -self.tip_odds,
        )

    @property
    def likely_name(self) -> str:
        """Name of the catheter that this most likely is."""
        return max(self.kinds, key=lambda kind: kind[1])[0]

    def probability(self, catheter: str) -> float:
        """Return the probability that this is ``catheter``."""
        return dict(self.kinds).get(catheter, 0.0)


@dataclass(frozen=True, slots=True)
class FrameChains:
    """All chains of one image.

    ``manual_needed`` is the reason why there are none, or why they are uncertain.
    """

    frame: int
    chains: tuple[Chain, ...]
    manual_needed: Reason | None = None


@dataclass(frozen=True, eq=False)
class Segmentation:
    """A segmenter's result for one run.

    frames : one entry per frame of the run, in order.
    diastole : chains in the mean of the quiet frames round diastole; its ``frame`` is the middle one of them. None
    where there is no quiet stretch: then single frames are used.
    diastole_frames : the averaged frames, ascending.
    motion : (n,) change of the image from the previous frame, low-passed, arbitrary unit; the first value repeats the
    second.
    frame_times_ms, r_wave_frames : those of the run, for phase matching.
    """

    frames: tuple[FrameChains, ...]
    diastole: FrameChains | None
    diastole_frames: tuple[int, ...]
    motion: Array
    frame_times_ms: Array
    r_wave_frames: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.frames)
        if [entry.frame for entry in self.frames] != list(range(n)):
            raise ValueError("frames must hold every frame of the run in order")
        object.__setattr__(self, "motion", frozen(self.motion, (n,), "motion"))
        object.__setattr__(self, "frame_times_ms", frozen(self.frame_times_ms, (n,), "frame_times_ms"))


Marks = Mapping[int, tuple[Chain, ...]]
"""Chains set by hand: frame -> the chains of that frame."""


# --- result of matching ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class NamedChain:
    """The electrodes of a named catheter in one image.

    Fields as in :class:`Chain`; ``track`` is -1 where the positions are interpolated between frames.
    """

    catheter: str
    electrodes: tuple[int, ...]
    pixels_uv: Array
    covariance_px2: Array
    track: int = -1

    def __post_init__(self) -> None:
        m = len(self.electrodes)
        object.__setattr__(self, "pixels_uv", frozen(self.pixels_uv, (m, 2), "pixels_uv"))
        object.__setattr__(self, "covariance_px2", frozen(self.covariance_px2, (m, 2, 2), "covariance_px2"))


@dataclass(frozen=True, slots=True)
class Observation:
    """The named catheters of one view at one moment.

    phase : cardiac phase, 0 to 1 from one R wave, or one start of systole, to the next; None where no cycle is known.
    """

    frame: int
    phase: float | None
    chains: tuple[NamedChain, ...]


@dataclass(frozen=True, slots=True)
class PhasePair:
    """The same cardiac phase in both views, usually of different beats."""

    phase: float | None
    a: Observation
    b: Observation


@dataclass(frozen=True, slots=True)
class Alternative:
    """Another way to pair the catheters of a site across its views.

    probability : 0 to 0.5, that this pairing is the right one.
    """

    diastole: PhasePair
    probability: float

    def __post_init__(self) -> None:
        if not 0 <= self.probability <= 0.5:
            raise ValueError(f"the probability of an alternative is {self.probability}; it must lie between 0 and 0.5")


@dataclass(frozen=True, eq=False)
class MatchedRuns:
    """The two runs of a site, with their catheters named in both views.

    diastole : the pair that locates the site. cycle : pairs over the cardiac cycle by rising phase; empty where unknown.
    track_a, track_b : every frame of each run, for tracking in a single view.
    alternative : the next best pairing of the catheters across the views, unless it can be ruled out.
    """

    stored_apart: ClassVar[bool] = True
    """The runs of each site are stored by themselves: a job stores unchanged ones again without decoding them."""

    camera_a: Camera
    camera_b: Camera
    diastole: PhasePair
    cycle: tuple[PhasePair, ...]
    track_a: tuple[Observation, ...]
    track_b: tuple[Observation, ...]
    frame_times_a_ms: Array
    frame_times_b_ms: Array
    alternative: Alternative | None = None


@dataclass(frozen=True, eq=False)
class MatchedSite:
    """One site with its catheters named in both views.

    notes : (catheter, reason) of catheters that are missing or doubtful here. They may change at all sites when a person names a
    catheter at one of them, and then no runs change.
    """

    site: str
    runs: MatchedRuns
    notes: tuple[tuple[str, Reason], ...] = ()


@dataclass(frozen=True, slots=True)
class RejectedSite:
    """A site that could not be located, with the reasons."""

    site: str
    reasons: tuple[Reason, ...]


@dataclass(frozen=True, slots=True)
class Matching:
    """All sites of a study, named and paired, and the rejected ones."""

    sites: tuple[MatchedSite, ...]
    rejected: tuple[RejectedSite, ...]


# --- result of a triangulator ------------------------------------------------------------------------------------------


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


# --- input and result of a monoplane solver ----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class MonoplaneView:
    """One view of one site, to be tracked in 3D.

    frame_times_ms : (n,). observations : one per frame, in order. a_priori : points known from two views, valid in
    ``a_priori_frame``. cycle : the site's own biplane cycle or None. others : cycles of other sites, empty when ``cycle``
    is valid.
    """

    site: str
    view: View
    camera: Camera
    catalogue: Catalogue
    frame_times_ms: Array
    observations: tuple[Observation, ...]
    a_priori: tuple[ElectrodePoint, ...]
    a_priori_frame: int
    cycle: SiteCycle | None
    others: tuple[SiteCycle, ...]

    def __post_init__(self) -> None:
        n = len(self.observations)
        object.__setattr__(self, "frame_times_ms", frozen(self.frame_times_ms, (n,), "frame_times_ms"))
        if not 0 <= self.a_priori_frame < n:
            raise ValueError(f"a_priori_frame is {self.a_priori_frame}, but the run has {n} frames")


@dataclass(frozen=True, eq=False)
class StudyShares:
    """Shares of a track's covariances that grow and shrink with the variation of its study.

    depth_mm2, relative_depth_mm2 : (4, n, m) variance along the ray from breathing, beats, gantry angle and gantry offset, in
    the order of :class:`StudyVariation`. The second is that of positions less the reference's mean. angle_sd_rad, offset_sd_mm :
    error of this view's gantry, which displaces the electrodes across its rays. All have the default variation.
    """

    depth_mm2: Array
    relative_depth_mm2: Array
    angle_sd_rad: float
    offset_sd_mm: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "depth_mm2", frozen(self.depth_mm2, (4, None, None), "depth_mm2"))
        relative = frozen(self.relative_depth_mm2, self.depth_mm2.shape, "relative_depth_mm2")
        object.__setattr__(self, "relative_depth_mm2", relative)


def _symmetric(value: ArrayLike, shape: tuple[int, ...], name: str) -> NDArray[Any]:
    """Return a read-only copy of covariances, each the mean of itself and its transpose."""
    checked = frozen(value, shape, name)
    transposed = np.swapaxes(checked, -1, -2)
    return checked if (checked == transposed).all() else frozen(0.5 * (checked + transposed), shape, name)


@dataclass(frozen=True, eq=False)
class Track:
    """Electrodes in 3D in every frame of one view.

    labels : (catheter, electrode) of each of the m electrodes. located : (n, m), False where there is no position; the
    arrays contain 0 there. positions_mm, baseline_mm : (n, m, 3), the baseline being the plain back-projection at the
    prior's depth. covariance_mm2 : (n, m, 3, 3), from the isocentre. relative_covariance_mm2 : (n, m, 3, 3) of the position
    less the mean of the reference catheter's electrodes in the same frame; None where the solver does not compute it.
    pixels_uv : (n, m, 2) observed. reasons : one tuple for each electrode. shares : None where the solver does not state them.
    The covariances have the default variation; :func:`fluoromap.monoplane.track_samples.in_study` brings them to the study's.
    They are made symmetric bit for bit, which rounding in a solver may prevent; the store keeps their upper halves only.
    """

    labels: tuple[tuple[str, int], ...]
    located: BoolArray
    positions_mm: Array
    baseline_mm: Array
    covariance_mm2: Array
    pixels_uv: Array
    reasons: tuple[tuple[Reason, ...], ...]
    relative_covariance_mm2: Array | None = None
    shares: StudyShares | None = None

    def __post_init__(self) -> None:
        m = len(self.labels)
        object.__setattr__(self, "located", frozen(self.located, (None, m), "located", dtype=np.bool_))
        n = self.located.shape[0]
        object.__setattr__(self, "positions_mm", frozen(self.positions_mm, (n, m, 3), "positions_mm"))
        object.__setattr__(self, "baseline_mm", frozen(self.baseline_mm, (n, m, 3), "baseline_mm"))
        covariance = _symmetric(self.covariance_mm2, (n, m, 3, 3), "covariance_mm2")
        object.__setattr__(self, "covariance_mm2", covariance)
        object.__setattr__(self, "pixels_uv", frozen(self.pixels_uv, (n, m, 2), "pixels_uv"))
        if self.relative_covariance_mm2 is not None:
            relative = _symmetric(self.relative_covariance_mm2, (n, m, 3, 3), "relative_covariance_mm2")
            object.__setattr__(self, "relative_covariance_mm2", relative)
        if len(self.reasons) != m:
            raise ValueError(
                f"there are {len(self.reasons)} tuples of reasons for {m} electrodes; one is needed for each"
            )


# --- input and result of a fuser ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class MappedSite:
    """A located site with its activation time: the input of a fuser.

    tip_mm, covariance_mm2 : the mapping tip relative to the reference catheter. axis : (3,) unit vector along the
    catheter from electrode 2 to the tip. tip_length_mm : of the tip electrode. lat_ms, lat_sd_ms : activation time.
    reasons : why the position deserves less trust.
    """

    site: str
    tip_mm: Array
    covariance_mm2: Array
    axis: Array
    tip_length_mm: float
    lat_ms: float
    lat_sd_ms: float
    reasons: tuple[Reason, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "tip_mm", frozen(self.tip_mm, (3,), "tip_mm"))
        object.__setattr__(self, "covariance_mm2", frozen(self.covariance_mm2, (3, 3), "covariance_mm2"))
        object.__setattr__(self, "axis", frozen(self.axis, (3,), "axis"))
        if not (np.isfinite(self.lat_ms) and np.isfinite(self.lat_sd_ms) and self.lat_sd_ms >= 0):
            raise ValueError(
                f"lat_ms {self.lat_ms} and lat_sd_ms {self.lat_sd_ms} must be finite, lat_sd_ms not negative"
            )


@dataclass(frozen=True, eq=False)
class SurfaceSite:
    """A site on the map.

    position_mm : (3,) the site. surface_mm : (3,) its point on the surface. distance_mm : between the two.
    """

    site: str
    position_mm: Array
    surface_mm: Array
    distance_mm: float
    lat_ms: float
    leave_one_out_error_ms: float | None
    reasons: tuple[Reason, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "position_mm", frozen(self.position_mm, (3,), "position_mm"))
        object.__setattr__(self, "surface_mm", frozen(self.surface_mm, (3,), "surface_mm"))


@dataclass(frozen=True, slots=True)
class ConductionVelocity:
    """Median speed of activation along the wall, with its 95 % interval; metres a second.

    It is measured between sites that lie close together.
    """

    median_m_per_s: float
    low_m_per_s: float
    high_m_per_s: float


@dataclass(frozen=True, eq=False)
class ChamberMap:
    """The chamber's surface with activation times, relative to the reference catheter.

    vertices_mm : (n, 3). faces : (f, 3), outward by the right-hand rule, watertight. lat_ms, lat_sd_ms : (n,), valid where
    ``covered`` (n,); elsewhere no site is near enough and the numbers are 0. earliest : (site, probability), most probable
    first. coverage : covered share of the area, 0..1. conduction_velocity : None where no sites lie close enough.
    cycle_length_ms : of a re-entry: times repeat after it, so that early meets late; None where they do not.
    """

    vertices_mm: Array
    faces: IntArray
    lat_ms: Array
    lat_sd_ms: Array
    covered: BoolArray
    sites: tuple[SurfaceSite, ...]
    earliest: tuple[tuple[str, float], ...]
    total_activation_time_ms: float
    leave_one_out_rms_ms: float | None
    volume_ml: float
    area_cm2: float
    coverage: float
    warnings: tuple[Reason, ...] = field(default=())
    conduction_velocity: ConductionVelocity | None = None
    cycle_length_ms: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices_mm", frozen(self.vertices_mm, (None, 3), "vertices_mm"))
        n = len(self.vertices_mm)
        object.__setattr__(self, "faces", frozen(self.faces, (None, 3), "faces", dtype=np.int64))
        if self.faces.size and not (self.faces.min() >= 0 and self.faces.max() < n):
            raise ValueError(
                f"faces name vertices {self.faces.min()} to {self.faces.max()}, but there are {n} vertices"
            )
        object.__setattr__(self, "lat_ms", frozen(self.lat_ms, (n,), "lat_ms"))
        object.__setattr__(self, "lat_sd_ms", frozen(self.lat_sd_ms, (n,), "lat_sd_ms"))
        object.__setattr__(self, "covered", frozen(self.covered, (n,), "covered", dtype=np.bool_))


# --- the four kinds of stage -------------------------------------------------------------------------------------------


class NoParams(BaseModel, extra="forbid"):
    """The ``Params`` of a stage that has none."""


# A plugin is a class ``PluginClass(params)`` with the method of one of these protocols, used for one subject at a time. It has
# name : as clients write it.
# version : a string that changes whenever the result of the same input changes; results are stored under it.
# Params : a pydantic model with ``extra="forbid"``, and a default and a description for each field.
# A plugin with kernels to compile may have a class method ``warm_up()``: a worker process calls it before it takes work.
# A stage may raise :class:`Refusal`.


@runtime_checkable
class Segmenter(Protocol):
    """Finds the catheters' electrodes in the frames of one run; does not name look-alikes."""

    def segment(self, run: Run, catalogue: Catalogue, marks: Marks, context: Context) -> Segmentation: ...


@runtime_checkable
class Triangulator(Protocol):
    """Locates the named electrodes of all sites of a study in 3D."""

    def triangulate(self, sites: tuple[MatchedSite, ...], catalogue: Catalogue, context: Context) -> Triangulation: ...


@runtime_checkable
class MonoplaneSolver(Protocol):
    """Tracks the electrodes in 3D through one view."""

    def track(self, view: MonoplaneView, context: Context) -> Track: ...


@runtime_checkable
class Fuser(Protocol):
    """Makes surface and map of the located sites."""

    def fuse(self, sites: tuple[MappedSite, ...], context: Context) -> ChamberMap: ...
