"""A simulated study past segmentation and naming: the true pixels with noise, paired by cardiac phase."""

from __future__ import annotations

import numpy as np

from fluoromap.contracts import (
    FrameChains,
    MatchedSite,
    NamedChain,
    Observation,
    PhasePair,
    Segmentation,
)
from fluoromap.geometry import camera_from_gantry
from fluoromap.matching.cycle import pair_by_phase
from fluoromap.matching.phase import cardiac_phases
from fluoromap.phantom.motion import DIASTOLIC_PHASE
from fluoromap.phantom.study import SimulatedRun, SimulatedStudy


def matched_sites(
    study: SimulatedStudy, noise_px: float = 0.5, seed: int = 0, exact_phases: bool = False
) -> tuple[MatchedSite, ...]:
    """All sites as matching would hand them on, had the segmenter found every electrode with ``noise_px`` an axis.

    Phases count from R waves told to the nearest frame, as files do, or with ``exact_phases`` from their true times, as an
    electrocardiogram does. The diastolic pair is, in each view, the frame nearest to the phase of rest. Cameras are those
    the files tell.
    """
    sites = []
    for number, site in enumerate(study.sites):
        tracks = tuple(
            observations(run, noise_px, np.random.default_rng([study.spec.seed, seed, number, view]), exact_phases)
            for view, run in enumerate(site.runs)
        )
        a, b = (min(track, key=_from_rest) for track in tracks)
        sites.append(
            MatchedSite(
                site=site.name,
                camera_a=camera_from_gantry(site.runs[0].gantry),
                camera_b=camera_from_gantry(site.runs[1].gantry),
                diastole=PhasePair(a.phase, a, b),
                cycle=pair_by_phase(*tracks),
                track_a=tracks[0],
                track_b=tracks[1],
                frame_times_a_ms=site.runs[0].frame_times_ms,
                frame_times_b_ms=site.runs[1].frame_times_ms,
            )
        )
    return tuple(sites)


def observations(
    run: SimulatedRun, noise_px: float, rng: np.random.Generator, exact_phases: bool = False
) -> tuple[Observation, ...]:
    """Every frame of a run with all its electrodes, displaced by Gaussian noise an axis."""
    n = len(run.frame_times_ms)
    seen = {name: uv + rng.normal(0, noise_px, uv.shape) for name, uv in run.truth.pixels_uv.items()}
    blank = tuple(FrameChains(frame, ()) for frame in range(n))
    still = Segmentation(blank, None, (), np.zeros(n), run.frame_times_ms, run.r_wave_frames)
    rhythm = None if exact_phases else cardiac_phases(still, ())
    phases = rhythm.phases if rhythm is not None else run.truth.phases if exact_phases else None
    covariance = max(noise_px, 1e-3) ** 2 * np.eye(2)
    return tuple(
        Observation(
            frame,
            None if phases is None else float(phases[frame]),
            tuple(
                NamedChain(name, tuple(range(1, uv.shape[1] + 1)), uv[frame], np.tile(covariance, (uv.shape[1], 1, 1)))
                for name, uv in seen.items()
            ),
        )
        for frame in range(n)
    )


def _from_rest(seen: Observation) -> float:
    return 1.0 if seen.phase is None else abs((seen.phase - DIASTOLIC_PHASE + 0.5) % 1.0 - 0.5)
