"""Matching of a whole study: from the chains of every run to named, paired, phase-matched catheters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fluoromap.catheters import Catalogue
from fluoromap.contracts import (
    Array,
    Chain,
    Context,
    MatchedSite,
    Matching,
    NamedChain,
    Observation,
    PhasePair,
    RejectedSite,
    Segmentation,
)
from fluoromap.geometry import Camera, ray_angle_deg
from fluoromap.matching.cycle import align_phases, pair_by_phase
from fluoromap.matching.identity import (
    PairedCatheter,
    assign_groups,
    look_alike_groups,
    name_look_alikes,
    paired_catheter,
)
from fluoromap.matching.pairs import pair_chains
from fluoromap.matching.phase import cardiac_phases
from fluoromap.matching.run_catheters import RunCatheter, gather
from fluoromap.matching.two_view import PARALLEL_BELOW_DEG
from fluoromap.reasons import Reason


@dataclass(frozen=True, eq=False)
class SiteRuns:
    """The two runs of one site as the segmenter left them; None where it failed."""

    site: str
    camera_a: Camera
    camera_b: Camera
    segmentation_a: Segmentation | None
    segmentation_b: Segmentation | None


@dataclass(frozen=True, eq=False)
class _ViewOfSite:
    """One run of a site on its way: its phases and its unnamed catheters."""

    segmentation: Segmentation
    phases: Array | None
    catheters: tuple[RunCatheter, ...]


@dataclass(frozen=True, eq=False)
class _PairedSite:
    """A site whose catheters are paired across its views but not yet all named."""

    runs: SiteRuns
    a: _ViewOfSite
    b: _ViewOfSite
    paired: tuple[PairedCatheter, ...]
    groups: tuple[tuple[str, ...] | None, ...]


def match_study(sites: Sequence[SiteRuns], catalogue: Catalogue, context: Context) -> Matching:
    """Name the catheters of all sites, pair them across each site's views and match the views by cardiac phase.

    The mapping catheter is told by its tip, look-alikes by hand or by motion over the whole study. A site needs its
    mapping catheter in both views; one without the reference catheter is matched all the same.

    Parameters
    ----------
    sites : sequence of SiteRuns
        All sites of the study: look-alikes are named from all of them together.
    catalogue : Catalogue
        Of the study.
    context : Context
        For progress and cancellation.

    Returns
    -------
    Matching
        Every site is either in ``sites`` or, with its reasons, in ``rejected``.
    """
    groups = look_alike_groups(catalogue)
    paired: list[_PairedSite] = []
    rejected: list[RejectedSite] = []
    for index, runs in enumerate(sites):
        context.check()
        answer = _pair_site(runs, catalogue, groups)
        if isinstance(answer, _PairedSite):
            paired.append(answer)
        else:
            rejected.append(RejectedSite(runs.site, answer))
        context.progress(0.7 * (index + 1) / len(sites))
    names, notes = _name_all(paired, groups, catalogue)
    matched = []
    for index, site in enumerate(paired):
        context.check()
        if catalogue.mapping in names[index]:
            matched.append(_matched(site, names[index], notes, catalogue))
        else:
            rejected.append(RejectedSite(site.runs.site, (Reason.CATHETER_NOT_FOUND,)))
        context.progress(0.7 + 0.3 * (index + 1) / len(paired))
    return Matching(tuple(matched), tuple(rejected))


def _pair_site(
    runs: SiteRuns, catalogue: Catalogue, groups: tuple[tuple[str, ...], ...]
) -> _PairedSite | tuple[Reason, ...]:
    """The site with its catheters paired, or why it cannot be."""
    if runs.segmentation_a is None or runs.segmentation_b is None:
        return (Reason.PLUGIN_FAILED,)
    if ray_angle_deg(runs.camera_a, runs.camera_b) < PARALLEL_BELOW_DEG:
        return (Reason.VIEWS_PARALLEL,)
    a, b = _view(runs.segmentation_a, runs.camera_a), _view(runs.segmentation_b, runs.camera_b)
    if not a.catheters or not b.catheters:
        empty = [view.segmentation for view in (a, b) if not view.catheters]
        told = [reason for segmentation in empty for reason in _told(segmentation)]
        return tuple(dict.fromkeys(told or [Reason.NO_ELECTRODES]))
    pairs = pair_chains(
        runs.camera_a,
        runs.camera_b,
        [one.diastole for one in a.catheters],
        [one.diastole for one in b.catheters],
        catalogue,
    )
    if not pairs:
        return (Reason.PAIRING_FAILED,)
    found = tuple(
        paired_catheter(runs.camera_a, runs.camera_b, a.catheters[pair.a], b.catheters[pair.b], pair, catalogue)
        for pair in pairs
    )
    return _PairedSite(runs, a, b, found, tuple(assign_groups(found, groups, runs.camera_b.px_per_mm)))


def _told(segmentation: Segmentation) -> list[Reason]:
    """What the segmenter said about a run without electrodes; the diastolic mean's word counts most."""
    entries = [segmentation.diastole] if segmentation.diastole is not None else []
    reasons = [entry.manual_needed for entry in [*entries, *segmentation.frames] if entry.manual_needed is not None]
    return reasons[:1]


def _view(segmentation: Segmentation, camera: Camera) -> _ViewOfSite:
    catheters = gather(segmentation, None, camera.px_per_mm)
    phases = cardiac_phases(segmentation, catheters)
    if phases is not None:
        # Knowing the phase, a catheter that is missing at diastole can be taken from the same moment of another beat.
        catheters = gather(segmentation, phases, camera.px_per_mm)
    return _ViewOfSite(segmentation, phases, catheters)


def _name_all(
    paired: list[_PairedSite], groups: tuple[tuple[str, ...], ...], catalogue: Catalogue
) -> tuple[list[dict[str, PairedCatheter]], dict[str, Reason]]:
    """For each site name -> catheter, and for names in doubt the reason."""
    names: list[dict[str, PairedCatheter]] = [{} for _ in paired]
    notes: dict[str, Reason] = {}
    for group in groups:
        members = [[one for one, own in zip(site.paired, site.groups, strict=True) if own == group] for site in paired]
        given, reason = name_look_alikes(group, catalogue.reference, members)
        for at_site, ones, labels in zip(names, members, given, strict=True):
            at_site.update(zip(labels, ones, strict=True))
        if reason is not None:
            notes.update(dict.fromkeys(group, reason))
    return names, notes


def _matched(
    site: _PairedSite, names: dict[str, PairedCatheter], doubts: dict[str, Reason], catalogue: Catalogue
) -> MatchedSite:
    runs, a, b = site.runs, site.a, site.b
    track_a = _track({name: one.a for name, one in names.items()}, a.segmentation, a.phases)
    phases_b = b.phases
    track_b = _track({name: one.b for name, one in names.items()}, b.segmentation, phases_b)
    if a.phases is not None and phases_b is not None:
        told = min(len(a.segmentation.r_wave_frames), len(b.segmentation.r_wave_frames)) >= 1
        if not told:
            phases_b = align_phases(runs.camera_a, runs.camera_b, track_a, track_b)
            track_b = _track({name: one.b for name, one in names.items()}, b.segmentation, phases_b)
        cycle = pair_by_phase(track_a, track_b)
    else:
        cycle = ()
    observation_a = _at_diastole(catalogue, {name: one.a for name, one in names.items()}, a.phases)
    observation_b = _at_diastole(catalogue, {name: one.b for name, one in names.items()}, phases_b)
    missing = [(name, Reason.CATHETER_NOT_FOUND) for name in catalogue.names if name not in names]
    doubtful = [(name, doubts[name]) for name in names if name in doubts and names[name].manual_name is None]
    return MatchedSite(
        site=runs.site,
        camera_a=runs.camera_a,
        camera_b=runs.camera_b,
        diastole=PhasePair(observation_a.phase, observation_a, observation_b),
        cycle=cycle,
        track_a=track_a,
        track_b=track_b,
        frame_times_a_ms=a.segmentation.frame_times_ms,
        frame_times_b_ms=b.segmentation.frame_times_ms,
        notes=(*missing, *doubtful),
    )


def _named(name: str, chain: Chain) -> NamedChain:
    return NamedChain(name, chain.electrodes, chain.pixels_uv, chain.covariance_px2)


def _phase(phases: Array | None, frame: int) -> float | None:
    return None if phases is None else float(phases[frame])


def _track(named: dict[str, RunCatheter], segmentation: Segmentation, phases: Array | None) -> tuple[Observation, ...]:
    """Every frame of a run with its named catheters."""
    return tuple(
        Observation(
            frame,
            _phase(phases, frame),
            tuple(_named(name, one.chains[frame]) for name, one in named.items() if frame in one.chains),
        )
        for frame in range(len(segmentation.frames))
    )


def _at_diastole(catalogue: Catalogue, named: dict[str, RunCatheter], phases: Array | None) -> Observation:
    """The diastolic chains; the frame is the mapping catheter's, should another's have come from another beat."""
    frame = named[catalogue.mapping].diastole_frame
    return Observation(frame, _phase(phases, frame), tuple(_named(name, one.diastole) for name, one in named.items()))
