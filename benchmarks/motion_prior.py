"""Depth over the cardiac cycle from one view: ``python benchmarks/motion_prior.py [first seed] [hearts] [hearts for coverage]``.

The data are dog hearts at 30 frames/s (14 to 19 frames a cycle), runs of 48 frames, 12 electrodes, true pixels with 0.5 px of
noise; nothing is rendered. Every table names the prior knowledge: two views of the site, or of 19 other sites. Errors are 3D
RMS in mm over all frames and electrodes, lateral ; frontal view. "Worst phase" is the RMS over hearts in the worst of 15
parts of the cycle. Where a row says so the geometry is exact and the solver's parameters for its errors are 0. The coverage
table draws gantry and breathing with the default parameters. Seeds below 5000 were used during development.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from fluoromap.catheters import DEFAULT_CATALOGUE as CATALOGUE
from fluoromap.contracts import (
    CHI2_95_3D,
    LocatedSite,
    MatchedSite,
    MonoplaneView,
    Silent,
    Track,
    Triangulation,
)
from fluoromap.monoplane.a_priori_lm import APrioriLM
from fluoromap.monoplane.motion_prior import MotionPrior
from fluoromap.monoplane.track_samples import in_study
from fluoromap.phantom import HeartKind, SimulatedRun, StudySpec, simulate_study
from fluoromap.phantom.ideal_matching import matched_sites
from fluoromap.reasons import Reason
from fluoromap.registry import build_triangulator

Array = NDArray[np.float64]

EXACT = {"gantry_angle_sd_deg": 0.0, "isocentre_sd_mm": 0.0, "magnification_sd": 0.0}
HELD = {"respiration_head_feet_sd_mm": 0.0, "respiration_other_sd_mm": 0.0}
PARTS = 15
STRESSED = ("NON_AFFINE_MM", "BEAT_AMPLITUDE", "BEAT_TIMING_CYCLE", "BEAT_POSITION_MM")


@dataclass(frozen=True)
class Scene:
    """Prior knowledge, and the differences of the tracked run from it."""

    name: str
    own_cycle: bool = True
    biplane_breathing_mm: float = 0.0
    breathing_mm: float = 0.0
    gantry_error: float = 0.0
    stress: float = 1.0
    heart: HeartKind = "dog"
    rate_hz: float = 30.0
    frames: int = 48
    exact_phases: bool = False
    r_waves: bool = True

    @property
    def triangulator(self) -> tuple[str, dict[str, float]]:
        if self.gantry_error:
            return "maximum-likelihood", {}
        if self.biplane_breathing_mm:
            return "maximum-likelihood", EXACT
        return "linear", EXACT | HELD

    @property
    def solver(self) -> dict[str, float]:
        known = {} if self.gantry_error else EXACT
        return known if self.breathing_mm else known | HELD


@dataclass
class Score:
    """Squared errors (n, m) of one tracked run, and True where an ellipsoid holds the truth (n, m).

    The latter is empty where the track states no relative covariance.
    """

    phases: Array
    squared: Array
    baseline: Array
    mapping: Array
    relative: Array
    inside: NDArray[np.bool_]
    inside_relative: NDArray[np.bool_]
    gated: bool
    paper: tuple[Score, ...] = ()


@dataclass
class Scores:
    by_view: tuple[list[Score], list[Score]] = field(default_factory=lambda: ([], []))
    milliseconds: list[float] = field(default_factory=list)
    no_cycle: int = 0


@contextmanager
def stressed(factor: float) -> Iterator[None]:
    """Make hearts with more own motion and more varied beats.

    The catheters move more on their own than in the default hearts.
    """
    from fluoromap.phantom import motion

    with patch.multiple(motion, **{name: factor * getattr(motion, name) for name in STRESSED}):
        yield


def biplane(scene: Scene, seed: int) -> tuple[tuple[MatchedSite, ...], Triangulation, SimulatedRun, SimulatedRun]:
    """Return matched and located sites, the tracked site first, and its two runs."""

    def study(breathing_mm: float) -> tuple[tuple[MatchedSite, ...], tuple[SimulatedRun, SimulatedRun]]:
        spec = StudySpec(
            seed, sites=1 if scene.own_cycle else 20, frames=scene.frames, frame_rate_hz=scene.rate_hz, heart=scene.heart,
            breathing_mm=breathing_mm, gantry_error_deg=scene.gantry_error, isocentre_error_mm=scene.gantry_error,
        )  # fmt: skip
        simulated = simulate_study(spec)
        return matched_sites(simulated, exact_phases=scene.exact_phases, r_waves=scene.r_waves), simulated.sites[0].runs

    with stressed(scene.stress):
        before, runs = study(scene.biplane_breathing_mm)
        name, parameters = scene.triangulator
        located = build_triangulator(name, dict(parameters)).triangulate(before, CATALOGUE, Silent())
        if scene.breathing_mm != scene.biplane_breathing_mm:
            before, runs = study(scene.breathing_mm)
    return before, located, *runs


def monoplane_view(matched: MatchedSite, located: LocatedSite, a: bool, others: Sequence[LocatedSite]) -> MonoplaneView:
    """Return the solver's input for view a or b.

    It has the site's own cycle only without ``others``.
    """
    return MonoplaneView(
        site=matched.site,
        view="a" if a else "b",
        camera=located.camera_a if a else located.camera_b,
        catalogue=CATALOGUE,
        frame_times_ms=matched.runs.frame_times_a_ms if a else matched.runs.frame_times_b_ms,
        observations=matched.runs.track_a if a else matched.runs.track_b,
        a_priori=located.a_priori_points,
        a_priori_frame=located.frame_a if a else located.frame_b,
        cycle=None if others else located.cycle,
        others=tuple(site.cycle for site in others if site.cycle),
    )


def score(track: Track, run: SimulatedRun, paper: Sequence[Track]) -> Score:
    truth = np.stack([run.truth.points_mm[name][:, electrode - 1] for name, electrode in track.labels], axis=1)
    reference = [i for i, (name, _) in enumerate(track.labels) if name == CATALOGUE.reference]
    mapping = [i for i, (name, _) in enumerate(track.labels) if name == CATALOGUE.mapping]
    others = [i for i, (name, _) in enumerate(track.labels) if name != CATALOGUE.reference]
    error = track.positions_mm - truth
    relative = error - error[:, reference].mean(axis=1, keepdims=True)
    stated = track.relative_covariance_mm2
    return Score(
        run.truth.phases,
        (error**2).sum(axis=-1),
        ((track.baseline_mm - truth) ** 2).sum(axis=-1),
        (error[:, mapping] ** 2).sum(axis=-1),
        (relative[:, mapping] ** 2).sum(axis=-1),
        inside(error, track.covariance_mm2),
        np.empty((0, 0), dtype=np.bool_) if stated is None else inside(relative[:, others], stated[:, others]),
        any(Reason.PRIOR_GATE in reasons for reasons in track.reasons),
        tuple(score(other, run, ()) for other in paper),
    )


def inside(error: Array, covariance: Array) -> NDArray[np.bool_]:
    distance = np.einsum("nmi,nmi->nm", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    held: NDArray[np.bool_] = distance <= CHI2_95_3D
    return held


def run_scene(scene: Scene, seeds: Sequence[int], paper: bool = False) -> Scores:
    scores = Scores()
    solver = MotionPrior(MotionPrior.Params.model_validate(scene.solver))
    steps = [APrioriLM(APrioriLM.Params(depth_step_mm=dz)) for dz in (0.0, 1.0)] if paper else []
    for seed in seeds:
        matched, located, *runs = biplane(scene, seed)
        if not located.sites or (scene.own_cycle and located.sites[0].cycle is None):
            scores.no_cycle += 1
            continue
        for number, run in enumerate(runs):
            others = () if scene.own_cycle else located.sites[1:]
            view = monoplane_view(matched[0], located.sites[0], number == 0, others)
            start = time.process_time()
            track = in_study(solver.track(view, Silent()), view.camera, CATALOGUE.reference, located.sites[0].variation)
            scores.milliseconds.append(1000 * (time.process_time() - start) / len(view.observations))
            before = [step.track(view, Silent()) for step in steps]
            scores.by_view[number].append(score(track, run, before))
    return scores


def rms(values: Sequence[Array]) -> float:
    return float(np.sqrt(np.mean([value.mean() for value in values])))


def both(of: Scores, name: str) -> str:
    return " ; ".join(f"{rms([getattr(one, name) for one in view]):4.2f}" for view in of.by_view)


def worst_phase(view: Sequence[Score]) -> float:
    part = np.concatenate([(one.phases * PARTS).astype(int) % PARTS for one in view])
    squared = np.concatenate([one.squared.mean(axis=1) for one in view])
    return float(max(np.sqrt(squared[part == k].mean()) for k in np.unique(part)))


def share(of: Sequence[NDArray[np.bool_]]) -> str:
    """Return the percentage with a 95 % bootstrap interval over hearts."""
    means = np.array([one.mean() for one in of])
    drawn = np.random.default_rng(0).choice(means, (2000, len(means))).mean(axis=1)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return f"{100 * means.mean():5.1f} ({100 * low:4.1f}-{100 * high:4.1f})"


def line(scene: Scene, of: Scores) -> str:
    every = [one for view in of.by_view for one in view]
    hearts = np.sqrt([one.squared.mean() for one in every])
    return (
        f"{scene.name:46s}|{both(of, 'squared')} | {hearts.std():4.2f} {hearts.max():5.2f} |{both(of, 'baseline')} |"
        f"{both(of, 'mapping')} |{both(of, 'relative')} | {max(map(worst_phase, of.by_view)):4.2f} | "
        f"{100 * np.mean([one.gated for one in every]):3.0f}% |"
    )


def main(first: int, hearts: int, coverage_hearts: int) -> None:
    seeds = range(first, first + hearts)
    own, later = Scene("own cycle, breath held"), Scene("own cycle, breath held; later run breathes", breathing_mm=4.0)
    apart = Scene("own cycle, every run breathes on its own", biplane_breathing_mm=4.0, breathing_mm=4.0)
    field_of = Scene("field of 19 other sites, breath held", own_cycle=False)
    head = "12 electrodes | sd   max   | back-project | mapping     | relative    | worst | gate |"
    print(f"{hearts} hearts from seed {first}; geometry exact\n{'motion-prior':46s}| {head}")
    milliseconds: list[float] = []
    for scene in (own, later, apart, field_of):
        scores = run_scene(scene, seeds, paper=scene in (own, field_of))
        milliseconds += scores.milliseconds
        print(line(scene, scores), flush=True)
        if scores.by_view[0][0].paper:
            dz = [
                " ; ".join(f"{rms([s.paper[k].squared for s in view]):.2f}" for view in scores.by_view) for k in (0, 1)
            ]
            print(f"   the same by a-priori-lm: dz 0 {dz[0]}, dz 1 {dz[1]}")
    for scene in (own, later, field_of):
        hard = Scene(f"stress: {scene.name}", scene.own_cycle, 0.0, scene.breathing_mm, stress=2.0)
        print(line(hard, run_scene(hard, seeds)), flush=True)
    print(f"processor time {15 * np.median(milliseconds):.0f} ms a cycle of 15 frames (median of runs of 48)")
    frame_rates(seeds)
    if coverage_hearts:
        coverage(range(first + 10_000, first + 10_000 + coverage_hearts))


def frame_rates(seeds: Sequence[int]) -> None:
    """Print the error at lower frame rates.

    It is also printed as a multiple of the error at 60 frames/s.
    """
    print("\nhuman hearts, runs of 2 s, own cycle, breath held: 12 electrodes (times the error at 60 frames/s)")
    print(f"frames/s{'true phases':>30}{'R waves to the frame':>30}{'no R waves':>30}")
    by_phase_source: dict[bool | None, list[list[float]]] = {True: [], False: [], None: []}
    for rate in (60.0, 30.0, 15.0, 7.5):
        cells = []
        for r_waves, errors in by_phase_source.items():
            scene = Scene(
                "", heart="human", rate_hz=rate, frames=int(2 * rate), exact_phases=r_waves is None,
                r_waves=r_waves is not False,
            )  # fmt: skip
            errors.append([rms([one.squared for one in view]) for view in run_scene(scene, seeds).by_view])
            cells.append(
                " ; ".join(f"{now:.2f} ({now / at_60:.2f})" for now, at_60 in zip(errors[-1], errors[0], strict=True))
            )
        print(f"{rate:8.1f}" + "".join(f"{cells[k]:>30}" for k in (2, 0, 1)), flush=True)


def coverage(seeds: range) -> None:
    """Print the shares of ellipsoids that hold the truth.

    The field of other sites takes 20 times as long, so that it is computed on an eighth of the hearts.
    """
    default = Scene("defaults: breathing, gantry 0.5 deg and 0.5 mm", True, 4.0, 4.0, 0.5)
    own = Scene("own cycle, breath held")
    apart = Scene("own cycle, every run breathes on its own", biplane_breathing_mm=4.0, breathing_mm=4.0)
    field_of = Scene("field of 19 other sites, breath held", own_cycle=False)
    print(f"\n95 % ellipsoids that hold the truth, {len(seeds)} hearts, both views: absolute | relative")
    few = seeds[: max(len(seeds) // 8, 1)]
    for scene, drawn in ((default, seeds), (apart, seeds), (own, seeds), (field_of, few)):
        scores = run_scene(scene, drawn, paper=scene is default)
        pairs = list(zip(*scores.by_view, strict=True))
        absolute = share([np.concatenate([s.inside for s in heart]) for heart in pairs])
        relative = share([np.concatenate([s.inside_relative for s in heart]) for heart in pairs])
        print(
            f"{scene.name:48s} {absolute} | {relative}   {len(pairs)} hearts, RMS {both(scores, 'squared')}", flush=True
        )
        for dz in range(len(pairs[0][0].paper)):
            paper = share([np.concatenate([s.paper[dz].inside for s in heart]) for heart in pairs])
            print(f"{f'   the same by a-priori-lm, dz {dz}':48s} {paper}", flush=True)


if __name__ == "__main__":
    numbers = [int(argument) for argument in sys.argv[1:]]
    main(*(numbers + [5000, 16, 200][len(numbers) :]))
