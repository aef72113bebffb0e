"""A site's electrodes over the cardiac cycle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, PhasePair, SiteCycle
from fluoromap.triangulator.estimate import Method
from fluoromap.triangulator.seen import Cameras, TwoViewPixels, seen_in_both
from fluoromap.triangulator.uncertainty import Motion, UncertaintyParams, error_sources, pixel_noise_px2, seen_breathing

IN_MOST_PAIRS = 0.8
"""An electrode belongs to the site's cycle when both views show it at this share of the moments."""
FEWEST_MOMENTS = 4
_HARMONICS = 5
_SMOOTHNESS = 1e-3


class CycleMoments:
    """The moments of the cycle at which both views show the same electrodes, and how those move.

    labels : (catheter, electrode). phases : (p,), rising. moments : what is seen at each. positions_mm : (p, m, 3), each
    electrode located on its own.
    """

    def __init__(self, phases: Array, moments: Sequence[TwoViewPixels], positions_mm: Array) -> None:
        self.labels = moments[0].labels
        self.phases = phases
        self.moments = tuple(moments)
        self.positions_mm = positions_mm
        self._coefficients = _fit(phases, positions_mm)

    def motion(self, phase: float, diastolic_phase: float, labels: Sequence[tuple[str, int]]) -> Motion:
        """How these electrodes move at ``phase``; one that the cycle does not know moves as the others do on average."""
        displaced = np.einsum("k,kmc->mc", (_waves([phase]) - _waves([diastolic_phase]))[0], self._coefficients)
        velocity = np.einsum("k,kmc->mc", _waves([phase], derivative=True)[0], self._coefficients)
        known = [self.labels.index(label) if label in self.labels else -1 for label in labels]
        return Motion(*(np.vstack([of, of.mean(axis=0)])[known] for of in (displaced, velocity)))


def cycle_moments(pairs: Sequence[PhasePair], cameras: Cameras, method: Method) -> CycleMoments | None:
    """The moments of a site's cycle; None where too few show its electrodes."""
    moments = [(pair.phase, seen_in_both(pair)) for pair in pairs if pair.phase is not None]
    counts: dict[tuple[str, int], int] = {}
    for _, pixels in moments:
        for label in pixels.labels:
            counts[label] = counts.get(label, 0) + 1
    labels = tuple(label for label, count in counts.items() if count >= IN_MOST_PAIRS * len(moments))
    whole: dict[float, TwoViewPixels] = {}
    for phase, pixels in moments:
        # Beats told by R waves repeat phase 0; one moment of each phase is enough.
        if phase not in whole and set(labels) <= set(pixels.labels):
            whole[phase] = pixels.only(labels)
    if not labels or len(whole) < FEWEST_MOMENTS:
        return None
    phases = np.array(sorted(whole))
    seen = [whole[phase] for phase in phases]
    positions = method.start(cameras, _all_in_one(seen)).reshape(len(seen), len(labels), 3)
    return CycleMoments(phases, seen, positions)


def _all_in_one(moments: Sequence[TwoViewPixels]) -> TwoViewPixels:
    """The electrodes of all moments as if seen at one: located each on its own, that is many times faster."""
    pixels = [np.concatenate([moment.pixels[view] for moment in moments]) for view in (0, 1)]
    covariances = [np.concatenate([moment.covariances[view] for moment in moments]) for view in (0, 1)]
    labels = tuple(label for moment in moments for label in moment.labels)
    return TwoViewPixels(labels, (pixels[0], pixels[1]), (covariances[0], covariances[1]))


def locate_cycle(
    moments: CycleMoments,
    diastolic_phase: float,
    cameras: Cameras,
    catalogue: Catalogue,
    params: UncertaintyParams,
    method: Method,
    gantry_covariance: Array,
) -> SiteCycle:
    """The electrodes at every moment, with a covariance that grows where the heart moves fast."""
    positions, covariances = [], []
    for phase, pixels, start in zip(moments.phases, moments.moments, moments.positions_mm, strict=True):
        motion = moments.motion(float(phase), diastolic_phase, moments.labels)
        sources = error_sources(cameras, start, pixels.labels, catalogue, params, gantry_covariance, motion)
        noise = pixel_noise_px2(pixels.covariances)
        errors = noise + sum(source.pixels_px2() for source in sources)
        seen = seen_breathing(cameras, start, params)
        found = method.estimate(cameras, pixels, start, noise + seen.pixels_px2())
        positions.append(found.points_mm)
        covariances.append(np.einsum("iaib->iab", found.covariance_mm2(errors)))
    return SiteCycle(moments.phases, moments.labels, np.array(positions), np.array(covariances))


def _fit(phases: Array, positions_mm: Array) -> Array:
    """Coefficients (k, m, 3) of a smooth cycle through positions (p, m, 3): for its velocity, not for the answer."""
    waves = _waves(phases)
    order = np.concatenate([[0], np.repeat(np.arange(1, _HARMONICS + 1), 2)])
    # Gaps in the cycle leave the high harmonics free: motion that is not needed is not there.
    ridge = _SMOOTHNESS * len(phases) * np.diag(order.astype(np.float64) ** 2)
    flat = positions_mm.reshape(len(phases), -1)
    coefficients = np.linalg.solve(waves.T @ waves + ridge, waves.T @ flat)
    return np.asarray(coefficients.reshape(-1, *positions_mm.shape[1:]), dtype=np.float64)


def _waves(phases: ArrayLike, derivative: bool = False) -> Array:
    """1, cos and sin of the harmonics at phases (p,), or their derivatives by phase, shape (p, k)."""
    angle = 2 * np.pi * np.asarray(phases, dtype=np.float64)[:, None] * np.arange(1, _HARMONICS + 1)
    rate = 2 * np.pi * np.arange(1, _HARMONICS + 1)
    pairs = (-rate * np.sin(angle), rate * np.cos(angle)) if derivative else (np.cos(angle), np.sin(angle))
    first = np.full((len(angle), 1), 0.0 if derivative else 1.0)
    waves: Array = np.concatenate([first, np.stack(pairs, axis=2).reshape(len(angle), -1)], axis=1)
    return waves
