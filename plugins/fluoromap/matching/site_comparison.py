"""Comparison of the chains of a site's two views."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Hashable
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
from fluoromap.matching.run_catheters import RunCatheter, gather
from fluoromap.matching.two_view import PARALLEL_BELOW_DEG
from fluoromap.reasons import Reason


@dataclass(frozen=True)
class SiteRuns:
    """The segmented runs of one site.

    A segmentation is None where the segmenter failed.
    content : names the segmentations and cameras, for example by the hashes of their stored form: equal only where
    these are equal. None where the caller does not know.
    """

    site: str
    camera_a: Camera
    camera_b: Camera
    segmentation_a: Segmentation | None
    segmentation_b: Segmentation | None
    content: Hashable | None = None


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
class ComparedSite:
    """A site whose chains are compared across its views but not yet paired.

    mirrored_gain : see :func:`~fluoromap.matching.doubts.mirrored_gain`. doubtful : one of its views might be mirrored.
    """

    runs: SiteRuns
    a: RunInView
    b: RunInView
    folded: tuple[FoldedRun, FoldedRun] | None
    table: PairTable
    hypotheses: Hypotheses
    mirrored_gain: float
    doubtful: bool = False


class SiteComparisons:
    """Earlier comparisons of sites, by their content.

    The caller of :func:`~fluoromap.matching.match_study` owns this object. With it only new or changed sites are
    compared, for example after a correction. Sites without ``content`` are not stored.
    """

    def __init__(self, most: int = 64) -> None:
        self._most = most
        self._stored: OrderedDict[Hashable, ComparedSite | tuple[Reason, ...]] = OrderedDict()
        self._lock = threading.Lock()

    def compare(self, runs: SiteRuns, catalogue: Catalogue) -> ComparedSite | tuple[Reason, ...]:
        """Return the stored comparison of a site, or compare its views."""
        if runs.content is None:
            return compare_views(runs, catalogue)
        key = (runs.site, runs.content, catalogue)
        with self._lock:
            comparison = self._stored.get(key)
        if comparison is None:
            comparison = compare_views(runs, catalogue)
        with self._lock:
            self._stored[key] = comparison
            self._stored.move_to_end(key)
            while len(self._stored) > self._most:
                self._stored.popitem(last=False)
        return comparison


def compare_views(runs: SiteRuns, catalogue: Catalogue) -> ComparedSite | tuple[Reason, ...]:
    """Compare the chains of a site's two views.

    Returns
    -------
    ComparedSite or tuple of Reason
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

    # The motion cost is computed once: a mirror hardly changes how catheters move across the epipolar lines.
    motion_cost = motion_misfit((runs.camera_a, runs.camera_b), folded, len(a.catheters), len(b.catheters))
    groups = look_alike_groups(catalogue)
    slots = [k for k, group in enumerate(groups) for _ in group]

    def compare(camera_a: Camera, camera_b: Camera) -> tuple[PairTable, Hypotheses]:
        table = pair_table((camera_a, camera_b), a.catheters, b.catheters, motion_cost, catalogue, groups)
        return table, enumerate_pairings(table, slots, runs.camera_b.px_per_mm)

    table, hypotheses = compare(runs.camera_a, runs.camera_b)
    mirrored = [compare(mirror(runs.camera_a), runs.camera_b)[1], compare(runs.camera_a, mirror(runs.camera_b))[1]]
    return ComparedSite(runs, a, b, folded, table, hypotheses, mirrored_gain(hypotheses, mirrored))


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
