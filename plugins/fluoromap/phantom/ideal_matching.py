"""Ideal matching of a simulated study: true pixels with noise and true names, paired by cardiac phase."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fluoromap.contracts import (
    Array,
    Chain,
    FrameChains,
    MatchedRuns,
    MatchedSite,
    NamedChain,
    Observation,
    PhasePair,
    Segmentation,
)
from fluoromap.geometry import Camera, camera_from_gantry
from fluoromap.matching.phase import cardiac_phases
from fluoromap.matching.phase_matching import fold, pair_by_phase, phase_shift
from fluoromap.matching.run_catheters import gather
from fluoromap.phantom.motion import DIASTOLIC_PHASE
from fluoromap.phantom.simulated_study import SimulatedRun, SimulatedStudy


def matched_sites(
    study: SimulatedStudy, noise_px: float = 0.5, seed: int = 0, exact_phases: bool = False, r_waves: bool = True
) -> tuple[MatchedSite, ...]:
    """Return all sites as after matching.

    Every electrode is segmented to ``noise_px`` an axis.

    - Default phases come from matching: from R waves at the nearest frame, as files state them.
    - Without ``r_waves``, phases come from the motion alone.
    - With ``exact_phases``, phases are the true ones, as from an electrocardiogram.

    The diastolic pair is, in each view, the frame nearest to the phase of rest. Cameras are those of the files.
    """
    sites = []
    for number, site in enumerate(study.sites):
        cameras = camera_from_gantry(site.runs[0].gantry), camera_from_gantry(site.runs[1].gantry)
        pixels = [
            _noisy_pixels(run, noise_px, np.random.default_rng([study.spec.seed, seed, number, view]))
            for view, run in enumerate(site.runs)
        ]
        phases = (
            [run.truth.phases for run in site.runs] if exact_phases else _phases(site.runs, pixels, cameras, r_waves)
        )
        tracks = tuple(_observations(own, of_run, noise_px) for own, of_run in zip(pixels, phases, strict=True))
        a, b = (min(track, key=_phase_from_rest) for track in tracks)
        runs = MatchedRuns(
            camera_a=cameras[0],
            camera_b=cameras[1],
            diastole=PhasePair(a.phase, a, b),
            cycle=pair_by_phase(*tracks),
            track_a=tracks[0],
            track_b=tracks[1],
            frame_times_a_ms=site.runs[0].frame_times_ms,
            frame_times_b_ms=site.runs[1].frame_times_ms,
        )
        sites.append(MatchedSite(site.name, runs))
    return tuple(sites)


def _noisy_pixels(run: SimulatedRun, noise_px: float, rng: np.random.Generator) -> dict[str, Array]:
    """Return all electrodes with Gaussian noise an axis: catheter -> (n, electrodes, 2)."""
    return {name: uv + rng.normal(0, noise_px, uv.shape) for name, uv in run.truth.pixels_uv.items()}


def _phases(
    runs: Sequence[SimulatedRun], pixels: Sequence[dict[str, Array]], cameras: tuple[Camera, Camera], r_waves: bool
) -> list[Array] | list[None]:
    """Return the phases of both runs from R waves and motion.

    Both are None where one of them is unknown.
    """
    phases, folded = [], []
    for run, own, camera in zip(runs, pixels, cameras, strict=True):
        segmentation = _ideal_segmentation(run, own, r_waves)
        catheters = gather(segmentation, None, camera.px_per_mm)
        rhythm = cardiac_phases(segmentation, catheters)
        if rhythm is None:
            return [None, None]
        phases.append(rhythm.phases)
        folded.append(fold(catheters, rhythm.phases, rhythm.phase_uncertainty))
    alike = [(k, k) for k in range(len(folded[0].paths))]
    return [phases[0], (phases[1] + phase_shift(cameras, (folded[0], folded[1]), alike)) % 1.0]


def _ideal_segmentation(run: SimulatedRun, pixels: dict[str, Array], r_waves: bool) -> Segmentation:
    n = len(run.frame_times_ms)

    def chain(name: str, track: int, uv: Array) -> Chain:
        m = len(uv)
        covariance = np.tile(np.eye(2), (m, 1, 1))
        return Chain(tuple(range(1, m + 1)), uv, covariance, np.ones(m), ((name, 1.0),), track)

    frames = tuple(
        FrameChains(frame, tuple(chain(name, k, uv[frame]) for k, (name, uv) in enumerate(pixels.items())))
        for frame in range(n)
    )
    return Segmentation(frames, None, (), np.zeros(n), run.frame_times_ms, run.r_wave_frames if r_waves else ())


def _observations(pixels: dict[str, Array], phases: Array | None, noise_px: float) -> tuple[Observation, ...]:
    covariance = max(noise_px, 1e-3) ** 2 * np.eye(2)
    return tuple(
        Observation(
            frame,
            None if phases is None else float(phases[frame]),
            tuple(
                NamedChain(name, tuple(range(1, uv.shape[1] + 1)), uv[frame], np.tile(covariance, (uv.shape[1], 1, 1)))
                for name, uv in pixels.items()
            ),
        )
        for frame in range(len(next(iter(pixels.values()))))
    )


def _phase_from_rest(observation: Observation) -> float:
    """Return the distance of an observation's phase from rest, in cycles.

    The result is 1 where its phase is unknown.
    """
    if observation.phase is None:
        return 1.0
    return abs((observation.phase - DIASTOLIC_PHASE + 0.5) % 1.0 - 0.5)
