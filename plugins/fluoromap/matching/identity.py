"""Which paired catheter is which of the catalogue."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array
from fluoromap.geometry import Camera
from fluoromap.matching.pairs import COST_LIMIT_MM, Pair, common_points, spacing_misfit_mm
from fluoromap.matching.run_catheters import RunCatheter
from fluoromap.reasons import Reason

LEAST_VOTE = 0.15
"""A catheter is not given a name that fewer votes speak for."""
CLEARLY_STILLER = 0.6
"""The reference is told by motion when its variance between sites is below this share of any look-alike's."""
POSITION_VARIANCE_MM2 = 0.3
"""Of a catheter's diastolic place for other causes than moving between sites: detection, beat to beat."""


@dataclass(frozen=True, eq=False)
class PairedCatheter:
    """One catheter in both views of a site. position_mm : (3,) mean of its electrodes at diastole, from the isocentre."""

    a: RunCatheter
    b: RunCatheter
    position_mm: Array
    misfit_mm: dict[str, float]
    cost_px: float

    @property
    def manual_name(self) -> str | None:
        return self.a.manual_name or self.b.manual_name

    @property
    def motion_px(self) -> float:
        return (self.a.motion_px + self.b.motion_px) / 2

    def vote(self, names: Sequence[str]) -> float:
        """Probability that it is one of these, voted over the frames of both views; certain where named by hand."""
        if self.manual_name is not None:
            return float(self.manual_name in names)
        return float(np.mean([sum(run.votes.get(name, 0.0) for name in names) for run in (self.a, self.b)]))


def paired_catheter(
    camera_a: Camera, camera_b: Camera, a: RunCatheter, b: RunCatheter, pair: Pair, catalogue: Catalogue
) -> PairedCatheter:
    """Gather what tells the identity of a pair."""
    electrodes, points = common_points(camera_a, camera_b, a.diastole, b.diastole)
    misfit = {catheter.name: spacing_misfit_mm(points, electrodes, catheter) for catheter in catalogue.catheters}
    return PairedCatheter(a, b, points.mean(axis=0), misfit, pair.cost_px)


def look_alike_groups(catalogue: Catalogue) -> tuple[tuple[str, ...], ...]:
    """The catalogue's names in groups that fluoroscopy cannot tell apart, each in the catalogue's order."""
    groups: list[list[str]] = []
    for catheter in catalogue.catheters:
        for group in groups:
            if any(catheter.looks_like(catalogue[name]) for name in group):
                group.append(catheter.name)
                break
        else:
            groups.append([catheter.name])
    return tuple(tuple(group) for group in groups)


def assign_groups(
    paired: Sequence[PairedCatheter], groups: Sequence[tuple[str, ...]], px_per_mm: float
) -> list[tuple[str, ...] | None]:
    """Group of each paired catheter, by votes, spacing and pairing cost; None for one too many.

    The mapping catheter is told here, by its tip: that is what a segmenter's probabilities of kinds rest on.
    """
    slots = [group for group in groups for _ in group]
    if not paired:
        return []
    limit_px = COST_LIMIT_MM * px_per_mm
    score = np.array(
        [
            [
                np.log(max(one.vote(group), 1e-3)) - min(one.misfit_mm[name] for name in group) - one.cost_px / limit_px
                for group in slots
            ]
            for one in paired
        ]
    )
    answer: list[tuple[str, ...] | None] = [None] * len(paired)
    for row, column in zip(*linear_sum_assignment(-score), strict=True):
        if paired[int(row)].vote(slots[int(column)]) >= LEAST_VOTE:
            answer[int(row)] = slots[int(column)]
    return answer


def name_look_alikes(
    names: tuple[str, ...], reference: str, sites: Sequence[Sequence[PairedCatheter]]
) -> tuple[list[list[str]], Reason | None]:
    """Names of the catheters of one group of look-alikes at every site, and what to say about it.

    They are followed from site to site by place. Names given by hand at any site decide; else, where the reference is
    among them, it is the one that moves least between the sites once breathing, which moves all alike and so is their
    covariance, is taken off. Where that does not tell (one site, or a tie) the one that moves least through its own
    runs is taken, and the answer says that they could be exchanged.

    Parameters
    ----------
    names : tuple of str
        Of the group, in the catalogue's order.
    reference : str
        The catalogue's reference, in the group or not.
    sites : sequence of sequences
        The paired catheters of this group at each site, at most as many as names.

    Returns
    -------
    list of list of str
        The names, as the catheters stand in ``sites``.
    Reason or None
        IDENTITY_BY_MOTION, IDENTITY_UNCERTAIN, or None where nothing is in doubt.
    """
    if len(names) == 1:
        return [[names[0] for _ in site] for site in sites], None
    places = _follow_places(sites)
    count = max((len(site) for site in sites), default=0)
    by_hand = np.zeros((count, len(names)))
    for site, indices in zip(sites, places, strict=True):
        for one, index in zip(site, indices, strict=True):
            if one.manual_name in names:
                by_hand[index, names.index(one.manual_name)] += 1
    fixed = {
        int(place): names[column]
        for place, column in zip(*linear_sum_assignment(-by_hand), strict=True)
        if by_hand[place, column] > 0
    }
    order, reason = _complete(names, reference, fixed, sites, places, count)
    named = []
    for site, indices in zip(sites, places, strict=True):
        given = [order[index] for index in indices]
        for k, one in enumerate(site):
            wanted = one.manual_name
            if wanted in names and given[k] != wanted:
                # At its own site a name set by hand holds even against the place it has elsewhere.
                if wanted in given:
                    given[given.index(wanted)] = given[k]
                given[k] = wanted
        named.append(given)
    return named, reason


def _complete(
    names: tuple[str, ...],
    reference: str,
    fixed: dict[int, str],
    sites: Sequence[Sequence[PairedCatheter]],
    places: list[list[int]],
    count: int,
) -> tuple[dict[int, str], Reason | None]:
    """Name of every place, those by hand kept, and the doubt that is left."""
    order = dict(fixed)
    free = [place for place in range(count) if place not in order]
    left = [name for name in names if name not in order.values()]
    reason: Reason | None = None
    if free and reference in left and len(left) > 1:
        stillest, reason = _stillest(sites, places, free)
        order[stillest] = reference
        free.remove(stillest)
        left.remove(reference)
    if len(left) > 1 and free:
        reason = Reason.IDENTITY_UNCERTAIN
    order.update(zip(free, left, strict=False))
    return order, reason


def _follow_places(sites: Sequence[Sequence[PairedCatheter]]) -> list[list[int]]:
    """For each site the place (0..) of each catheter, by nearness to where the catheters are on average."""
    count = max((len(site) for site in sites), default=0)
    if count == 0:
        return [[] for _ in sites]
    anchor = next(site for site in sites if len(site) == count)
    centres = np.array([one.position_mm for one in anchor])
    places: list[list[int]] = []
    for _ in range(5):
        places = []
        for site in sites:
            if not site:
                places.append([])
                continue
            positions = np.array([one.position_mm for one in site])
            cost = np.linalg.norm(positions[:, None] - centres[None], axis=2)
            places.append([int(column) for column in linear_sum_assignment(cost)[1]])
        for place in range(count):
            there = _positions_at(sites, places, place)
            if there:
                centres[place] = np.mean(list(there.values()), axis=0)
    return places


def _positions_at(sites: Sequence[Sequence[PairedCatheter]], places: list[list[int]], place: int) -> dict[int, Array]:
    """Site index -> position (3,) of the catheter that stands in this place there."""
    return {s: site[places[s].index(place)].position_mm for s, site in enumerate(sites) if place in places[s]}


def _stillest(
    sites: Sequence[Sequence[PairedCatheter]], places: list[list[int]], free: list[int]
) -> tuple[int, Reason]:
    """The place, among ``free``, whose catheter moves least, and how sure that is."""
    shown = [set(_positions_at(sites, places, place)) for place in free]
    together = sorted(set.intersection(*shown))
    if len(free) > 1 and len(together) >= 3:
        positions = np.array([[_positions_at(sites, places, place)[s] for s in together] for place in free])
        centred = positions - positions.mean(axis=1, keepdims=True)
        covariance = np.einsum("isx,jsx->ij", centred, centred) / (len(together) - 1)
        shared = (covariance.sum(axis=1) - np.diag(covariance)) / (len(free) - 1)
        own = np.maximum(np.diag(covariance) - shared, 0.0) + POSITION_VARIANCE_MM2
        first, second = np.argsort(own)[:2]
        if own[first] < CLEARLY_STILLER * own[second]:
            return free[int(first)], Reason.IDENTITY_BY_MOTION
    motion = [
        np.mean([site[places[s].index(place)].motion_px for s, site in enumerate(sites) if place in places[s]])
        for place in free
    ]
    return free[int(np.argmin(motion))], Reason.IDENTITY_UNCERTAIN
