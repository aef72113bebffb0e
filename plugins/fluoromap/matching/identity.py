"""Names of the look-alikes of a study."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array
from fluoromap.matching.run_catheters import CatheterFacts
from fluoromap.reasons import Reason

CLEARLY_STILLER = 5.0
"""The reference is identified by motion when the log likelihood ratio for it against any look-alike exceeds this."""
_OWN_MM2 = np.geomspace(0.05, 25.0, 12)
"""Variances tried for a catheter's own motion between sites, an axis; the least is from detection and beats alone."""
_OWN_IRREGULAR_MM2 = np.geomspace(0.25, 25.0, 12)
"""The same where the rhythm is irregular: its beats move a catheter at rest by half a millimetre."""
_COMMON_MM2 = np.concatenate([[0.0], np.geomspace(0.1, 1000.0, 13)])
"""Variances tried for the motion of all catheters between sites, an axis: breathing and a moved table."""


@dataclass(frozen=True, eq=False)
class PairedCatheter:
    """One catheter in both views of a site.

    position_mm : (3,) mean of its electrodes at diastole, from the isocentre.
    place : index within its group, the same over all sites of the study. irregular : whether the site's rhythm is irregular.
    """

    a: CatheterFacts
    b: CatheterFacts
    position_mm: Array
    place: int
    irregular: bool = False

    @property
    def manual_name(self) -> str | None:
        """Name set by hand in either view, else None."""
        return self.a.manual_name or self.b.manual_name

    @property
    def motion_px(self) -> float:
        """Mean motion in the two views, pixels."""
        return (self.a.motion_px + self.b.motion_px) / 2


def look_alike_groups(catalogue: Catalogue) -> tuple[tuple[str, ...], ...]:
    """Group the catalogue's names by catheters that look alike, in the catalogue's order."""
    groups: list[list[str]] = []
    for catheter in catalogue.catheters:
        for group in groups:
            if any(catheter.looks_like(catalogue[name]) for name in group):
                group.append(catheter.name)
                break
        else:
            groups.append([catheter.name])
    return tuple(tuple(group) for group in groups)


def name_look_alikes(
    names: tuple[str, ...], reference: str | None, sites: Sequence[Sequence[PairedCatheter]]
) -> tuple[list[list[str]], Reason | None]:
    """Name the catheters of one group of look-alikes at every site.

    Each catheter has a place, the same at all sites. The name of a place is decided as follows:

    1. Names set by hand at any site decide.
    2. Else the reference is the catheter that moves least between the sites. Breathing moves all alike; it is their
       covariance and is subtracted.
    3. With one site only, or where the motion is too similar, the reference is the catheter that moves least within its
       own runs. Then the reason says that two catheters could be exchanged.

    Parameters
    ----------
    names : tuple of str
        Of the group, in the catalogue's order.
    reference : str or None
        The catalogue's reference, in the group or not.
    sites : sequence of sequences
        The paired catheters of this group at each site, at most as many as names.

    Returns
    -------
    list of list of str
        The names, in the order of ``sites``.
    Reason or None
        IDENTITY_BY_MOTION, IDENTITY_UNCERTAIN, or None without doubt.
    """
    if len(names) == 1:
        return [[names[0] for _ in site] for site in sites], None
    places = [[one.place for one in site] for site in sites]
    count = len(names)
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
    order, reason = _assign_names(names, reference, fixed, sites, places, count)
    named = []
    for site, indices in zip(sites, places, strict=True):
        given = [order[index] for index in indices]
        for k, one in enumerate(site):
            wanted = one.manual_name
            if wanted in names and given[k] != wanted:
                # At its own site a name set by hand overrides the name of the place.
                if wanted in given:
                    given[given.index(wanted)] = given[k]
                given[k] = wanted
        named.append(given)
    return named, reason


def _assign_names(
    names: tuple[str, ...],
    reference: str | None,
    fixed: dict[int, str],
    sites: Sequence[Sequence[PairedCatheter]],
    places: list[list[int]],
    count: int,
) -> tuple[dict[int, str], Reason | None]:
    """Return the name of every place, and the remaining doubt.

    Names set by hand are fixed.
    """
    order = dict(fixed)
    shown = {place for indices in places for place in indices}
    free = [place for place in range(count) if place not in order and place in shown]
    left = [name for name in names if name not in order.values()]
    reason: Reason | None = None
    if free and reference is not None and reference in left and len(left) > 1:
        stillest, reason = _stillest(sites, places, free)
        order[stillest] = reference
        free.remove(stillest)
        left.remove(reference)
    if len(left) > 1 and free:
        reason = Reason.IDENTITY_UNCERTAIN
    order.update(zip(free, left, strict=False))
    return order, reason


def _positions_at(sites: Sequence[Sequence[PairedCatheter]], places: list[list[int]], place: int) -> dict[int, Array]:
    """Return site index -> position (3,) of the catheter with this place."""
    return {s: site[places[s].index(place)].position_mm for s, site in enumerate(sites) if place in places[s]}


def stiller(first_mm: Array, second_mm: Array, *, irregular: bool = False) -> float:
    """Return the log likelihood ratio for the first catheter being stiller.

    It compares the motion of each catheter by itself.

    Breathing and the table displace both alike between the sites, by different amounts along each axis. A large common
    displacement hides which of the two moves by itself.

    Parameters
    ----------
    first_mm, second_mm : ndarray, shape (s, 3)
        Diastolic places at the same sites.
    irregular : bool
        Whether the rhythm is irregular at a site.
    """
    own_mm2 = _OWN_IRREGULAR_MM2 if irregular else _OWN_MM2
    both = np.stack([first_mm - first_mm.mean(axis=0), second_mm - second_mm.mean(axis=0)])
    scatter = np.einsum("isx,jsx->xij", both, both)[:, :, :, None, None, None]
    first, second, common = np.meshgrid(own_mm2, own_mm2, _COMMON_MM2, indexing="ij")
    determinant = common * (first + second) + first * second
    misfit = (
        scatter[:, 0, 0] * (common + second) - 2 * scatter[:, 0, 1] * common + scatter[:, 1, 1] * (common + first)
    ) / determinant
    likelihood = -0.5 * ((len(first_mm) - 1) * np.log(determinant) + misfit)
    best = likelihood.max(axis=-1).sum(axis=0)
    less = np.triu_indices(len(own_mm2), 1)
    return float(best[less].max() - best.T[less].max())


def _exchanged(first_mm: Array, second_mm: Array) -> bool:
    """Return whether two catheters seem exchanged at some of the sites (s, 3) against the others.

    Their places follow from site to site by nearness. A table that moved far breaks that, but keeps the catheters apart by the
    same vector.
    """
    apart = first_mm - second_mm
    usual = np.median(apart, axis=0)
    return bool((np.linalg.norm(apart + usual, axis=1) < np.linalg.norm(apart - usual, axis=1)).any())


def _stillest(
    sites: Sequence[Sequence[PairedCatheter]], places: list[list[int]], free: list[int]
) -> tuple[int, Reason]:
    """Return the place in ``free`` whose catheter moves least, and the certainty."""
    shown = [_positions_at(sites, places, place) for place in free]
    together = sorted(set.intersection(*map(set, shown)))
    if len(free) > 1 and len(together) >= 3:
        positions = np.array([[of_place[s] for s in together] for of_place in shown])
        irregular = any(one.irregular for site in sites for one in site)
        for index, place in enumerate(free):
            others = np.delete(positions, index, axis=0)
            if any(_exchanged(positions[index], other) for other in others):
                continue
            if all(stiller(positions[index], other, irregular=irregular) > CLEARLY_STILLER for other in others):
                return place, Reason.IDENTITY_BY_MOTION
    motion = [
        np.mean([site[places[s].index(place)].motion_px for s, site in enumerate(sites) if place in places[s]])
        for place in free
    ]
    return free[int(np.argmin(motion))], Reason.IDENTITY_UNCERTAIN
