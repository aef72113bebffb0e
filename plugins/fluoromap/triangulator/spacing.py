"""Located electrode spacings compared with the catalogue's."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array
from fluoromap.triangulator.two_view_pixels import TwoViewPixels

STUDY_LIMIT_MM = 0.75
"""Difference between a spacing's median over the study and the catalogue's above which the catalogue is wrong."""
DOUBT_LIMIT_MM = 0.4
"""Difference above which the image contradicts the catalogue. A bent shaft or a tip's centre explains smaller ones."""
_CHANCE_SD = 4.0


@dataclass(frozen=True, slots=True)
class Gap:
    """Two electrodes of a catheter, with their distance in the study and in the catalogue."""

    first: int
    second: int
    located_mm: float
    catalogue_mm: float


@functools.lru_cache(maxsize=256)
def neighbours(labels: tuple[tuple[str, int], ...], catalogue: Catalogue) -> tuple[tuple[int, int, float], ...]:
    """Return pairs of successive electrodes of a catheter.

    Most sites of a study show the same electrodes.

    Returns
    -------
    tuple of (int, int, float)
        Indices of the two electrodes in ``labels``, and the catalogue's distance between them in mm.
    """
    found = []
    for name in catalogue.names:
        along = catalogue[name].arc_lengths_mm
        own = sorted(
            (electrode, i) for i, (catheter, electrode) in enumerate(labels)
            if catheter == name and electrode <= len(along)
        )  # fmt: skip
        for (first, i), (second, j) in itertools.pairwise(own):
            found.append((i, j, float(along[second - 1] - along[first - 1])))
    return tuple(found)


def spacing_mismatches(
    points_mm: Array, labels: tuple[tuple[str, int], ...], catalogue: Catalogue, limit_mm: float
) -> set[int]:
    """Return the indices of electrodes whose distance from a neighbour is not the catalogue's.

    Neighbours are successive located electrodes of one catheter.
    """
    found: set[int] = set()
    points = points_mm.tolist()
    for i, j, gap in neighbours(labels, catalogue):
        if abs(math.dist(points[i], points[j]) - gap) > limit_mm:
            found |= {i, j}
    return found


@dataclass(frozen=True, slots=True)
class StudyGap:
    """The distance between two electrodes of a catheter over a study.

    chance_mm : difference from the catalogue's distance that chance explains.
    """

    catheter: str
    gap: Gap
    chance_mm: float


@dataclass(frozen=True, eq=False)
class SiteGaps:
    """The distances between neighbours at one site.

    labels : (catheter, electrode, next electrode) of the g distances. located_mm, catalogue_mm : (g,). variance_mm2 : (g,) of the
    located distances, from pixel noise.
    """

    labels: tuple[tuple[str, int, int], ...]
    located_mm: Array
    catalogue_mm: Array
    variance_mm2: Array


NO_GAPS = SiteGaps((), np.zeros(0), np.zeros(0), np.zeros(0))


def site_gaps(pixels: TwoViewPixels, points_mm: Array, joint_mm2: Array, catalogue: Catalogue) -> SiteGaps:
    """Return the distances between the neighbours of a site.

    Parameters
    ----------
    points_mm : ndarray, shape (N, 3)
    joint_mm2 : ndarray, shape (N, 3, N, 3)
        Covariance of the points from pixel noise.
    """
    pairs = neighbours(pixels.labels, catalogue)
    i, j = np.array([pair[:2] for pair in pairs], dtype=np.intp).reshape(-1, 2).T
    apart = points_mm[i] - points_mm[j]
    lengths = np.linalg.norm(apart, axis=1)
    spread = joint_mm2[i, :, i] + joint_mm2[j, :, j] - joint_mm2[i, :, j] - joint_mm2[j, :, i]
    variances = np.einsum("ka,kab,kb->k", apart, spread, apart) / np.maximum(lengths, 1e-9) ** 2
    labels = tuple((*pixels.labels[first], pixels.labels[second][1]) for first, second, _ in pairs)
    return SiteGaps(labels, lengths, np.array([gap for *_, gap in pairs], dtype=np.float64), variances)


def study_gaps(sites: Sequence[SiteGaps]) -> list[StudyGap]:
    """Return the median of each gap over the sites of a study.

    One site's spacing may be wrong by chance; the median over the study is not.
    """
    found: dict[tuple[str, int, int], list[tuple[float, float, float]]] = {}
    for site in sites:
        of_site = zip(site.located_mm.tolist(), site.variance_mm2.tolist(), site.catalogue_mm.tolist(), strict=True)
        for label, measured in zip(site.labels, of_site, strict=True):
            found.setdefault(label, []).append(measured)
    gaps = []
    for (name, one, other), of_sites in found.items():
        values = np.array(of_sites)
        located = Gap(one, other, float(np.median(values[:, 0])), float(values[0, 2]))
        gaps.append(StudyGap(name, located, _CHANCE_SD * float(np.sqrt(values[:, 1].mean() / len(values)))))
    return gaps


def wrong_spacings(gaps: Sequence[StudyGap], limit_mm: float) -> dict[str, list[Gap]]:
    """Return the catheters with gaps that differ from the catalogue's by more than ``limit_mm``."""
    wrong: dict[str, list[Gap]] = {}
    for of_study in gaps:
        gap = of_study.gap
        if abs(gap.located_mm - gap.catalogue_mm) > max(limit_mm, of_study.chance_mm):
            wrong.setdefault(of_study.catheter, []).append(gap)
    return wrong
