"""Motion of an electrode predicted from the cycles of other sites: a field over place and phase."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array
from fluoromap.monoplane.cycle_prior import CycleCurve

_RIDGE = 0.3
_SCALE_MM = 30.0
_ALONE_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class Displacements:
    """Displacements of electrodes since one moment of the cycle.

    moved_mm : (n, m, 3). velocity_mm : (n, m, 3), mm a cycle. sd_mm : (n, m) an axis, deviation of sites from the
    prediction of the others.
    """

    moved_mm: Array
    velocity_mm: Array
    sd_mm: Array


def displacements(
    curves: Sequence[CycleCurve],
    labels: Sequence[tuple[str, int]],
    places_mm: Array,
    phases: Array,
    start: float,
    roving: str,
) -> Displacements:
    """Predict the displacements of electrodes at ``places_mm`` (m, 3) from phase ``start`` to ``phases`` (n,).

    The roving catheter follows the field d(phase, place) = a + B place, a ridge regression over the roving electrodes
    of all curves. A resting catheter moves as at the other sites on average. Leaving out each site in turn measures the
    spread.

    Parameters
    ----------
    curves : sequence of CycleCurve
        Cycles of other sites. A catheter that is in none of them keeps its place, with an infinite ``sd_mm``.
    labels : sequence of (catheter, electrode)
        Labels of the m electrodes.
    roving : str
        Name of the mapping catheter.
    """
    n, m = len(phases), len(labels)
    moved, velocity, sd = np.zeros((n, m, 3)), np.zeros((n, m, 3)), np.full((n, m), np.inf)
    at = np.concatenate([[start], phases])
    for catheter in dict.fromkeys(name for name, _ in labels):
        own = [index for index, (name, _) in enumerate(labels) if name == catheter]
        wanted = None if catheter == roving else [labels[index][1] for index in own]
        sites = [site for curve in curves if (site := _site(curve, catheter, at, wanted)) is not None]
        if not sites:
            continue
        predict = _predict_from_field if catheter == roving else _predict_from_average
        both = predict(sites, places_mm[own])
        moved[:, own], velocity[:, own] = both[:n], both[n:]
        if len(sites) > 1:
            misses = [
                (predict([*sites[:k], *sites[k + 1 :]], place) - path)[:n].mean(axis=1)
                for k, (place, path) in enumerate(sites)
            ]
            spread = np.sqrt(np.mean(np.square(misses), axis=(0, 2)))
        else:
            # A single site does not show how much sites differ.
            spread = _ALONE_SHARE * np.sqrt((both[:n] ** 2).mean(axis=(1, 2)))
        sd[:, own] = spread[:, None]
    return Displacements(moved, velocity, sd)


Site = tuple[Array, Array]
"""Places (k, 3) of a catheter's electrodes, and their displacements and velocities there (t, k, 3)."""


def _site(curve: CycleCurve, catheter: str, at: Array, wanted: Sequence[int] | None) -> Site | None:
    """Return a catheter's displacements and velocities at one site.

    The displacements are from the first phase of ``at`` to the others; the velocities at the others follow.

    The electrodes are those of the site, or the numbers ``wanted``; the site's neighbours are interpolated for numbers
    that it lacks.
    """
    rows = sorted((electrode, row) for row, (name, electrode) in enumerate(curve.labels) if name == catheter)
    if not rows:
        return None
    own = [row for _, row in rows]
    places, slopes = curve.positions_mm(at)[:, own], curve.velocities_mm(at[1:])[:, own]
    paths = np.concatenate([places[1:] - places[0], slopes])
    if wanted is None:
        return places[0], paths
    numbers = np.array([electrode for electrode, _ in rows], dtype=np.float64)
    shares = np.array([np.interp(wanted, numbers, unit) for unit in np.eye(len(numbers))])
    return np.einsum("km,ki->mi", shares, places[0]), np.einsum("km,tki->tmi", shares, paths)


def _predict_from_field(sites: Sequence[Site], places_mm: Array) -> Array:
    """Predict paths (t, m, 3) by ridge regression on place."""
    known = np.concatenate([place for place, _ in sites])
    done = np.concatenate([path for _, path in sites], axis=1)
    middle = known.mean(axis=0)
    design = _design(known - middle)
    penalty = _RIDGE * np.diag([0.0, 1.0, 1.0, 1.0])
    gain = np.linalg.solve(design.T @ design + penalty, design.T)
    found: Array = np.einsum("mf,fk,tki->tmi", _design(places_mm - middle), gain, done, optimize=True)
    return found


def _predict_from_average(sites: Sequence[Site], places_mm: Array) -> Array:
    """Return the mean path (t, m, 3) of each electrode over the sites; ``places_mm`` is not used."""
    mean: Array = np.mean([path for _, path in sites], axis=0)
    return mean


def _design(places_mm: Array) -> Array:
    return np.concatenate([np.ones((len(places_mm), 1)), places_mm / _SCALE_MM], axis=1)
