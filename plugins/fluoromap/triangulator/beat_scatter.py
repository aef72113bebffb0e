"""Scatter of the catheters' resting places from beat to beat, as single runs show it.

The epipolar distances compare one beat with another one. Each run shows several beats, in the same view: their scatter shows how
restless the heart is also where both views are recorded at the same time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array, MatchedRuns, Observation
from fluoromap.geometry import Camera
from fluoromap.matching.beats import cycle_spread

_NEAR_REST = 0.06
"""Largest distance from the diastolic phase, in cycles."""
_FOLLOWS_TIP = 0.87
"""Displacement of a catheter's middle as a share of its tip's: all of it along the shaft, 0.8 across."""
_MOST_UNEVEN = 0.12
"""Spread of the cycles' lengths above which a run's beats do not rest at the same phase."""
_WEIGHT = 0.25
"""Beats of one run resemble each other more than beats of two runs, so that they count less than the epipolar distances."""


@dataclass(frozen=True, slots=True)
class BeatScatter:
    """Scatter in one run. The catheters' common motion, which breathing dominates, is left out.

    squares_px2 : sum of squared deviations from the run's mean beat. degrees : of freedom. noise_px2 : variance of one deviation
    from pixel noise. px_per_mm : of the camera.
    """

    squares_px2: float
    degrees: int
    noise_px2: float
    px_per_mm: float

    def log_likelihood(self, beats_sd_mm: Array) -> Array:
        """Return the log likelihood (h,) of hearts, up to a constant.

        ``beats_sd_mm`` (h,) is how much their tips vary from beat to beat.
        """
        variance = (_FOLLOWS_TIP * self.px_per_mm * beats_sd_mm) ** 2 + self.noise_px2
        likelihood: Array = -0.5 * _WEIGHT * (self.degrees * np.log(variance) + self.squares_px2 / variance)
        return likelihood


def beat_scatter(runs: MatchedRuns) -> tuple[BeatScatter, ...]:
    """Return the scatter in each run that shows at least two beats."""
    views = (
        (runs.track_a, runs.camera_a, runs.diastole.a.phase),
        (runs.track_b, runs.camera_b, runs.diastole.b.phase),
    )
    found = (_scatter(track, camera, phase) if phase is not None else None for track, camera, phase in views)
    return tuple(one for one in found if one is not None)


def _scatter(track: Sequence[Observation], camera: Camera, rest: float) -> BeatScatter | None:
    beats = _resting_beats(track, rest)
    catheters = sorted(set.intersection(*({*beat} for beat in beats))) if beats else []
    phases = np.array([observation.phase for observation in track if observation.phase is not None])
    if len(beats) < 2 or len(catheters) < 2 or cycle_spread(phases) > _MOST_UNEVEN:
        return None
    places = np.array([[beat[name][0] for name in catheters] for beat in beats])
    noise = np.mean([[beat[name][1] for name in catheters] for beat in beats])
    apart = places - places.mean(axis=1, keepdims=True)
    deviations = apart - apart.mean(axis=0)
    degrees = 2 * (len(beats) - 1) * (len(catheters) - 1)
    return BeatScatter(float((deviations**2).sum()), degrees, float(noise), camera.px_per_mm)


def _resting_beats(track: Sequence[Observation], rest: float) -> list[dict[str, tuple[Array, float]]]:
    """Return the catheters' places in each beat's diastole.

    A place is the mean pixel (2,) of the electrodes, with its variance an axis. A frame counts for a catheter only where it shows
    all electrodes that the run shows of it.
    """
    beats: list[dict[str, list[tuple[Array, float]]]] = []
    whole: dict[str, tuple[int, ...]] = {}
    for observation in track:
        for chain in observation.chains:
            if len(chain.electrodes) > len(whole.get(chain.catheter, ())):
                whole[chain.catheter] = chain.electrodes
    before = None
    for observation in track:
        if observation.phase is None:
            continue
        after_rest = (observation.phase - rest + 0.5) % 1.0
        if before is None or after_rest < before - 0.5:
            beats.append({})
        before = after_rest
        if abs(after_rest - 0.5) > _NEAR_REST:
            continue
        for chain in observation.chains:
            if chain.electrodes == whole[chain.catheter] and chain.track >= 0:
                variance = (
                    float(np.trace(chain.covariance_px2, axis1=1, axis2=2).sum()) / 2 / len(chain.electrodes) ** 2
                )
                beats[-1].setdefault(chain.catheter, []).append((chain.pixels_uv.mean(axis=0), variance))
    return [
        {
            name: (
                np.mean([place for place, _ in frames], axis=0),
                float(np.sum([variance for _, variance in frames])) / len(frames) ** 2,
            )
            for name, frames in beat.items()
        }
        for beat in beats
        if beat
    ]
