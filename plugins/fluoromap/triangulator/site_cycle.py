"""A site's electrodes over the cardiac cycle."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, PhasePair, SiteCycle
from fluoromap.triangulator.estimate import Method
from fluoromap.triangulator.table_motion import Jump, jump_source
from fluoromap.triangulator.two_view_pixels import Cameras, TwoViewPixels, pixels_of_pairs
from fluoromap.triangulator.uncertainty import (
    Motion,
    UncertaintyParams,
    bend_covariances_px2,
    common_sources,
    jacobians,
    visible_breathing,
)

IN_MOST_PAIRS = 0.8
"""Share of the moments at which both views must show an electrode for it to belong to the site's cycle."""
FEWEST_MOMENTS = 4
NO_CYCLE = SiteCycle(np.zeros(0), (), np.zeros((0, 0, 3)), np.zeros((0, 0, 3, 3)))
"""The cycle of a site whose views show too few moments."""
_HARMONICS = 5
_SMOOTHNESS = 1e-3


class CycleMoments:
    """The moments of the cycle at which both views show the same electrodes, and their motion.

    phases : (p,), rising. pixels : m electrodes at each of the p moments. positions_mm : (p, m, 3) world, each electrode
    located separately.
    """

    def __init__(self, phases: Array, pixels: TwoViewPixels, positions_mm: Array) -> None:
        self.labels = pixels.labels
        self.phases = phases
        self.pixels = pixels
        self.positions_mm = positions_mm
        self._coefficients = _fit(phases, positions_mm)

    def motion(self, phases: Array, diastolic_phase: float, labels: Sequence[tuple[str, int]]) -> Motion:
        """Return the motion of these electrodes at phases (...).

        An electrode that is not part of the cycle gets the mean motion of the others.
        """
        displaced = np.einsum("...k,kmc->...mc", _waves(phases) - _waves(diastolic_phase), self._coefficients)
        velocity = np.einsum("...k,kmc->...mc", _waves(phases, derivative=True), self._coefficients)
        known = [self.labels.index(label) if label in self.labels else -1 for label in labels]
        return Motion(
            *(
                np.concatenate([of, of.mean(axis=-2, keepdims=True)], axis=-2)[..., known, :]
                for of in (displaced, velocity)
            )
        )


def cycle_moments(pairs: Sequence[PhasePair], cameras: Cameras, method: Method) -> CycleMoments | None:
    """Return the moments of a site's cycle; None where too few show its electrodes."""
    timed = [(pair.phase, pair) for pair in pairs if pair.phase is not None]
    pixels_of = pixels_of_pairs([pair for _, pair in timed])
    moments = [(phase, pixels) for (phase, _), pixels in zip(timed, pixels_of, strict=True)]
    counts: dict[tuple[str, int], int] = {}
    for shown, times in Counter(pixels.labels for _, pixels in moments).items():
        for label in shown:
            counts[label] = counts.get(label, 0) + times
    labels = tuple(label for label, count in counts.items() if count >= IN_MOST_PAIRS * len(moments))
    whole: dict[float, TwoViewPixels] = {}
    for phase, pixels in moments:
        # Beats timed by R waves repeat phase 0; one moment of each phase is enough.
        if phase not in whole and (pixels.labels == labels or set(labels) <= set(pixels.labels)):
            whole[phase] = pixels.only(labels)
    if not labels or len(whole) < FEWEST_MOMENTS:
        return None
    phases = np.array(sorted(whole))
    pixels = _stack([whole[phase] for phase in phases])
    # Each electrode is located separately, so that all moments can go through one call.
    positions = method.start(cameras, _flatten(pixels)).reshape(len(phases), len(labels), 3)
    return CycleMoments(phases, pixels, positions)


def _stack(moments: Sequence[TwoViewPixels]) -> TwoViewPixels:
    a, b = (np.stack([moment.pixels[view] for moment in moments]) for view in (0, 1))
    sa, sb = (np.stack([moment.covariances[view] for moment in moments]) for view in (0, 1))
    return TwoViewPixels(moments[0].labels, (a, b), (sa, sb))


def _flatten(pixels: TwoViewPixels) -> TwoViewPixels:
    (a, b), (sa, sb) = pixels.pixels, pixels.covariances
    flat = (a.reshape(-1, 2), b.reshape(-1, 2)), (sa.reshape(-1, 2, 2), sb.reshape(-1, 2, 2))
    return TwoViewPixels(pixels.labels * len(a), *flat)


def locate_cycle(
    moments: CycleMoments,
    diastolic_phase: float,
    cameras: Cameras,
    catalogue: Catalogue,
    params: UncertaintyParams,
    method: Method,
    gantry_covariance: Array,
    jump: Jump | None = None,
) -> SiteCycle:
    """Locate the electrodes at every moment.

    The covariance grows where the heart moves fast. A ``jump`` of the table between the two runs displaces all moments alike.
    """
    start, pixels = moments.positions_mm, moments.pixels
    motion = moments.motion(moments.phases, diastolic_phase, moments.labels)
    sources = common_sources(cameras, start, pixels.labels, catalogue, params, gantry_covariance, motion)
    if jump is not None:
        sources = (*sources, jump_source(cameras, start, jump))
    bends = bend_covariances_px2(jacobians(cameras, start), params)
    noise = (pixels.covariances[0] + bends[0], pixels.covariances[1] + bends[1])
    found = method.estimate_moments(cameras, pixels, start, visible_breathing(cameras, start, params))
    covariances = found.covariances_mm2(noise, sources)
    return SiteCycle(moments.phases, moments.labels, found.points_mm, covariances)


def _fit(phases: Array, positions_mm: Array) -> Array:
    """Fit coefficients (k, m, 3) of a smooth cycle to positions (p, m, 3).

    The fit serves displacement and velocity only; the reported positions are not smoothed.
    """
    waves = _waves(phases)
    order = np.concatenate([[0], np.repeat(np.arange(1, _HARMONICS + 1), 2)])
    # Gaps in the cycle leave the high harmonics free; the ridge keeps them small there.
    ridge = _SMOOTHNESS * len(phases) * np.diag(order.astype(np.float64) ** 2)
    flat = positions_mm.reshape(len(phases), -1)
    coefficients = np.linalg.solve(waves.T @ waves + ridge, waves.T @ flat)
    return np.asarray(coefficients.reshape(-1, *positions_mm.shape[1:]), dtype=np.float64)


def _waves(phases: ArrayLike, derivative: bool = False) -> Array:
    """Return 1, cos and sin of the harmonics at phases (...).

    ``derivative``: their derivatives by phase. Shape (..., k).
    """
    angle = 2 * np.pi * np.asarray(phases, dtype=np.float64)[..., None] * np.arange(1, _HARMONICS + 1)
    rate = 2 * np.pi * np.arange(1, _HARMONICS + 1)
    pairs = (-rate * np.sin(angle), rate * np.cos(angle)) if derivative else (np.cos(angle), np.sin(angle))
    first = np.full((*angle.shape[:-1], 1), 0.0 if derivative else 1.0)
    harmonics = np.stack(pairs, axis=-1).reshape(*angle.shape[:-1], -1)
    waves: Array = np.concatenate([first, harmonics], axis=-1)
    return waves
