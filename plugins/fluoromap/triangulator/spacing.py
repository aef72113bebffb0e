"""Located electrode spacings compared with the catalogue's."""

from __future__ import annotations

import itertools
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
class WrongGap:
    """Two electrodes of a catheter whose distance in the study differs from the catalogue's."""

    first: int
    second: int
    located_mm: float
    catalogue_mm: float


def neighbours(labels: Sequence[tuple[str, int]], catalogue: Catalogue) -> list[tuple[int, int, float]]:
    """Return pairs of successive electrodes of a catheter.

    Returns
    -------
    list of (int, int, float)
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
    return found


def spacing_mismatches(
    points_mm: Array, labels: Sequence[tuple[str, int]], catalogue: Catalogue, limit_mm: float
) -> set[int]:
    """Return the indices of electrodes whose distance from a neighbour is not the catalogue's.

    Neighbours are successive located electrodes of one catheter.
    """
    found: set[int] = set()
    for i, j, gap in neighbours(labels, catalogue):
        if abs(float(np.linalg.norm(points_mm[i] - points_mm[j])) - gap) > limit_mm:
            found |= {i, j}
    return found


def wrong_spacings(
    sites: Sequence[tuple[TwoViewPixels, Array, Array]], catalogue: Catalogue, limit_mm: float
) -> dict[str, list[WrongGap]]:
    """Return the catheters with gaps that differ from the catalogue's by more than ``limit_mm``.

    Parameters
    ----------
    sites : sequence of (pixels, points (N, 3) in mm, their covariance (N, 3, N, 3) from pixel noise)
        All sites of the study. One site's spacing may be wrong by chance; the median over the study is not.
    """
    found: dict[tuple[str, int, int], list[tuple[float, float, float]]] = {}
    for pixels, points, joint in sites:
        for i, j, gap in neighbours(pixels.labels, catalogue):
            apart = points[i] - points[j]
            length = float(np.linalg.norm(apart))
            spread = joint[i, :, i] + joint[j, :, j] - joint[i, :, j] - joint[j, :, i]
            variance = float(apart @ spread @ apart) / max(length, 1e-9) ** 2
            (name, first), (_, second) = pixels.labels[i], pixels.labels[j]
            found.setdefault((name, first, second), []).append((length, variance, gap))
    wrong: dict[str, list[WrongGap]] = {}
    for (name, first, second), lengths in found.items():
        values = np.array(lengths)
        median, gap = float(np.median(values[:, 0])), float(values[0, 2])
        chance_mm = _CHANCE_SD * float(np.sqrt(values[:, 1].mean() / len(values)))
        if abs(median - gap) > max(limit_mm, chance_mm):
            wrong.setdefault(name, []).append(WrongGap(first, second, median, gap))
    return wrong
