"""Distances between a catheter's electrodes that are the same in every frame."""

from __future__ import annotations

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array
from fluoromap.monoplane.gaussian_path import Lengths

_NEIGHBOUR_SD_MM = 0.1
_NEXT_BUT_ONE_SD_MM = 0.4
_BELIEVED_MM = 0.5


def catheter_lengths(catalogue: Catalogue, labels: tuple[tuple[str, int], ...], expected_mm: Array) -> Lengths:
    """Return the lengths between neighbours and next-but-one electrodes of each catheter.

    - Neighbours get the catalogue's distance where the expected positions (n, m, 3) agree with it to 0.5 mm.
    - Other neighbours, and next-but-one electrodes on a shaft that may bend, get the expected distance with a larger
      standard deviation.
    """
    first, second, lengths, sds = [], [], [], []
    for name in dict.fromkeys(catheter for catheter, _ in labels):
        along = catalogue[name].arc_lengths_mm
        own = sorted((electrode, index) for index, (catheter, electrode) in enumerate(labels) if catheter == name)
        for step in (1, 2):
            for (low, i), (high, j) in zip(own, own[step:], strict=False):
                expected = np.linalg.norm(expected_mm[:, i] - expected_mm[:, j], axis=1)
                nominal = float(along[high - 1] - along[low - 1])
                strict = high == low + 1 and abs(float(np.median(expected)) - nominal) < _BELIEVED_MM
                first.append(i)
                second.append(j)
                lengths.append(np.full(len(expected), nominal) if strict else expected)
                sds.append(_NEIGHBOUR_SD_MM if strict else _NEXT_BUT_ONE_SD_MM)
    columns = np.array(lengths).reshape(len(first), len(expected_mm)).T
    return Lengths(np.array(first, dtype=np.int64), np.array(second, dtype=np.int64), columns, np.array(sds))
