"""Electrodes that both views of a site show at one moment."""

from __future__ import annotations

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
    first, second = _by_label(pair.a.chains), _by_label(pair.b.chains)
    labels = tuple(label for label in first if label in second)

    def stack(of: dict[tuple[str, int], tuple[Array, Array]], part: int, shape: tuple[int, ...]) -> Array:
        return np.array([of[label][part] for label in labels]).reshape(len(labels), *shape)

    return TwoViewPixels(
        labels,
        (stack(first, 0, (2,)), stack(second, 0, (2,))),
        (stack(first, 1, (2, 2)), stack(second, 1, (2, 2))),
    )


def _by_label(chains: Sequence[NamedChain]) -> dict[tuple[str, int], tuple[Array, Array]]:
    return {
        (chain.catheter, electrode): (pixel, covariance)
        for chain in chains
        for electrode, pixel, covariance in zip(chain.electrodes, chain.pixels_uv, chain.covariance_px2, strict=True)
    }
