"""Ellipses of catheters whose shape changes from frame to frame by more than the ellipses say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fluoromap.contracts import Array, Chain, FrameChains
from fluoromap.segmenter.shape.chain_axes import axes_of_chain

_FEWEST, _LEAST_TRIPLES = 3, 3
_MEDIAN_CHI2 = 0.4549
"""Median of the square of a standard normal variable."""
_MOST_MM = 2.0
"""How far a chain may be from the middle between the frames before and after. What moves more unsteadily may change its shape."""
_LEAST_LEFT = 0.1
"""Share of an electrode's variance that a linear function leaves, from which on the electrode says something."""
_TINY = 1e-9


def widen_by_jitter(
    entries: Sequence[FrameChains], diastole: Sequence[Chain], px_per_mm: float
) -> tuple[tuple[FrameChains, ...], tuple[Chain, ...]]:
    """Return a run's chains, with wider ellipses where the shape of a track jitters.

    A catheter bends smoothly in time: its shape in one frame is nearly the mean of those before and after. What remains is error
    of the places, and the ellipses foretell its size. Where it is larger, all ellipses of the track grow by that ratio, along
    the catheter and across it. They never shrink: errors that are the same in successive frames do not show. Chains that were
    set by hand keep their ellipses.

    Parameters
    ----------
    entries : sequence of FrameChains
        One for each frame.
    diastole : sequence of Chain
        The chains at diastole, with the numbers of their tracks.
    px_per_mm : float
        At the isocentre.

    Returns
    -------
    entries, diastole : tuple of FrameChains, tuple of Chain
    """
    tracks: dict[int, dict[int, Chain]] = {}
    for entry in entries:
        for chain in entry.chains:
            if not chain.manual:
                tracks.setdefault(chain.track, {})[entry.frame] = chain
    factors = {track: _factors(chains, px_per_mm) for track, chains in tracks.items()}

    def widen(chains: Sequence[Chain]) -> tuple[Chain, ...]:
        return tuple(
            chain if chain.manual or chain.track not in factors else _widened(chain, factors[chain.track])
            for chain in chains
        )

    return tuple(replace(entry, chains=widen(entry.chains)) for entry in entries), widen(diastole)


def _factors(track: dict[int, Chain], px_per_mm: float) -> Array:
    """Return the factors of a track's standard deviations, (2,).

    Along the catheter and across it, at least 1.
    """
    triples = []
    for frame, chain in track.items():
        before, after = track.get(frame - 1), track.get(frame + 1)
        if before is None or after is None or len(chain.electrodes) < _FEWEST:
            continue
        if before.electrodes == chain.electrodes == after.electrodes:
            jitter = chain.pixels_uv - 0.5 * (before.pixels_uv + after.pixels_uv)
            if np.linalg.norm(jitter.mean(axis=0)) <= _MOST_MM * px_per_mm:
                covariance = chain.covariance_px2 + 0.25 * (before.covariance_px2 + after.covariance_px2)
                triples.append(_over_expected(chain.pixels_uv, jitter, covariance))
    if len(triples) < _LEAST_TRIPLES:
        return np.ones(2)
    of_all: Array = np.median(np.concatenate(triples), axis=0)
    factors: Array = np.sqrt(np.maximum(of_all / _MEDIAN_CHI2, 1.0))
    return factors


def _over_expected(places_uv: Array, jitter: Array, covariance: Array) -> Array:
    """Return the squares of a shape's jitter over their expectation, (electrodes, 2).

    Along the catheter, and across it. Displacement, turning and a change of foreshortening are no jitter: they are linear in
    the arc.
    """
    axes = axes_of_chain(places_uv)
    expected = np.einsum("nai,nij,naj->na", axes, covariance, axes)
    weight = 1.0 / np.sqrt(expected.sum(axis=1))
    steps = np.linalg.norm(np.diff(places_uv, axis=0), axis=1)
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    linear, _ = np.linalg.qr(weight[:, None] * np.column_stack([np.ones_like(arc), arc / max(arc[-1], _TINY)]))
    weighted = weight[:, None] * jitter
    left = (weighted - linear @ (linear.T @ weighted)) / weight[:, None]
    share_left = 1.0 - (linear * linear).sum(axis=1)
    decides = share_left > _LEAST_LEFT
    squares: Array = np.einsum("nai,ni->na", axes, left)[decides] ** 2 / (expected * share_left[:, None])[decides]
    return squares


def _widened(chain: Chain, factors: Array) -> Chain:
    if len(chain.electrodes) < 2 or not (factors > 1.0).any():
        return chain
    axes = axes_of_chain(chain.pixels_uv)
    scale = np.einsum("nai,a,naj->nij", axes, factors, axes)
    covariance = scale @ chain.covariance_px2 @ scale
    return replace(chain, covariance_px2=0.5 * (covariance + covariance.transpose(0, 2, 1)))
