"""Correct pairing and naming of catheters: ``python benchmarks/matching.py [first seed] [studies] [rendered studies]``.

The first part tests matching alone, on the true electrodes of simulated hearts. They have pixel noise, 1 degree gantry error
per axis and view, different breathing in the two runs, wrong votes for the tip and, in some runs, a chain without its tip.
Two more designs have an irregular rhythm, and conditions so hard that pairs are in doubt. The last part runs a few rendered
studies through the real segmenter. Each part prints:

- the share of catheters with correct pair and name, with a bootstrap interval over studies,
- how many wrong answers were flagged, and how many kept the correct answer as their alternative,
- the share of wrong answers for each stated probability,
- the error of the cardiac phase.
"""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from memory_frames import MemoryFrames
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import (
    Chain,
    FrameChains,
    Matching,
    PhasePair,
    PixelFacts,
    Run,
    Segmentation,
    Silent,
)
from fluoromap.geometry import Camera, camera_from_gantry, ray_angle_deg
from fluoromap.matching import SiteRuns, match_study
from fluoromap.matching.phase import cardiac_phases
from fluoromap.matching.run_catheters import gather
from fluoromap.phantom import FRONTAL, LATERAL, HeartKind, StudySpec, simulate_study
from fluoromap.phantom.anatomy import Anatomy, draw_anatomy
from fluoromap.phantom.motion import DIASTOLIC_PHASE, Beats, Breathing
from fluoromap.reasons import Reason
from fluoromap.segmenter.catheter_chain.plugin import CatheterChain

Array = NDArray[np.float64]
Truth = Mapping[str, Array]
"""Catheter -> true pixels (n, electrodes, 2) in every frame of a run."""

NAMES = DEFAULT_CATALOGUE.names
FRAME_RATES_HZ = (60.0, 30.0, 15.0)
SECONDS = 2.0
PIXEL_NOISE_PX, MEAN_NOISE_PX = 0.8, 0.5
GANTRY_ERROR_DEG = 1.0
BREATHING_MM = 4.0
WITHOUT_TIP = 0.1
WRONG_BY_PX = 6.0
IRREGULAR_SD = 0.2
NEAR_PX = 10.0
BINS = (0.0, 0.02, 0.1, 0.25, 0.5)


@dataclass(frozen=True, eq=False)
class Study:
    """Input of matching, and its truth: for each site the pixels and the phases (n,) of its two runs."""

    sites: tuple[SiteRuns, ...]
    pixels: tuple[tuple[Truth, Truth], ...]
    phases: tuple[tuple[Array, Array], ...]


@dataclass(frozen=True)
class Design:
    """A kind of study.

    bad : share of chains with some electrodes grossly wrong in the whole run, as where catheters cross. wrong_tips : share
    of frames in which the tip votes for another catheter.
    """

    sites: int = 8
    irregular: bool = False
    any_views: bool = False
    bad: float = 0.0
    wrong_tips: float = 0.1


def true_chains(seed: int, design: Design) -> Study:
    """Simulate a study without pictures.

    The views are a lateral and a frontal one, or any two at least 60 degrees apart.
    """
    rng = np.random.default_rng([seed, 20])
    heart: HeartKind = "human" if seed % 2 else "dog"
    anatomy = draw_anatomy(heart, design.sites, rng)
    rate_hz = FRAME_RATES_HZ[seed // 2 % len(FRAME_RATES_HZ)]
    nominal = (camera_from_gantry(LATERAL), camera_from_gantry(FRONTAL))
    if design.any_views:
        nominal = _any_views(rng)
    true = tuple(_camera_with_gantry_error(camera, rng) for camera in nominal)
    sites, pixels, phases = [], [], []
    for index in range(design.sites):
        runs = [_run(anatomy, index, camera, rate_hz, design, rng) for camera in true]
        sites.append(SiteRuns(f"S{index + 1:02d}", *nominal, runs[0][0], runs[1][0]))
        pixels.append((runs[0][1], runs[1][1]))
        phases.append((runs[0][2], runs[1][2]))
    return Study(tuple(sites), tuple(pixels), tuple(phases))


def _any_views(rng: np.random.Generator) -> tuple[Camera, Camera]:
    while True:
        gantries = [
            replace(FRONTAL, primary_deg=float(rng.uniform(-90, 90)), secondary_deg=float(rng.uniform(-45, 45)))
            for _ in range(2)
        ]
        cameras = (camera_from_gantry(gantries[0]), camera_from_gantry(gantries[1]))
        if ray_angle_deg(*cameras) >= 60:
            return cameras


def _camera_with_gantry_error(camera: Camera, rng: np.random.Generator) -> Camera:
    error = np.eye(4)
    error[:3, :3] = Rotation.from_rotvec(rng.normal(0, GANTRY_ERROR_DEG, 3), degrees=True).as_matrix()
    return Camera(camera.matrix @ error, camera.rows, camera.columns)


def _run(
    anatomy: Anatomy, site: int, camera: Camera, rate_hz: float, design: Design, rng: np.random.Generator
) -> tuple[Segmentation, Truth, Array]:
    residents = anatomy.residents(site)
    beats = Beats.draw(anatomy.rate_hz, SECONDS, len(residents), rng)
    r_waves = beats.r_waves_s
    if design.irregular:
        lengths = beats.period_s * np.clip(1 + IRREGULAR_SD * rng.normal(size=len(r_waves)), 0.65, 1.5)
        r_waves = r_waves[0] + np.cumsum(lengths) - lengths[0]
        beats = Beats(beats.period_s, r_waves, beats.amplitude, beats.delay, beats.offsets_mm)
    breathing = Breathing.draw(BREATHING_MM, rng)
    times = np.arange(round(SECONDS * rate_hz)) / rate_hz
    breath = breathing.at(times)[:, None, :]
    pulses, rest = beats.pulses(times), beats.rest_mm(times)
    truth = {}
    for number, resident in enumerate(residents):
        line = resident.shaft.lines_mm(pulses @ resident.vectors_mm + rest[:, number])
        truth[resident.shaft.catheter.name] = camera.project(resident.shaft.electrodes_mm(line) + breath)
    phases = np.interp(times, r_waves, np.arange(len(r_waves))) % 1.0
    return _segmentation(truth, phases, rate_hz, design, rng), truth, phases


def _segmentation(
    truth: Truth, phases: Array, rate_hz: float, design: Design, rng: np.random.Generator
) -> Segmentation:
    """Return the segmentation of a good segmenter."""
    n = len(phases)
    order = list(rng.permutation(len(NAMES)))
    first = {name: int(name == "mapping" and rng.random() < WITHOUT_TIP) for name in NAMES}
    wrong_px = {
        name: (rng.random() < design.bad) * (rng.random((4, 1)) < 0.3) * rng.normal(0, WRONG_BY_PX, (4, 2))
        for name in NAMES
    }
    half = int(0.06 * rate_hz)
    middle = int(np.argmin(np.abs(phases[half : n - half] - DIASTOLIC_PHASE))) + half
    quiet = tuple(range(middle - half, middle + half + 1))

    def chain(name: str, track: int, pixels: Array, noise_px: float) -> Chain:
        p = 0.8 if (name == "mapping") != (rng.random() < design.wrong_tips) else 0.1
        start = first[name]
        shown = pixels[start:] + rng.normal(0, noise_px, pixels[start:].shape) + wrong_px[name][start:]
        return Chain(
            electrodes=tuple(range(start + 1, len(pixels) + 1)),
            pixels_uv=shown,
            covariance_px2=np.broadcast_to(noise_px**2 * np.eye(2), (len(shown), 2, 2)),
            scores=np.full(len(shown), 10.0),
            kinds=(("reference", (1 - p) / 2), ("pacing", (1 - p) / 2), ("mapping", p)),
            track=track,
        )

    entries = tuple(
        FrameChains(f, tuple(chain(NAMES[k], t, truth[NAMES[k]][f], PIXEL_NOISE_PX) for t, k in enumerate(order)))
        for f in range(n)
    )
    mean = {name: truth[name][list(quiet)].mean(axis=0) for name in NAMES}
    diastole = FrameChains(
        middle, tuple(chain(NAMES[k], t, mean[NAMES[k]], MEAN_NOISE_PX) for t, k in enumerate(order))
    )
    steps = np.sqrt(np.mean([(np.diff(p, axis=0) ** 2).sum(axis=-1).mean(axis=1) for p in truth.values()], axis=0))
    motion = np.concatenate([steps[:1], steps])
    return Segmentation(entries, diastole, quiet, motion, np.arange(n) * 1000 / rate_hz)


DESIGNS = {
    "true chains, regular rhythm": Design(),
    "true chains, irregular rhythm": Design(irregular=True),
    "one site alone, any two views, bad chains, uninformative tips": Design(1, False, True, 0.4, 0.5),
}


@dataclass
class Score:
    """Result of one study. stated : (probability of the alternative, True for a wrong answer) of each site."""

    catheters: int = 0
    missing: int = 0
    wrong_pair: int = 0
    wrong_name: int = 0
    flagged: int = 0
    kept: int = 0
    noted: int = 0
    stated: list[tuple[float, bool]] = field(default_factory=list)
    rejected: list[Reason] = field(default_factory=list)
    phase_squares: list[float] = field(default_factory=list)
    milliseconds: list[float] = field(default_factory=list)

    @property
    def right(self) -> int:
        return self.catheters - self.missing - self.wrong_pair - self.wrong_name


def score(study: Study) -> Score:
    """Match a study and compare the catheters that both views contain with the truth."""
    offered = _offered(study)
    result = Score(catheters=sum(map(len, offered.values())))
    before = time.process_time()
    matching = match_study(study.sites, DEFAULT_CATALOGUE, Silent())
    result.milliseconds.append(1000 * (time.process_time() - before) / len(study.sites))
    _score_pairs(result, matching, study, offered)
    for site in matching.rejected:
        result.missing += len(offered[site.site])
        result.rejected.extend(site.reasons)
    return result


def _offered(study: Study) -> dict[str, set[str]]:
    """Return site -> catheters that both views contain."""
    offered = {}
    for runs, truths in zip(study.sites, study.pixels, strict=True):
        views = ((runs.segmentation_a, runs.camera_a), (runs.segmentation_b, runs.camera_b))
        there = set(NAMES)
        for (segmentation, camera), truth in zip(views, truths, strict=True):
            assert segmentation is not None
            there &= {
                name
                for one in gather(segmentation, None, camera.px_per_mm)
                for name in [_nearest(one.diastole.electrodes, one.diastole.pixels_uv, truth, one.diastole_frame)]
                if _apart_px(one.diastole.electrodes, one.diastole.pixels_uv, truth[name][one.diastole_frame]) < NEAR_PX
            }
        # A site without its mapping catheter does not count.
        offered[runs.site] = there if "mapping" in there else set()
    return offered


def _score_pairs(result: Score, matching: Matching, study: Study, offered: Mapping[str, set[str]]) -> None:
    number = {runs.site: index for index, runs in enumerate(study.sites)}
    for site in matching.sites:
        pixels = study.pixels[number[site.site]]
        shown = _true_names(site.runs.diastole, pixels)
        other = None if site.runs.alternative is None else _true_names(site.runs.alternative.diastole, pixels)
        wrong_here = False
        for name in NAMES:
            true = shown.get(name)
            if true is None:
                result.missing += name in offered[site.site]
                continue
            if name not in offered[site.site]:
                result.catheters += 1
            noted = (name, Reason.IDENTITY_UNCERTAIN) in site.notes
            result.noted += noted
            if true == (name, name):
                continue
            if true[0] == true[1]:
                result.wrong_name += 1
            else:
                result.wrong_pair += 1
            if true[0] != true[1] or "mapping" in (name, true[0]):
                # Look-alikes exchanged in both views are paired correctly; every other exchange is a wrong pair.
                wrong_here = True
                result.kept += other is not None and other.get(name, ("", ""))[0] == other.get(name, ("", "."))[1]
            result.flagged += noted
        result.stated.append((0.0 if site.runs.alternative is None else site.runs.alternative.probability, wrong_here))


def _true_names(pair: PhasePair, pixels: tuple[Truth, Truth]) -> dict[str, tuple[str, str]]:
    """Return given name -> true name in view a and in view b."""
    views = [
        {chain.catheter: _nearest(chain.electrodes, chain.pixels_uv, truth, shown.frame) for chain in shown.chains}
        for shown, truth in zip((pair.a, pair.b), pixels, strict=True)
    ]
    return {name: (views[0][name], views[1][name]) for name in views[0] if name in views[1]}


def _nearest(electrodes: Sequence[int], pixels_uv: Array, truth: Truth, frame: int) -> str:
    # The nearest catheter is taken, because a mean over quiet frames differs a little from its middle frame.
    return min(truth, key=lambda name: _apart_px(electrodes, pixels_uv, truth[name][frame]))


def _apart_px(electrodes: Sequence[int], pixels_uv: Array, truth: Array) -> float:
    return float(np.linalg.norm(truth[[number - 1 for number in electrodes]] - pixels_uv, axis=1).mean())


def phase_errors(study: Study) -> list[float]:
    """Return the squared phase error of each frame.

    The mean offset of its run is subtracted. An unknown phase counts as 0.25.
    """
    squares: list[float] = []
    for runs, truths in zip(study.sites, study.phases, strict=True):
        views = ((runs.segmentation_a, runs.camera_a), (runs.segmentation_b, runs.camera_b))
        for (segmentation, camera), truth in zip(views, truths, strict=True):
            assert segmentation is not None
            rhythm = cardiac_phases(segmentation, gather(segmentation, None, camera.px_per_mm))
            if rhythm is None:
                squares.extend([0.25] * len(truth))
                continue
            turns = np.exp(2j * np.pi * (rhythm.phases - truth))
            apart = np.angle(turns / turns.mean()) / (2 * np.pi)
            squares.extend(apart**2)
    return squares


def _share(counts: Sequence[tuple[int, int]]) -> str:
    """Return the share with its 95 % bootstrap interval over studies."""
    sums = np.array(counts, dtype=np.float64)
    drawn = np.random.default_rng(0).integers(0, len(sums), (2000, len(sums)))
    resampled = sums[drawn].sum(axis=1)
    low, high = np.percentile(resampled[:, 0] / resampled[:, 1], [2.5, 97.5])
    total = sums.sum(axis=0)
    return f"{total[0] / total[1]:.4f} ({low:.4f}-{high:.4f})"


def show(heading: str, scores: Sequence[Score]) -> None:
    """Print one block of the report."""
    total = {name: sum(getattr(one, name) for one in scores) for name in
             ("catheters", "missing", "wrong_pair", "wrong_name", "flagged", "kept", "noted")}  # fmt: skip
    cost = np.mean([ms for one in scores for ms in one.milliseconds])
    print(f"\n{heading}: {len(scores)} studies, {total['catheters']} catheters, {cost:.1f} ms a site")
    print("  pair and name correct ", _share([(one.right, one.catheters) for one in scores]))
    paired = [(one.catheters - one.wrong_pair - one.missing, one.catheters) for one in scores]
    print("  pair correct          ", _share(paired))
    print(
        f"  missing {total['missing']}, wrong pair {total['wrong_pair']}, wrong name {total['wrong_name']}; of the wrong "
        f"{total['flagged']} flagged identity_uncertain, {total['kept']} with the correct pair as alternative; "
        f"{total['noted']} flagged in all"
    )
    reasons = [reason for one in scores for reason in one.rejected]
    if reasons:
        print("  rejected sites:", ", ".join(f"{reason} {reasons.count(reason)}" for reason in sorted(set(reasons))))
    stated = np.array([pair for one in scores for pair in one.stated])
    print("  alternative's stated probability -> share wrong:", end="")
    for low, high in [(-1.0, 0.0), *itertools.pairwise(BINS)]:
        rows = stated[(stated[:, 0] > low) & (stated[:, 0] <= high)]
        label = "none" if high == 0 else f"{rows[:, 0].mean():.3f}" if len(rows) else f"<={high}"
        print(f"  {label} -> {f'{rows[:, 1].mean():.4f}' if len(rows) else '-'} of {len(rows)}", end=";")
    print()


def main(first: int, studies: int, rendered: int) -> None:
    """Print all tables, on seeds ``first`` to ``first + studies - 1``."""
    print(f"seeds {first} to {first + studies - 1}; 95 % bootstrap intervals over studies")
    for heading, design in DESIGNS.items():
        scores, squares = [], []
        for seed in range(first, first + studies * (8 // design.sites)):
            study = true_chains(seed, design)
            scores.append(score(study))
            squares.extend(phase_errors(study))
        show(heading, scores)
        print(f"  phase error {np.sqrt(np.mean(squares)):.3f} of a cycle RMS")
    if rendered:
        show("through the segmenter", [score(segment_study(seed)) for seed in range(first, first + rendered)])


def segment_study(seed: int) -> Study:
    """Segment a rendered study of 8 sites.

    Each site has a lateral and a postero-anterior view of 2 s at 15 frames/s.
    """
    spec = StudySpec(seed, sites=8, contrast=("LAT", "PA"), gantry_error_deg=GANTRY_ERROR_DEG)
    simulated = simulate_study(spec)
    segmenter = CatheterChain()
    sites, pixels, phases = [], [], []
    for site in simulated.sites:
        cameras = [camera_from_gantry(run.gantry) for run in site.runs]
        found = [
            segmenter.segment(
                Run(MemoryFrames(run.frames), run.frame_times_ms, camera.px_per_mm, PixelFacts(False, 12, False)),
                DEFAULT_CATALOGUE, {}, Silent(),
            )
            for run, camera in zip(site.runs, cameras, strict=True)
        ]  # fmt: skip
        sites.append(SiteRuns(site.name, cameras[0], cameras[1], found[0], found[1]))
        pixels.append((site.runs[0].truth.pixels_uv, site.runs[1].truth.pixels_uv))
        phases.append((site.runs[0].truth.phases, site.runs[1].truth.phases))
    return Study(tuple(sites), tuple(pixels), tuple(phases))


if __name__ == "__main__":
    main(*(int(value) for value in [*sys.argv[1:4], *("900", "60", "2")[len(sys.argv[1:4]) :]]))
