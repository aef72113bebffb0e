"""Runs of simulated hearts as input of a monoplane solver, with their truth.

The electrodes' pixels are the true ones with noise, so that the tables show the solvers alone. Names, phases and the gantry
are correct. Everything else is as in a study: the two runs of a site are taken one after the other, frames are matched by
cardiac phase, and the triangulator computes positions from two views.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import (
    Array,
    LocatedSite,
    MatchedRuns,
    MatchedSite,
    MonoplaneView,
    NamedChain,
    Observation,
    PhasePair,
    Silent,
    Triangulation,
)
from fluoromap.geometry import camera_from_gantry
from fluoromap.matching.phase_matching import pair_by_phase
from fluoromap.phantom import SimulatedRun, SimulatedSite, StudySpec, simulate_study
from fluoromap.registry import build_triangulator

PhantomView = Literal["LAT", "PA"]

CYCLE_IMAGES = 15
"""Images of one cardiac cycle, as in the paper."""
NOISE_PX = 0.5
# A cycle of a dog's heart then has about 15 images. With exactly 15, all beats would show the same few phases.
_FRAME_RATE_HZ = 30.0
_FRAMES = 3 * CYCLE_IMAGES
_DIASTOLE = 0.8


@dataclass(frozen=True, eq=False)
class PhantomRun:
    """A simulated run.

    solver_input : the solver's input; its a-priori frame is diastolic and a whole cycle follows. truth_mm : (n, m, 3) world, the
    electrodes in the order of ``solver_input.a_priori``.
    """

    view: PhantomView
    heart: int
    solver_input: MonoplaneView
    truth_mm: Array

    @property
    def electrodes(self) -> tuple[tuple[str, int], ...]:
        """(catheter, electrode) of each row of the truth."""
        return tuple((point.catheter, point.electrode) for point in self.solver_input.a_priori)

    def part(self, images: int) -> PhantomRun:
        """Return this many images from the a-priori frame on."""
        start = self.solver_input.a_priori_frame
        frames = slice(start, start + images)
        observations = tuple(
            replace(observation, frame=frame)
            for frame, observation in enumerate(self.solver_input.observations[frames])
        )
        solver_input = replace(
            self.solver_input,
            frame_times_ms=self.solver_input.frame_times_ms[frames],
            observations=observations,
            a_priori_frame=0,
        )
        return replace(self, solver_input=solver_input, truth_mm=self.truth_mm[frames])

    def of_catheter(self, catheter: str) -> PhantomRun:
        """Return the same run with one catheter only."""
        own = [index for index, (name, _) in enumerate(self.electrodes) if name == catheter]
        a_priori = tuple(self.solver_input.a_priori[index] for index in own)
        return replace(self, solver_input=replace(self.solver_input, a_priori=a_priori), truth_mm=self.truth_mm[:, own])

    def without_own_cycle(self, others: tuple[PhantomRun, ...]) -> PhantomRun:
        """Return the run with the cycles of the heart's other sites.

        The site's own cycle is left out.
        """
        cycles = {run.solver_input.site: run.solver_input.cycle for run in others if run.heart == self.heart}
        known = tuple(cycle for site, cycle in cycles.items() if site != self.solver_input.site and cycle is not None)
        return replace(self, solver_input=replace(self.solver_input, cycle=None, others=known))


def phantom_runs(heart: int, sites: int, recorded: int, breathing_mm: float) -> tuple[PhantomRun, ...]:
    """Simulate both runs of sites of a dog's heart, about 15 images a cycle.

    Parameters
    ----------
    heart : int
        Seed of the heart.
    sites, recorded : int
        Sites of the heart, and the number of them, from the first on, that are recorded.
    breathing_mm : float
        Largest shift of the heart to head or feet between runs; 0 means that the breath is held all the time.
    """
    study = simulate_study(StudySpec(heart, sites, _FRAMES, _FRAME_RATE_HZ, heart="dog", breathing_mm=breathing_mm))
    rng = np.random.default_rng([heart, sites])
    matched = tuple(_matched_site(site, rng) for site in study.sites[:recorded])
    located: Triangulation = build_triangulator("maximum-likelihood", {}).triangulate(
        matched, study.catalogue, Silent()
    )
    places = {site.site: site for site in located.sites}
    runs = []
    for site, pairs in zip(study.sites, matched, strict=False):
        if pairs.site not in places:
            continue
        for run in site.runs:
            solver_input = _monoplane_view(run, pairs, places[pairs.site], study.catalogue, located)
            truth = np.stack(
                [run.truth.points_mm[point.catheter][:, point.electrode - 1] for point in solver_input.a_priori], axis=1
            )
            runs.append(PhantomRun("LAT" if run.view == "a" else "PA", heart, solver_input, truth))
    return tuple(runs)


def _matched_site(site: SimulatedSite, rng: np.random.Generator) -> MatchedSite:
    tracks = tuple(_track(run, rng) for run in site.runs)
    diastole = tuple(track[_diastolic_frame(track)] for track in tracks)
    cameras = tuple(camera_from_gantry(run.gantry) for run in site.runs)
    runs = MatchedRuns(
        camera_a=cameras[0],
        camera_b=cameras[1],
        diastole=PhasePair(diastole[0].phase, diastole[0], diastole[1]),
        cycle=pair_by_phase(tracks[0], tracks[1]),
        track_a=tracks[0],
        track_b=tracks[1],
        frame_times_a_ms=site.runs[0].frame_times_ms,
        frame_times_b_ms=site.runs[1].frame_times_ms,
    )
    return MatchedSite(site.name, runs)


def _track(run: SimulatedRun, rng: np.random.Generator) -> tuple[Observation, ...]:
    noise = {name: NOISE_PX * rng.normal(size=pixels.shape) for name, pixels in run.truth.pixels_uv.items()}
    return tuple(
        Observation(
            frame,
            float(phase),
            tuple(
                NamedChain(
                    name,
                    tuple(range(1, pixels.shape[1] + 1)),
                    pixels[frame] + noise[name][frame],
                    np.broadcast_to(NOISE_PX**2 * np.eye(2), (pixels.shape[1], 2, 2)),
                )
                for name, pixels in run.truth.pixels_uv.items()
            ),
        )
        for frame, phase in enumerate(run.truth.phases)
    )


def _diastolic_frame(track: tuple[Observation, ...]) -> int:
    """Return the frame nearest to diastole after which a whole cycle remains."""
    phases = np.array([observation.phase for observation in track[: _FRAMES - CYCLE_IMAGES]], dtype=np.float64)
    return int(np.argmin(np.abs(phases - _DIASTOLE)))


def _monoplane_view(
    run: SimulatedRun, site: MatchedSite, located: LocatedSite, catalogue: Catalogue, study: Triangulation
) -> MonoplaneView:
    lateral = run.view == "a"
    return MonoplaneView(
        site=site.site,
        view=run.view,
        camera=located.camera_a if lateral else located.camera_b,
        catalogue=catalogue,
        frame_times_ms=run.frame_times_ms,
        observations=site.runs.track_a if lateral else site.runs.track_b,
        a_priori=located.a_priori_points,
        a_priori_frame=located.frame_a if lateral else located.frame_b,
        cycle=located.cycle,
        others=() if located.cycle is not None else tuple(one.cycle for one in study.sites if one.cycle is not None),
    )
