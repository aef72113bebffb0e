"""Matching of a whole study: chains of all runs become named, paired, phase-matched catheters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.special import expit

from fluoromap.catheters import Catalogue
from fluoromap.contracts import (
    Alternative,
    Array,
    Chain,
    Context,
    IntArray,
    MatchedRuns,
    MatchedSite,
    Matching,
    NamedChain,
    Observation,
    PhasePair,
    RejectedSite,
    Segmentation,
)
from fluoromap.matching.doubts import (
    gantry_angles,
    geometry_is_doubtful,
    groups_with_extra,
    mirrored_sites,
)
from fluoromap.matching.ends import common_ends
from fluoromap.matching.hypotheses import Hypotheses
from fluoromap.matching.identity import PairedCatheter, look_alike_groups, name_look_alikes
from fluoromap.matching.joint_choice import SiteChoice, choose_pairings
from fluoromap.matching.numberings import Way
from fluoromap.matching.pairs import PairTable
from fluoromap.matching.phase_matching import pair_by_phase, phase_shift
from fluoromap.matching.run_catheters import RunCatheter
from fluoromap.matching.site_comparison import RunInView, SiteComparison, SiteRuns, SiteViews, compare_views, views_of
from fluoromap.reasons import Reason

LEAST_PROBABILITY = 0.02
"""Another pairing with a lower probability counts as ruled out."""
_UNSURE_NUMBERS = 0.1
"""Probability that a catheter's numbers are wrong, above which its identity is uncertain."""


@dataclass(frozen=True, eq=False)
class _ComparedSite:
    """A site whose views can be compared. doubtful : one of them might be mirrored."""

    runs: SiteRuns
    comparison: SiteComparison
    table: PairTable
    hypotheses: Hypotheses
    doubtful: bool


@dataclass(frozen=True, eq=False)
class _NamedSite:
    """A site with named catheters.

    pairs, alternative : name -> chain of view a, of view b. ways : name -> how each of the two is numbered. probability : of the
    alternative. notes : (name, reason of doubt).
    """

    compared: _ComparedSite
    pairs: dict[str, tuple[int, int]]
    ways: dict[str, Way]
    alternative: dict[str, tuple[int, int]] | None
    probability: float
    notes: tuple[tuple[str, Reason], ...]

    def content(self, catalogue: Catalogue) -> tuple[object, ...]:
        """Return everything that the matched runs depend on."""
        # The order of the names is part of the result.
        pairs = tuple(self.pairs.items())
        alternative = None if self.alternative is None else (tuple(self.alternative.items()), self.probability)
        return *self.compared.runs.content, catalogue, pairs, tuple(self.ways.items()), alternative


class _Views:
    """The views of sites by their names, gathered where they are needed: unchanged sites are compared already."""

    def __init__(self) -> None:
        self._known: dict[str, SiteViews | tuple[Reason, ...]] = {}

    def of(self, runs: SiteRuns) -> SiteViews | tuple[Reason, ...]:
        if runs.site not in self._known:
            self._known[runs.site] = views_of(runs)
        return self._known[runs.site]

    def compare(self, runs: SiteRuns, catalogue: Catalogue) -> SiteComparison:
        """Compare the views of a site, or return the reasons why they cannot be compared."""
        views = self.of(runs)
        if not isinstance(views, SiteViews):
            return SiteComparison(views)
        return compare_views(views, (runs.camera_a, runs.camera_b), catalogue)


def match_study(sites: Sequence[SiteRuns], catalogue: Catalogue, context: Context) -> Matching:
    """Name the catheters of all sites, pair them across views and match the phases.

    The mapping catheter is identified by its tip, look-alikes by hand or by their motion over the whole study. A site
    needs its mapping catheter in both views; it does not need the reference catheter. Pairs are chosen over the whole
    study at once. Where another pairing cannot be ruled out at a site, it becomes the site's alternative.

    Parameters
    ----------
    sites : sequence of SiteRuns
        All sites of the study: look-alikes are named from all of them together.
    catalogue : Catalogue
        Of the study.
    context : Context
        For progress and cancellation. It recalls the comparisons and matched runs that did not change.

    Returns
    -------
    Matching
        Every site is either in ``sites`` or, with its reasons, in ``rejected``.
    """
    groups = look_alike_groups(catalogue)
    views = _Views()
    compared: list[tuple[SiteRuns, SiteComparison]] = []
    rejected: list[RejectedSite] = []
    for index, runs in enumerate(sites):
        context.check()
        inputs = (*runs.content, catalogue)
        comparison = context.recall(SiteComparison, inputs, partial(views.compare, runs, catalogue))
        if comparison.reasons:
            rejected.append(RejectedSite(runs.site, comparison.reasons))
        else:
            compared.append((runs, comparison))
        context.progress(0.7 * (index + 1) / len(sites))
    mirrored, maybe = mirrored_sites([comparison.mirrored_gain for _, comparison in compared])
    sound = []
    for (runs, comparison), is_mirrored, is_doubtful in zip(compared, mirrored, maybe, strict=True):
        if is_mirrored:
            rejected.append(RejectedSite(runs.site, (Reason.VIEW_MIRRORED,)))
        else:
            assert comparison.table is not None, "the views were compared"
            assert comparison.hypotheses is not None, "the views were compared"
            sound.append(_ComparedSite(runs, comparison, comparison.table, comparison.hypotheses, is_doubtful))
    matched = []
    for index, named in enumerate(_name_all(sound, groups, catalogue)):
        context.check()
        if catalogue.mapping in named.pairs:
            own = context.recall(MatchedRuns, named.content(catalogue), partial(_matched, named, catalogue, views))
            missing = [(name, Reason.CATHETER_NOT_FOUND) for name in catalogue.names if name not in named.pairs]
            matched.append(MatchedSite(named.compared.runs.site, own, (*missing, *named.notes)))
        else:
            reason = Reason.CATHETER_NOT_FOUND if named.pairs else Reason.PAIRING_FAILED
            rejected.append(RejectedSite(named.compared.runs.site, (reason,)))
        context.progress(0.7 + 0.3 * (index + 1) / len(sound))
    return Matching(tuple(matched), tuple(rejected))


def _name_all(
    sites: Sequence[_ComparedSite], groups: tuple[tuple[str, ...], ...], catalogue: Catalogue
) -> list[_NamedSite]:
    """Pair and name the catheters of all sites."""
    slots = [k for k, group in enumerate(groups) for _ in group]
    alone = (catalogue.mapping,)
    roving = slots.index(groups.index(alone)) if alone in groups else -1
    gantries = [gantry_angles(site.runs.camera_a, site.runs.camera_b) for site in sites]
    choices = choose_pairings([site.hypotheses for site in sites], slots, roving, gantries)
    names: list[list[str]] = [[""] * len(slots) for _ in sites]
    doubts: dict[str, Reason] = {}
    for number, group in enumerate(groups):
        first = slots.index(number)
        places = range(first, first + len(group))
        members = []
        for site, choice in zip(sites, choices, strict=True):
            filled = [slot for slot in places if choice.pairs[slot, 0] >= 0]
            members.append([_paired(site, choice.pairs[slot], slot - first) for slot in filled])
        given, reason = name_look_alikes(group, catalogue.reference, members)
        for at_site, ones, labels in zip(names, members, given, strict=True):
            for one, label in zip(ones, labels, strict=True):
                at_site[first + one.place] = label
            # The alternative may fill a place that is empty in the result; it gets the remaining name.
            left = [name for name in group if name not in at_site]
            for slot in places:
                at_site[slot] = at_site[slot] or left.pop(0)
        if reason is not None:
            doubts.update(dict.fromkeys(group, reason))
    named = [
        _named_site(site, choice, own, doubts, groups, slots)
        for site, choice, own in zip(sites, choices, names, strict=True)
    ]
    for name in catalogue.names:
        named = _with_common_ends(name, named, rests=name != catalogue.mapping)
    return named


def _with_common_ends(name: str, sites: Sequence[_NamedSite], rests: bool) -> list[_NamedSite]:
    """Return the sites with this catheter numbered from one end.

    All sites together say which end. A catheter that does not rest lies differently at each.
    """
    shown = [site for site in sites if name in site.pairs]
    own = [(site.compared.table, site.pairs[name]) for site in shown]
    costs = np.array([table.other_end_cost[pair] for table, pair in own])
    others = np.array([table.other_way_cost[pair] for table, pair in own])
    if not np.isfinite([costs, others]).any():
        return list(sites)
    axes = np.array([table.axis_mm[pair] for table, pair in own])
    wrong, sure = common_ends(axes, costs) if rests else (np.zeros(len(costs), dtype=np.bool_), costs)
    answers = {}
    for site, is_wrong, cost, other in zip(shown, wrong, sure, others, strict=True):
        way, notes = site.ways[name], site.notes
        if is_wrong:
            way = way[0].from_other_end(), way[1].from_other_end()
        if expit(-cost) + expit(-other) > _UNSURE_NUMBERS:
            notes = tuple(dict.fromkeys((*notes, (name, Reason.IDENTITY_UNCERTAIN))))
        answers[site.compared.runs.site] = replace(site, ways={**site.ways, name: way}, notes=notes)
    return [answers.get(site.compared.runs.site, site) for site in sites]


def _paired(site: _ComparedSite, pair: IntArray, place: int) -> PairedCatheter:
    i, j = int(pair[0]), int(pair[1])
    comparison = site.comparison
    return PairedCatheter(
        comparison.catheters_a[i], comparison.catheters_b[j], site.table.position_mm[i, j], place, comparison.irregular
    )


def _named_site(
    site: _ComparedSite,
    choice: SiteChoice,
    names: Sequence[str],
    doubts: dict[str, Reason],
    groups: tuple[tuple[str, ...], ...],
    slots: Sequence[int],
) -> _NamedSite:
    # The order is the catalogue's, so that naming a catheter by hand does not change the results of other sites.
    order = [name for group in groups for name in group]

    def by_name(pairs: IntArray) -> dict[str, tuple[int, int]]:
        found = {name: (int(i), int(j)) for name, (i, j) in zip(names, pairs, strict=True) if i >= 0}
        return {name: found[name] for name in order if name in found}

    pairs = by_name(choice.pairs)
    in_a, in_b = site.comparison.catheters_a, site.comparison.catheters_b
    notes = []
    for name, (i, j) in pairs.items():
        by_hand = in_a[i].manual_name or in_b[j].manual_name
        if name in doubts and by_hand is None:
            notes.append((name, doubts[name]))
    for catheters, used in zip((in_a, in_b), zip(*pairs.values(), strict=True), strict=False):
        unused = [one.manual_name for index, one in enumerate(catheters) if index not in used]
        notes.extend((name, Reason.MARK_NOT_USED) for name in unused if name is not None)
    alternative = None
    if choice.alternative is not None and choice.probability >= LEAST_PROBABILITY:
        alternative = by_name(choice.alternative)
        notes.extend((name, Reason.IDENTITY_UNCERTAIN) for name, pair in pairs.items() if alternative.get(name) != pair)
    if site.doubtful or geometry_is_doubtful(site.table, choice.pairs, site.runs.camera_b.px_per_mm):
        notes.extend((name, Reason.GEOMETRY_DOUBTFUL) for name in pairs)
    for number in groups_with_extra(site.table, choice.pairs, slots, in_a, in_b):
        notes.extend((name, Reason.EXTRA_CATHETER) for name in groups[number] if name in pairs)
    if site.comparison.irregular:
        notes.extend((name, Reason.IRREGULAR_RHYTHM) for name in pairs)
    ways = {name: site.table.way(pair) for name, pair in pairs.items()}
    return _NamedSite(site, pairs, ways, alternative, choice.probability, tuple(dict.fromkeys(notes)))


def _matched(named: _NamedSite, catalogue: Catalogue, views_of_sites: _Views) -> MatchedRuns:
    runs = named.compared.runs
    views = views_of_sites.of(runs)
    assert isinstance(views, SiteViews), "the views were compared"
    a, b = views.a, views.b
    cameras = (runs.camera_a, runs.camera_b)
    phases_b = b.phases
    if views.folded is not None and phases_b is not None:
        phases_b = (phases_b + phase_shift(cameras, views.folded, list(named.pairs.values()))) % 1.0
    in_a, in_b = _in_views((a, b), named.pairs, named.ways)
    track_a, track_b = _track(in_a, a.segmentation, a.phases), _track(in_b, b.segmentation, phases_b)
    alternative = None
    if named.alternative is not None and catalogue.mapping in named.alternative:
        other_ways = {
            name: named.ways[name] if named.pairs.get(name) == pair else named.compared.table.way(pair)
            for name, pair in named.alternative.items()
        }
        other_a, other_b = _in_views((a, b), named.alternative, other_ways)
        alternative = Alternative(_at_diastole(catalogue, other_a, other_b, a.phases, phases_b), named.probability)
    return MatchedRuns(
        camera_a=runs.camera_a,
        camera_b=runs.camera_b,
        diastole=_at_diastole(catalogue, in_a, in_b, a.phases, phases_b),
        cycle=() if views.folded is None else pair_by_phase(track_a, track_b),
        track_a=track_a,
        track_b=track_b,
        frame_times_a_ms=a.segmentation.frame_times_ms,
        frame_times_b_ms=b.segmentation.frame_times_ms,
        alternative=alternative,
    )


def _in_views(
    views: tuple[RunInView, RunInView], pairs: dict[str, tuple[int, int]], ways: dict[str, Way]
) -> tuple[dict[str, RunCatheter], dict[str, RunCatheter]]:
    """Return the catheters of each view by their names, with the right numbers."""
    a, b = (
        {name: ways[name][k].of(view.catheters[pair[k]]) for name, pair in pairs.items()}
        for k, view in enumerate(views)
    )
    return a, b


def _named(name: str, chain: Chain) -> NamedChain:
    return NamedChain(name, chain.electrodes, chain.pixels_uv, chain.covariance_px2, chain.track)


def _phase(phases: Array | None, frame: int) -> float | None:
    return None if phases is None else float(phases[frame])


def _track(named: dict[str, RunCatheter], segmentation: Segmentation, phases: Array | None) -> tuple[Observation, ...]:
    """Return every frame of a run with its named catheters."""
    return tuple(
        Observation(
            frame,
            _phase(phases, frame),
            tuple(_named(name, one.chains[frame]) for name, one in named.items() if frame in one.chains),
        )
        for frame in range(len(segmentation.frames))
    )


def _at_diastole(
    catalogue: Catalogue,
    in_a: dict[str, RunCatheter],
    in_b: dict[str, RunCatheter],
    phases_a: Array | None,
    phases_b: Array | None,
) -> PhasePair:
    """Return the diastolic chains of both views.

    A view's frame is that of the mapping catheter; another catheter may come from another beat.
    """
    views = []
    for named, phases in ((in_a, phases_a), (in_b, phases_b)):
        frame = named[catalogue.mapping].diastole_frame
        chains = tuple(_named(name, one.diastole) for name, one in named.items())
        views.append(Observation(frame, _phase(phases, frame), chains))
    return PhasePair(views[0].phase, views[0], views[1])
