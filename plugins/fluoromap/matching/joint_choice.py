"""Joint choice of the pairings of all sites, with its uncertainty."""

from __future__ import annotations

import itertools
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit, logit

from fluoromap.contracts import Array, BoolArray, IntArray
from fluoromap.matching.hypotheses import PRIOR_TURN, Hypotheses, offset_chi2
from fluoromap.matching.pairs import student_cost

PLACE_SD_MM = 4.0
"""Prior variation of a catheter's diastolic place from site to site, per axis."""
_PLACE_PRIOR_SITES = 3.0
_NEUTRAL = float(student_cost(np.array(3.0), 3))
_ANCHORS_PER_SITE = 6
_ANCHOR_RANGE = 15.0
_ANCHORS_AT_ONCE = 16
"""Anchors whose costs are computed at once, so that a study of hundreds of sites needs little memory."""
_LOG_ODDS_STEP = 0.1
"""Steps of the alternative's log odds. The odds follow from assumed costs, which are known much less accurately."""
_REFINED = 6
_ROUNDS = 3

Turn = tuple[Array, Array]
"""Rotation vector (3,) of view b against view a, radians, and its covariance (3, 3)."""


@dataclass(frozen=True, eq=False)
class SiteChoice:
    """The chosen pairing of one site.

    pairs : (s, 2) chain of view a and of view b in each slot of the catalogue, -1 where empty; over the study, one slot
    of a group of look-alikes contains one catheter.
    alternative : the next best pairing, or None.
    probability : of the alternative, 0 to 0.5.
    """

    pairs: IntArray
    alternative: IntArray | None
    probability: float


@dataclass(frozen=True, eq=False)
class _AtGantry:
    """The hypotheses of all sites taken at the same gantry angles, n of them.

    sites : their indices. rows : (n,) indices within the study. filled, distance_px, variance_px2 : (n, s). turn_px : (n, s, 3).
    fixed_cost, shift_variance_px2 : (n,).
    """

    sites: IntArray
    rows: IntArray
    filled: BoolArray
    distance_px: Array
    variance_px2: Array
    turn_px: Array
    fixed_cost: Array
    shift_variance_px2: Array

    @classmethod
    def of(cls, sites: IntArray, rows: IntArray, hypotheses: Sequence[Hypotheses]) -> _AtGantry:
        """Join the hypotheses of these sites, which are given in the same order."""
        lengths = [len(one.pairs) for one in hypotheses]
        return cls(
            sites,
            rows,
            np.concatenate([one.pairs[:, :, 0] >= 0 for one in hypotheses]),
            np.concatenate([one.distance_px for one in hypotheses]),
            np.concatenate([one.variance_px2 for one in hypotheses]),
            np.concatenate([one.turn_px for one in hypotheses]),
            np.concatenate([one.fixed_cost for one in hypotheses]),
            np.repeat([one.shift_variance_px2 for one in hypotheses], lengths),
        )

    def cost(self, turn: Turn) -> Array:
        """Return the cost (n,) of each hypothesis, see :meth:`Hypotheses.cost`."""
        chi2, count = offset_chi2(
            self.filled, self.distance_px, self.variance_px2, self.turn_px, self.shift_variance_px2, *turn
        )
        cost: Array = self.fixed_cost + student_cost(chi2, count)
        return cost


@dataclass(frozen=True, eq=False)
class _Study:
    """All hypotheses of all sites in one row, N of them.

    at_gantries : the same by the angles of the gantry. resident_slots : the slots of the catheters that stay at their places.
    site : (N,) index of each hypothesis's site.
    """

    sites: tuple[Hypotheses, ...]
    at_gantries: dict[Hashable, _AtGantry]
    resident_slots: tuple[int, ...]
    orders: IntArray
    site: IntArray
    starts: IntArray
    position_mm: Array

    def rows(self, site: int) -> slice:
        return slice(int(self.starts[site]), int(self.starts[site]) + len(self.sites[site].pairs))


@dataclass(frozen=True, eq=False)
class _Configuration:
    """One explanation of the whole study.

    chosen : the row chosen at each site.
    order : the order in which its slots fill the places.
    own_cost : (N,) cost of each row, given the gantry.
    centres_mm, variance_mm2 : of the places.
    cost : over all sites.
    """

    chosen: IntArray
    order: IntArray
    own_cost: Array
    centres_mm: Array
    variance_mm2: Array
    cost: float


def choose_pairings(
    sites: Sequence[Hypotheses], slots: Sequence[int], roving: int, gantries: Sequence[Hashable]
) -> tuple[SiteChoice, ...]:
    """Choose the pairings that make the study as a whole most likely.

    All catheters but the roving one hardly move between the sites. The gantry's angles have the same error at all sites
    with the same angles. So the other sites can rule out a pairing that fits well at its own site.

    Parameters
    ----------
    sites : sequence of Hypotheses
        At least one hypothesis for each site.
    slots : sequence of int
        Group of each slot; slots of one group are look-alikes.
    roving : int
        The slot of the mapping catheter; -1 where it looks like others and cannot be distinguished from them.
    gantries : sequence
        Equal for sites taken at the same gantry angles.
    """
    if not sites:
        return ()
    resident_slots = tuple(slot for slot in range(len(slots)) if slot != roving)
    members = [[k for k, slot in enumerate(resident_slots) if slots[slot] == group] for group in dict.fromkeys(slots)]
    orders = []
    for exchanged in itertools.product(*map(itertools.permutations, members)):
        order = np.empty(len(resident_slots), dtype=np.int64)
        order[[k for own in members for k in own]] = [k for own in exchanged for k in own]
        orders.append(order)
    lengths = [len(one.pairs) for one in sites]
    site_of_row = np.repeat(np.arange(len(sites)), lengths)
    at_gantries = {}
    for gantry in dict.fromkeys(gantries):
        own = np.array([site for site, at in enumerate(gantries) if at == gantry])
        at_gantries[gantry] = _AtGantry.of(
            own, np.flatnonzero(np.isin(site_of_row, own)), [sites[site] for site in own]
        )
    study = _Study(
        tuple(sites), at_gantries, resident_slots, np.array(orders), site_of_row, np.cumsum([0, *lengths[:-1]]),
        np.concatenate([one.position_mm[:, list(resident_slots)] for one in sites]),
    )  # fmt: skip
    found = _configurations(study)
    least = min(one.cost for one in found)
    weights = np.array([np.exp(least - one.cost) for one in found])
    probability = sum(w * _probabilities(study, one) for w, one in zip(weights / weights.sum(), found, strict=True))
    best = min(found, key=lambda one: one.cost)
    place_cost = _place_cost(study, best.centres_mm, best.variance_mm2)
    return tuple(_site_choice(study, site, np.asarray(probability), place_cost) for site in range(len(sites)))


def _configurations(study: _Study) -> list[_Configuration]:
    """Return the most likely explanations of the study.

    The search starts from each site's most likely hypotheses.
    """
    own_cost = _own_cost(study, dict.fromkeys(study.at_gantries, PRIOR_TURN))
    wide = np.full(len(study.resident_slots), PLACE_SD_MM**2)
    anchors: list[int] = []
    for site in range(len(study.sites)):
        rows = study.rows(site)
        near = np.flatnonzero(own_cost[rows] <= own_cost[rows].min() + _ANCHOR_RANGE)[:_ANCHORS_PER_SITE]
        anchors.extend(int(rows.start + row) for row in near)
    totals, chosen = np.empty(len(anchors)), np.empty((len(anchors), len(study.sites)), dtype=np.int64)
    for first in range(0, len(anchors), _ANCHORS_AT_ONCE):
        some = slice(first, first + _ANCHORS_AT_ONCE)
        by_row = own_cost + _place_cost(study, study.position_mm[anchors[some]], wide).min(axis=-1)
        least = np.minimum.reduceat(by_row, study.starts, axis=-1)
        totals[some], chosen[some] = least.sum(axis=-1), _first_rows(study, by_row == least[:, study.site])
    found: dict[tuple[int, ...], _Configuration] = {}
    tried: set[tuple[int, ...]] = set()
    for index in np.argsort(totals, kind="stable"):
        if len(tried) >= _REFINED:
            break
        key = tuple(chosen[index])
        if key not in tried:
            tried.add(key)
            refined = _refine(study, _choose(study, own_cost, study.position_mm[anchors[index]], wide))
            found.setdefault(tuple(refined.chosen), refined)
    return list(found.values())


def _first_rows(study: _Study, wanted: BoolArray) -> IntArray:
    """Return the first row of each site among the wanted ones (..., N).

    Every site has one.
    """
    count = wanted.shape[-1]
    first: IntArray = np.minimum.reduceat(np.where(wanted, np.arange(count), count), study.starts, axis=-1)
    return first


def _own_cost(study: _Study, turns: dict[Hashable, Turn]) -> Array:
    cost = np.empty(len(study.site))
    for gantry, hypotheses in study.at_gantries.items():
        cost[hypotheses.rows] = hypotheses.cost(turns[gantry])
    return cost


def _place_cost(study: _Study, centres_mm: Array, variance_mm2: Array) -> Array:
    """Return the cost (..., N, orders) of the catheters' positions.

    The places are at ``centres_mm`` (..., p, 3).
    """
    apart = ((study.position_mm[:, :, None] - centres_mm[..., None, None, :, :]) ** 2).sum(axis=-1) / variance_mm2
    cost = student_cost(apart, 3) + 1.5 * np.log(variance_mm2 / PLACE_SD_MM**2)
    cost = np.where(np.isfinite(cost), cost, _NEUTRAL)
    each: Array = cost[..., np.arange(len(study.resident_slots)), study.orders].sum(axis=-1)
    return each


def _choose(study: _Study, own_cost: Array, centres_mm: Array, variance_mm2: Array) -> _Configuration:
    """Choose each site's best row, given the gantry and the places."""
    each = own_cost[:, None] + _place_cost(study, centres_mm, variance_mm2)
    by_row = each.min(axis=1)
    least = np.minimum.reduceat(by_row, study.starts)
    chosen = _first_rows(study, by_row == least[study.site])
    cost = float((least - np.log(np.add.reduceat(np.exp(least[study.site] - by_row), study.starts))).sum())
    order = np.argmin(each[chosen], axis=1)
    return _Configuration(chosen, order, own_cost, centres_mm, variance_mm2, cost)


def _refine(study: _Study, configuration: _Configuration) -> _Configuration:
    """Estimate places and gantry, and choose rows, in turns."""
    for _ in range(_ROUNDS):
        turns = {gantry: _fit_turn(configuration, own) for gantry, own in study.at_gantries.items()}
        prior = sum(float(turn @ np.linalg.solve(PRIOR_TURN[1], turn)) / 2 for turn, _ in turns.values())
        positions = _place_positions(study, configuration)
        centres, variance = _places(positions, configuration.centres_mm)
        again = _choose(study, _own_cost(study, turns), centres, variance)
        configuration = _Configuration(
            again.chosen, again.order, again.own_cost, centres, variance, again.cost + prior
        )  # fmt: skip
    return configuration


def _place_positions(study: _Study, configuration: _Configuration) -> Array:
    """Return the positions (sites, places, 3) of the chosen rows' catheters.

    NaN where a catheter is missing.
    """
    positions = np.full((len(study.sites), len(study.resident_slots), 3), np.nan)
    for site, (row, order) in enumerate(zip(configuration.chosen, configuration.order, strict=True)):
        positions[site, study.orders[order]] = study.position_mm[row]
    return positions


def _places(positions: Array, otherwise: Array) -> tuple[Array, Array]:
    """Return centre (p, 3) and variance per axis (p,) of each place.

    ``otherwise`` is the centre of a place that no site shows.
    """
    known = np.isfinite(positions[..., 0])
    count = known.sum(axis=0)
    centres = np.where(
        count[:, None] > 0, np.nansum(positions, axis=0) / np.maximum(count, 1)[:, None], otherwise
    )  # fmt: skip
    # A site far off is paired wrongly; it must not widen the place.
    squares = np.nansum(np.minimum((positions - centres) ** 2, (2 * PLACE_SD_MM) ** 2), axis=(0, 2))
    variance = (3 * _PLACE_PRIOR_SITES * PLACE_SD_MM**2 + squares) / (3 * (_PLACE_PRIOR_SITES + count))
    return centres, variance


def _fit_turn(configuration: _Configuration, own: _AtGantry) -> Turn:
    """Estimate the rotation of view b against view a at these gantry angles.

    The estimate is a ridge regression on the chosen pairs' distances.
    """
    normal, pull = np.linalg.inv(PRIOR_TURN[1]), np.zeros(3)
    rows = np.searchsorted(own.rows, configuration.chosen[own.sites])
    counts = own.filled[rows].sum(axis=1)
    for count in range(2, own.filled.shape[1] + 1):
        alike = rows[counts == count]
        slots = np.nonzero(own.filled[alike])[1].reshape(-1, count)
        at = alike[:, None], slots
        slopes, distance = own.turn_px[at], own.distance_px[at]
        spread = own.variance_px2[at][:, :, None] * np.eye(count) + own.shift_variance_px2[alike, None, None]
        weighted = np.linalg.solve(spread, slopes)
        normal = normal + (np.swapaxes(slopes, 1, 2) @ weighted).sum(axis=0)
        pull = pull + (np.swapaxes(weighted, 1, 2) @ distance[..., None]).sum(axis=0)[:, 0]
    covariance = np.linalg.inv(normal)
    return covariance @ pull, covariance


def _probabilities(study: _Study, configuration: _Configuration) -> Array:
    """Return the probability (N,) of each row at its site.

    The places are those of the other sites.
    """
    positions = _place_positions(study, configuration)
    probability = np.empty(len(study.site))
    for site in range(len(study.sites)):
        rows = study.rows(site)
        others = np.delete(positions, site, axis=0)
        nowhere = np.full_like(configuration.centres_mm, np.nan)
        centres, variance = _places(others, nowhere) if len(others) else (nowhere, configuration.variance_mm2)
        own = _Study(
            (study.sites[site],), {}, study.resident_slots, study.orders, study.site[rows], np.zeros(1, dtype=np.int64),
            study.position_mm[rows],
        )  # fmt: skip
        cost = configuration.own_cost[rows] + _place_cost(own, centres, variance).min(axis=1)
        likelihood = np.exp(cost.min() - cost)
        probability[rows] = likelihood / likelihood.sum()
    return probability


def _site_choice(study: _Study, site: int, probability: Array, place_cost: Array) -> SiteChoice:
    """Return the choice at a site; ``place_cost`` (N, orders) is that of the best explanation."""
    rows = study.rows(site)
    one, own = study.sites[site], probability[rows]
    row = int(np.argmax(own))
    filled = (one.pairs[:, :, 0] >= 0).sum(axis=1)
    others = own * (filled == filled[row])
    others[row] = -1.0
    second = int(np.argmax(others))
    cost = place_cost[rows]
    answer = _in_order(study, one, row, int(np.argmin(cost[row])))
    if others[second] <= 0:
        return SiteChoice(answer, None, 0.0)
    alternative = _in_order(study, one, second, int(np.argmin(cost[second])))
    return SiteChoice(answer, alternative, _on_grid(float(min(others[second], 0.5))))


def _on_grid(probability: float) -> float:
    """Return the nearest probability whose logarithm of odds is a whole number of steps.

    The places of the other sites determine it a little. So a correction at one site changes no other site, unless it changes the
    odds there.
    """
    return float(expit(_LOG_ODDS_STEP * round(float(logit(probability)) / _LOG_ODDS_STEP)))


def _in_order(study: _Study, one: Hypotheses, row: int, order: int) -> IntArray:
    """Return the pairs of a row with each look-alike at its place."""
    pairs: IntArray = one.pairs[row].copy()
    resident_slots = np.array(study.resident_slots, dtype=np.int64)
    pairs[resident_slots[study.orders[order]]] = one.pairs[row][resident_slots]
    return pairs
