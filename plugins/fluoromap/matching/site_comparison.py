"""Comparison of the chains of a site's two views."""

from __future__ import annotations

from dataclasses import dataclass

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, Segmentation
from fluoromap.geometry import Camera, ray_angle_deg
from fluoromap.matching.doubts import mirror, mirrored_gain
from fluoromap.matching.hypotheses import Hypotheses, enumerate_pairings
from fluoromap.matching.identity import look_alike_groups
from fluoromap.matching.pairs import PairTable, pair_table
from fluoromap.matching.phase import cardiac_phases
from fluoromap.matching.phase_matching import FoldedRun, fold, motion_misfit
from fluoromap.matching.run_catheters import CatheterFacts, RunCatheter, gather
from fluoromap.matching.two_view import PARALLEL_BELOW_DEG
from fluoromap.reasons import Reason


@dataclass(frozen=True)
class SiteRuns:
    """The segmented runs of one site.

    A segmentation is None where the segmenter failed.
    """

    site: str
    camera_a: Camera
    camera_b: Camera
    segmentation_a: Segmentation | None
    segmentation_b: Segmentation | None

    @property
    def content(self) -> tuple[object, ...]:
        """Everything that a comparison of the two views depends on."""
        return self.camera_a, self.camera_b, self.segmentation_a, self.segmentation_b


@dataclass(frozen=True, eq=False)
class RunInView:
    """One run of a site with its phases and its unnamed catheters.

    phases : (n,) of the frames, None where unknown. phase_uncertainty : see :class:`~fluoromap.matching.phase.Rhythm`.
    """

    segmentation: Segmentation
    phases: Array | None
    irregular: bool
    phase_uncertainty: float
    catheters: tuple[RunCatheter, ...]


@dataclass(frozen=True, eq=False)
class SiteViews:
    """The two runs of a site; ``folded`` is their motion over one cycle, None without phases."""

    a: RunInView
    b: RunInView
    folded: tuple[FoldedRun, FoldedRun] | None


@dataclass(frozen=True, eq=False)
class SiteComparison:
    """All that the study needs to know about a site's chains, compared across its views but not yet paired.

    reasons : why the views cannot be compared; then the other fields are empty. catheters_a, catheters_b : of each view.
    mirrored_gain : see :func:`~fluoromap.matching.doubts.mirrored_gain`.
    """

    reasons: tuple[Reason, ...] = ()
    catheters_a: tuple[CatheterFacts, ...] = ()
    catheters_b: tuple[CatheterFacts, ...] = ()
    irregular: bool = False
    table: PairTable | None = None
    hypotheses: Hypotheses | None = None
    mirrored_gain: float = 0.0


def views_of(runs: SiteRuns) -> SiteViews | tuple[Reason, ...]:
    """Gather the catheters of a site's two runs, with the phases of the frames.

    Returns
    -------
    SiteViews or tuple of Reason
        The reasons why the views cannot be compared.
    """
    if runs.segmentation_a is None or runs.segmentation_b is None:
        return (Reason.PLUGIN_FAILED,)
    if ray_angle_deg(runs.camera_a, runs.camera_b) < PARALLEL_BELOW_DEG:
        return (Reason.VIEWS_PARALLEL,)
    a, b = _run_in_view(runs.segmentation_a, runs.camera_a), _run_in_view(runs.segmentation_b, runs.camera_b)
    if not a.catheters or not b.catheters:
        empty = [view.segmentation for view in (a, b) if not view.catheters]
        reasons = [reason for segmentation in empty for reason in _segmenter_reasons(segmentation)]
        return tuple(dict.fromkeys(reasons or [Reason.NO_ELECTRODES]))
    folded = None
    if a.phases is not None and b.phases is not None:
        folded = (
            fold(a.catheters, a.phases, a.phase_uncertainty),
            fold(b.catheters, b.phases, b.phase_uncertainty),
        )
    return SiteViews(a, b, folded)


def compare_views(views: SiteViews, cameras: tuple[Camera, Camera], catalogue: Catalogue) -> SiteComparison:
    """Compare the chains of a site's two views."""
    a, b = views.a, views.b
    # The motion cost is computed once: a mirror hardly changes how catheters move across the epipolar lines.
    motion_cost = motion_misfit(cameras, views.folded, len(a.catheters), len(b.catheters))
    groups = look_alike_groups(catalogue)
    slots = [k for k, group in enumerate(groups) for _ in group]

    def compare(camera_a: Camera, camera_b: Camera) -> tuple[PairTable, Hypotheses]:
        table = pair_table((camera_a, camera_b), a.catheters, b.catheters, motion_cost, catalogue, groups)
        return table, enumerate_pairings(table, slots, cameras[1].px_per_mm)

    table, hypotheses = compare(*cameras)
    mirrored = [compare(mirror(cameras[0]), cameras[1])[1], compare(cameras[0], mirror(cameras[1]))[1]]
    return SiteComparison(
        catheters_a=tuple(one.facts for one in a.catheters),
        catheters_b=tuple(one.facts for one in b.catheters),
        irregular=a.irregular or b.irregular,
        table=table,
        hypotheses=hypotheses,
        mirrored_gain=mirrored_gain(hypotheses, mirrored),
    )


def _segmenter_reasons(segmentation: Segmentation) -> list[Reason]:
    """Return the segmenter's reason for a run without electrodes.

    The reason of the diastolic mean comes first.
    """
    entries = [segmentation.diastole] if segmentation.diastole is not None else []
    reasons = [entry.manual_needed for entry in [*entries, *segmentation.frames] if entry.manual_needed is not None]
    return reasons[:1]


def _run_in_view(segmentation: Segmentation, camera: Camera) -> RunInView:
    catheters = gather(segmentation, None, camera.px_per_mm)
    beats = cardiac_phases(segmentation, catheters)
    if beats is None:
        return RunInView(segmentation, None, False, 0.5, catheters)
    # With the phase, a catheter that is missing at diastole can be taken from the same moment of another beat.
    catheters = gather(segmentation, beats.phases, camera.px_per_mm)
    return RunInView(segmentation, beats.phases, beats.irregular, beats.phase_uncertainty, catheters)
