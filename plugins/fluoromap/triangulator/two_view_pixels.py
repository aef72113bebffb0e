"""Electrodes that both views of a site show at one moment."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array, NamedChain, PhasePair
from fluoromap.geometry import Camera

Cameras = tuple[Camera, Camera]


@dataclass(frozen=True, eq=False)
class TwoViewPixels:
    """The N electrodes that both views show, at one moment or at several moments (leading axis).

    labels : (catheter, electrode). pixels : (..., N, 2) in view a, view b. covariances : (..., N, 2, 2) in view a, view b,
    px^2.
    """

    labels: tuple[tuple[str, int], ...]
    pixels: tuple[Array, Array]
    covariances: tuple[Array, Array]

    @property
    def catheters(self) -> tuple[str, ...]:
        return tuple(catheter for catheter, _ in self.labels)

    def only(self, labels: Sequence[tuple[str, int]]) -> TwoViewPixels:
        """Return the same moment with these electrodes only, in this order."""
        if tuple(labels) == self.labels:
            return self
        rows = [self.labels.index(label) for label in labels]
        (pa, pb), (ca, cb) = self.pixels, self.covariances
        return TwoViewPixels(tuple(labels), (pa[rows], pb[rows]), (ca[rows], cb[rows]))

    def residuals_px(self, cameras: Cameras, points_world_mm: Array) -> Array:
        """Return pixels minus projected points (..., N, 3), shape (..., 4 N).

        The order is electrode by electrode, each u, v in view a, then u, v in view b.
        """
        apart = [uv - camera.project(points_world_mm) for camera, uv in zip(cameras, self.pixels, strict=True)]
        residuals: Array = np.stack(apart, axis=-2).reshape(*apart[0].shape[:-2], -1)
        return residuals


def pixels_in_both_views(pair: PhasePair) -> TwoViewPixels:
    """Return the electrodes that both views of a pair show."""
    first, second = _labels(pair.a.chains), _labels(pair.b.chains)
    in_a, in_b = _stacked(pair.a.chains), _stacked(pair.b.chains)
    if first != second or len(set(first)) != len(first):
        # Of an electrode that a view shows twice the last place counts.
        at_a, at_b = ({label: row for row, label in enumerate(labels)} for labels in (first, second))
        first = tuple(label for label in at_a if label in at_b)
        in_a, in_b = (
            tuple(part[[at[label] for label in first]] for part in of) for at, of in ((at_a, in_a), (at_b, in_b))
        )
    return TwoViewPixels(first, (in_a[0], in_b[0]), (in_a[1], in_b[1]))


def pixels_of_pairs(pairs: Sequence[PhasePair]) -> list[TwoViewPixels]:
    """Return the electrodes that both views show, for each pair as :func:`pixels_in_both_views`.

    Most pairs of a cycle show the same chains; their pixels are gathered together.
    """
    alike: dict[tuple[tuple[tuple[str, tuple[int, ...]], ...], ...], list[int]] = {}
    for index, pair in enumerate(pairs):
        views = (tuple((chain.catheter, chain.electrodes) for chain in of.chains) for of in (pair.a, pair.b))
        alike.setdefault(tuple(views), []).append(index)
    found: dict[int, TwoViewPixels] = {}
    for members in alike.values():
        first = pairs[members[0]]
        labels = _labels(first.a.chains)
        if labels != _labels(first.b.chains) or len(set(labels)) != len(labels):
            found |= {index: pixels_in_both_views(pairs[index]) for index in members}
            continue
        of_a, of_b = (
            _stacked([chain for index in members for chain in getattr(pairs[index], view).chains])
            for view in ("a", "b")
        )
        (a, sa), (b, sb) = (
            [part.reshape(len(members), len(labels), *part.shape[1:]) for part in of] for of in (of_a, of_b)
        )
        found |= {
            index: TwoViewPixels(labels, (a[row], b[row]), (sa[row], sb[row])) for row, index in enumerate(members)
        }
    return [found[index] for index in range(len(pairs))]


def _labels(chains: Sequence[NamedChain]) -> tuple[tuple[str, int], ...]:
    return tuple(itertools.chain.from_iterable(_labels_of(chain.catheter, chain.electrodes) for chain in chains))


@functools.lru_cache(maxsize=256)
def _labels_of(catheter: str, electrodes: tuple[int, ...]) -> tuple[tuple[str, int], ...]:
    """Return the labels of a chain; hundreds of frames show the same electrodes."""
    return tuple((catheter, electrode) for electrode in electrodes)


def _stacked(chains: Sequence[NamedChain]) -> tuple[Array, ...]:
    """Return the pixels (N, 2) and their covariances (N, 2, 2) of all chains."""
    if not chains:
        return np.zeros((0, 2)), np.zeros((0, 2, 2))
    return np.concatenate([chain.pixels_uv for chain in chains]), np.concatenate(
        [chain.covariance_px2 for chain in chains]
    )
