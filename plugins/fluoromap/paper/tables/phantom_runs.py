"""Runs of simulated hearts as a monoplane solver gets them in a study, with their truth.

The electrodes' pixels are the true ones with noise, so that the tables show the solvers alone; names, phases and the gantry
are right. Everything else comes about as in a study: two runs of a site one after the other, their frames matched by
cardiac phase, positions from two views by the triangulator.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import (
    Array,
    LocatedSite,
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
# About as many as that in a cycle of a dog's heart. Were it exactly as many, all beats would show the same few phases.
_FRAME_RATE_HZ = 30.0
_FRAMES = 3 * CYCLE_IMAGES
_DIASTOLE = 0.8


@dataclass(frozen=True, eq=False)
class PhantomRun:
    """A simulated run.

    seen : what a solver gets; its a-priori frame is diastolic and a whole cycle follows. truth_mm : (n, m, 3), the
    electrodes in the order of ``seen.a_priori``.
    """

    view: PhantomView
    heart: int
    seen: MonoplaneView
    truth_mm: Array

    @property
    def electrodes(self) -> tuple[tuple[str, int], ...]:
        """(catheter, electrode) of each row of the truth."""
        return tuple((point.catheter, point.electrode) for point in self.seen.a_priori)

    def part(self, images: int) -> PhantomRun:
        """The images from the a-priori frame on."""
        start = self.seen.a_priori_frame
        kept = slice(start, start + images)
        observations = tuple(
            replace(observation, frame=frame) for frame, observation in enumerate(self.seen.observations[kept])
        )
        seen = replace(
            self.seen, frame_times_ms=self.seen.frame_times_ms[kept], observations=observations, a_priori_frame=0
        )
        return replace(self, seen=seen, truth_mm=self.truth_mm[kept])

    def of_catheter(self, catheter: str) -> PhantomRun:
        """The same run with one catheter in it."""
        kept = [index for index, (name, _) in enumerate(self.electrodes) if name == catheter]
        a_priori = tuple(self.seen.a_priori[index] for index in kept)
        return replace(self, seen=replace(self.seen, a_priori=a_priori), truth_mm=self.truth_mm[:, kept])

    def without_own_cycle(self, others: tuple[PhantomRun, ...]) -> PhantomRun:
        """The same run at a site whose cycle is not known, only those of other sites of the heart."""
        cycles = {run.seen.site: run.seen.cycle for run in others if run.heart == self.heart}
        known = tuple(cycle for site, cycle in cycles.items() if site != self.seen.site and cycle is not None)
        return replace(self, seen=replace(self.seen, cycle=None, others=known))


def phantom_runs(heart: int, sites: int, recorded: int, breathing_mm: float) -> tuple[PhantomRun, ...]:
    """Both runs of sites of a simulated dog's heart, about 15 images a cycle.

    Parameters
    ----------
    heart : int
        Seed of the heart; every heart is another.
    sites, recorded : int
        Sites of the heart, and how many of them, from the first on, are recorded.
    breathing_mm : float
        Furthest shift of the heart to head or feet between runs; 0: the breath is held all through.
    """
    study = simulate_study(StudySpec(heart, sites, _FRAMES, _FRAME_RATE_HZ, heart="dog", breathing_mm=breathing_mm))
    rng = np.random.default_rng([heart, sites])
    matched = tuple(_matched(site, rng) for site in study.sites[:recorded])
    located: Triangulation = build_triangulator("maximum-likelihood", {}).triangulate(
        matched, study.catalogue, Silent()
    )
    places = {site.site: site for site in located.sites}
    runs = []
    for site, pairs in zip(study.sites, matched, strict=False):
        if pairs.site not in places:
            continue
        for run in site.runs:
            seen = _seen(run, pairs, places[pairs.site], study.catalogue, located)
            truth = np.stack(
                [run.truth.points_mm[point.catheter][:, point.electrode - 1] for point in seen.a_priori], axis=1
            )
            runs.append(PhantomRun("LAT" if run.view == "a" else "PA", heart, seen, truth))
    return tuple(runs)


def _matched(site: SimulatedSite, rng: np.random.Generator) -> MatchedSite:
    tracks = tuple(_track(run, rng) for run in site.runs)
    diastole = tuple(track[_diastolic_frame(track)] for track in tracks)
    cameras = tuple(camera_from_gantry(run.gantry) for run in site.runs)
    return MatchedSite(
        site=site.name,
        camera_a=cameras[0],
        camera_b=cameras[1],
        diastole=PhasePair(diastole[0].phase, diastole[0], diastole[1]),
        cycle=pair_by_phase(tracks[0], tracks[1]),
        track_a=tracks[0],
        track_b=tracks[1],
        frame_times_a_ms=site.runs[0].frame_times_ms,
        frame_times_b_ms=site.runs[1].frame_times_ms,
    )


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
    """The frame nearest to diastole that a whole cycle follows."""
    phases = np.array([seen.phase for seen in track[: _FRAMES - CYCLE_IMAGES]], dtype=np.float64)
    return int(np.argmin(np.abs(phases - _DIASTOLE)))


def _seen(
    run: SimulatedRun, site: MatchedSite, located: LocatedSite, catalogue: Catalogue, study: Triangulation
) -> MonoplaneView:
    lateral = run.view == "a"
    return MonoplaneView(
        site=site.site,
        view=run.view,
        camera=located.camera_a if lateral else located.camera_b,
        catalogue=catalogue,
        frame_times_ms=run.frame_times_ms,
        observations=site.track_a if lateral else site.track_b,
        a_priori=located.points,
        a_priori_frame=located.frame_a if lateral else located.frame_b,
        cycle=located.cycle,
        others=() if located.cycle is not None else tuple(one.cycle for one in study.sites if one.cycle is not None),
    )
