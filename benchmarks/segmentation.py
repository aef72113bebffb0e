"""Accuracy of segmentation: ``python benchmarks/segmentation.py [first seed] [seeds] [frames]``.

All segmenters process runs of the phantom at 60 frames a second. The benchmark prints, with a bootstrap interval over runs:

- recall and precision; a detection is correct within 5 px of the truth,
- the share of frames with all electrodes of the reference and the mapping catheter,
- RMS,
- the share of catheter-frames on the correct track,
- the share of 95 % ellipses that hold the truth.

The last lines count frames without catheters in which a segmenter accepts one. ``benchmarks/segmentation_speed.py`` measures
speed.
"""

from __future__ import annotations

import io
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from decapolar_runs import CATALOGUE as DECAPOLAR_CATALOGUE
from decapolar_runs import RenderedRun, decapolar_run
from memory_frames import MemoryFrames
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import gaussian_filter
from scipy.optimize import linear_sum_assignment

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue
from fluoromap.contracts import Chain, PixelFacts, Run, Segmentation, Segmenter, Silent
from fluoromap.geometry import Gantry
from fluoromap.phantom import APPEARANCES, FRONTAL, LATERAL, Contrast, SimulatedRun, StudySpec, simulate_study
from fluoromap.phantom.fluoroscopy import detect, expected_photons
from fluoromap.phantom.torso import torso
from fluoromap.segmenter.catheter_chain.plugin import CatheterChain
from fluoromap.segmenter.four_step.plugin import FourStep
from fluoromap.segmenter.learned_chain.plugin import LearnedChain

Array = NDArray[np.float64]

NEAR_PX = 5.0
TRACK_PX = 6.0
MOVING_PX = 3.0
FACTS = PixelFacts(logarithmic=False, bits_stored=12, monochrome1=False)
DISPLAYED = PixelFacts(logarithmic=True, bits_stored=8, monochrome1=False)
CHI2_95_2D = 5.991464547107979
SEGMENTERS: dict[str, Callable[[], Segmenter]] = {
    "four-step": FourStep,
    "catheter-chain": CatheterChain,
    "learned-chain": LearnedChain,
}
CHAINS = "catheter-chain", "learned-chain"
VIEWS: tuple[Contrast, Contrast] = ("LAT", "PA")


@dataclass
class Counts:
    """Counts of correct detections in one run, or a part of it."""

    right: int = 0
    there: int = 0
    found: int = 0
    complete: int = 0
    frames: int = 0
    squares: float = 0.0
    on_track: int = 0
    catheter_frames: int = 0
    inside: int = 0
    ellipses: int = 0


@dataclass
class Table:
    """Counts of each run under each heading."""

    rows: dict[str, list[Counts]] = field(default_factory=dict)

    def add(self, heading: str, counts: Counts) -> None:
        if counts.frames:
            self.rows.setdefault(heading, []).append(counts)

    def show(self) -> None:
        print(
            f"{'':40}{'recall':>19}{'precision':>19}{'ref+map':>19}{'RMS px':>17}{'on track':>19}{'in ellipse':>19}  runs"
        )
        for heading, runs in self.rows.items():
            sums = np.array([list(vars(counts).values()) for counts in runs], dtype=np.float64)
            drawn = np.random.default_rng(0).integers(0, len(runs), (1000, len(runs)))
            cells = []
            for name in ("recall", "precision", "complete", "rms", "track", "ellipse"):
                value = _ratio(sums.sum(axis=0), name)
                if not np.isfinite(value):
                    cells.append("-")
                    continue
                low, high = np.nanpercentile([_ratio(sums[rows].sum(axis=0), name) for rows in drawn], [2.5, 97.5])
                cells.append(
                    f"{value:6.3f} {low:.3f}-{high:.3f}" if name != "rms" else f"{value:5.2f} {low:.2f}-{high:.2f}"
                )
            print(
                f"{heading:40}" + "".join(f"{cell:>19}" if k != 3 else f"{cell:>17}" for k, cell in enumerate(cells)),
                f"{len(runs):5}",
            )


def _ratio(sums: Array, name: str) -> float:
    of = dict(zip(vars(Counts()), sums, strict=True))
    upper, lower = {
        "recall": ("right", "there"),
        "precision": ("right", "found"),
        "complete": ("complete", "frames"),
        "rms": ("squares", "right"),
        "track": ("on_track", "catheter_frames"),
        "ellipse": ("inside", "ellipses"),
    }[name]
    value = float(of[upper] / of[lower]) if of[lower] else np.nan
    return float(np.sqrt(value)) if name == "rms" else value


def main(first: int, seeds: int, frames: int) -> None:
    """Print all tables, on seeds ``first`` to ``first + seeds - 1``."""
    table = Table()
    spent = {name: [0.0, 0] for name in SEGMENTERS}
    for seed in range(first, first + seeds):
        study = simulate_study(StudySpec(seed, sites=1, frames=frames, frame_rate_hz=60.0, heart="dog", contrast=VIEWS))
        for view, simulated in zip(VIEWS, study.sites[0].runs, strict=True):
            _score_run(table, spent, view, simulated, tuple(SEGMENTERS))
        for what, spec in hard_studies(seed, frames).items():
            for view, simulated in zip(VIEWS, simulate_study(spec).sites[0].runs, strict=True):
                _score_run(table, None, f"{view} {what}", simulated, CHAINS)
        for width_mm, spec in _displayed(seed, frames).items():
            for view, simulated in zip(VIEWS, simulate_study(spec).sites[0].runs, strict=True):
                _score_run(
                    table, None, f"{view} {1024 / width_mm:.2f} px/mm, 8 bit JPEG", simulated, CHAINS, displayed=True
                )
        for view, gantry in zip(VIEWS, gantries(292.0), strict=True):
            for cables in (False, True):
                rendered = decapolar_run(seed, view, gantry, frames, cables)
                _score_rendered(table, f"{view} decapolar, 3.5 px/mm" + (", cables" if cables else ""), rendered)
    print(f"seeds {first} to {first + seeds - 1}, {frames} frames a run; mean and 95 % bootstrap interval over runs")
    table.show()
    for name, (seconds, count) in spent.items():
        print(f"{name}: {1000 * seconds / count:.1f} ms a frame, all included")
    _without_catheters(first, seeds)


def _without_catheters(first: int, seeds: int) -> None:
    """Segment single frames of the phantom's torso without catheters: none should be accepted."""
    for name, segmenter in SEGMENTERS.items():
        accepted = count = 0
        for seed in range(first, first + seeds):
            for contrast, gantry in zip(VIEWS, (LATERAL, FRONTAL), strict=True):
                appearance = APPEARANCES[contrast]
                behind = torso(gantry, appearance, np.random.default_rng(seed), np.random.default_rng([seed, 1]), 0.0)
                photons = expected_photons(behind, np.ones((gantry.rows, gantry.columns), np.float32), appearance, 1.0)
                for key in range(3):
                    frames = MemoryFrames([detect(photons, appearance.photons, 10 * seed + key)])
                    found = segmenter().segment(
                        Run(frames, np.zeros(1), 1024 / 178, FACTS), DEFAULT_CATALOGUE, {}, Silent()
                    )
                    accepted += bool(found.frames[0].chains)
                    count += 1
        print(f"{name}: {accepted} of {count} frames without catheters accepted")


def hard_studies(seed: int, frames: int) -> dict[str, StudySpec]:
    return {
        "dose 0.4": StudySpec(seed, sites=1, frames=frames, frame_rate_hz=60.0, heart="dog", contrast=VIEWS, dose=0.4),
        "4.1 px/mm": StudySpec(
            seed, sites=1, frames=frames, frame_rate_hz=60.0, heart="dog", contrast=VIEWS, gantries=gantries(250.0)
        ),
    }


def _displayed(seed: int, frames: int) -> dict[float, StudySpec]:
    """Return the studies whose runs are shown as 8 bit JPEG.

    The key is the width of the field on the detector, mm.
    """
    return {
        width_mm: StudySpec(
            seed,
            sites=1,
            frames=frames,
            frame_rate_hz=60.0,
            heart="dog",
            contrast=VIEWS,
            gantries=gantries(width_mm),
        )
        for width_mm in (178.0, 250.0, 330.0)
    }


def gantries(width_mm: float) -> tuple[Gantry, Gantry]:
    spacing = width_mm / 512
    lateral, frontal = (Gantry(angle, 0.0, 1000.0, 500.0, (spacing, spacing), 512, 512) for angle in (90.0, 0.0))
    return lateral, frontal


def as_jpeg(frame: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Return a frame as a lab displays and stores it.

    The steps are logarithm, sharpening, 8 bit and JPEG of quality 85.
    """
    level = np.log(frame.astype(np.float64) + 1.0)
    level += 0.8 * (level - gaussian_filter(level, 3.0))
    low, high = np.percentile(level, [0.5, 99.5])
    stored = io.BytesIO()
    Image.fromarray((np.clip((level - low) / (high - low), 0.0, 1.0) * 255).astype(np.uint8)).save(
        stored, "JPEG", quality=85
    )
    return np.asarray(Image.open(stored))


def _score_run(
    table: Table,
    spent: dict[str, list[float]] | None,
    view: str,
    simulated: SimulatedRun,
    names: tuple[str, ...],
    displayed: bool = False,
) -> None:
    in_memory = MemoryFrames([as_jpeg(frame) for frame in simulated.frames] if displayed else simulated.frames)
    gantry = simulated.gantry
    px_per_mm = gantry.source_detector_mm / gantry.source_isocentre_mm / gantry.pixel_spacing_mm[0]
    run = Run(in_memory, simulated.frame_times_ms, px_per_mm, DISPLAYED if displayed else FACTS)
    truth = simulated.truth.pixels_uv
    moved = np.linalg.norm(np.diff(np.concatenate(list(truth.values()), axis=1), axis=0), axis=2).max(axis=1)
    moving = np.concatenate([moved[:1], moved]) > MOVING_PX
    for name in names:
        start = time.process_time()
        found = SEGMENTERS[name]().segment(run, DEFAULT_CATALOGUE, {}, Silent())
        if spent is not None:
            spent[name][0] += time.process_time() - start
            spent[name][1] += len(in_memory)
        parts = {"": np.ones(len(in_memory), bool)} if spent is None else {" quiet": ~moving, " moving": moving}
        for part, chosen in parts.items():
            frames = np.flatnonzero(chosen)
            counts = Counts()
            for frame in frames:
                _count(counts, found.frames[frame].chains, {key: uv[frame] for key, uv in truth.items()})
            _count_tracks(counts, found, truth, frames)
            table.add(f"{name} {view}{part}", counts)
        averaged = list(found.diastole_frames)
        if found.diastole is not None:
            counts = Counts()
            _count(counts, found.diastole.chains, {key: uv[averaged].mean(axis=0) for key, uv in truth.items()})
            table.add(f"{name} {view} diastolic mean", counts)


def _score_rendered(table: Table, view: str, rendered: RenderedRun) -> None:
    """Score a decapolar and an ablation catheter, as 8 bit JPEG."""
    in_memory = MemoryFrames([as_jpeg(frame) for frame in rendered.frames])
    run = Run(in_memory, rendered.times_ms, rendered.px_per_mm, DISPLAYED)
    for name in CHAINS:
        found = SEGMENTERS[name]().segment(run, DECAPOLAR_CATALOGUE, {}, Silent())
        counts = Counts()
        for entry in found.frames:
            truth = {key: uv[entry.frame] for key, uv in rendered.truth.items()}
            _count(counts, entry.chains, truth, DECAPOLAR_CATALOGUE)
        _count_tracks(counts, found, rendered.truth, np.arange(len(in_memory)))
        table.add(f"{name} {view}", counts)


def _count(
    counts: Counts, chains: tuple[Chain, ...], truth: dict[str, Array], catalogue: Catalogue = DEFAULT_CATALOGUE
) -> None:
    points = np.concatenate([chain.pixels_uv for chain in chains]) if chains else np.zeros((0, 2))
    everything = np.concatenate(list(truth.values()))
    distances = _matched(points, everything)
    counts.right += len(distances)
    counts.there += len(everything)
    counts.found += len(points)
    counts.squares += float((distances**2).sum())
    wanted = np.concatenate([truth[catalogue.reference], truth[catalogue.mapping]])
    counts.complete += len(_matched(points, wanted)) == len(wanted)
    counts.frames += 1
    for chain in chains:
        for uv in truth.values():
            if chain.electrodes[-1] > len(uv):
                continue
            error = chain.pixels_uv - uv[[number - 1 for number in chain.electrodes]]
            if np.linalg.norm(error, axis=1).max() < TRACK_PX:
                squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(chain.covariance_px2), error)
                counts.inside += int((squared <= CHI2_95_2D).sum())
                counts.ellipses += len(error)


def _matched(points: Array, truth: Array) -> Array:
    """Return the distances of the correct detections; each true electrode counts once."""
    if not len(points):
        return np.zeros(0)
    distance = np.linalg.norm(points[:, None] - truth[None], axis=2)
    rows, columns = linear_sum_assignment(np.minimum(distance, 4 * NEAR_PX))
    pairs: Array = distance[rows, columns]
    return pairs[pairs <= NEAR_PX]


def _count_tracks(counts: Counts, found: Segmentation, truth: Mapping[str, Array], frames: NDArray[np.int64]) -> None:
    """Count correct catheter-frames.

    A catheter's track is the track that lies on it in most frames. A catheter-frame is correct where this track lies on all
    electrodes of the catheter.
    """
    of_track: dict[int, dict[str, list[int]]] = {}
    for entry in found.frames:
        for chain in entry.chains:
            for name, uv in truth.items():
                if chain.electrodes[-1] > uv.shape[1]:
                    continue
                error = chain.pixels_uv - uv[entry.frame][[number - 1 for number in chain.electrodes]]
                if np.linalg.norm(error, axis=1).max() < TRACK_PX:
                    of_track.setdefault(chain.track, {}).setdefault(name, []).append(entry.frame)
    named: set[str] = set()
    for names in sorted(of_track.values(), key=lambda names: -max(map(len, names.values()))):
        name = max(names, key=lambda name: len(names[name]))
        if name not in named:
            named.add(name)
            counts.on_track += len(set(names[name]) & set(frames.tolist()))
    counts.catheter_frames += len(truth) * len(frames)


if __name__ == "__main__":
    given = [int(argument) for argument in sys.argv[1:]]
    main(*(given + [7000, 20, 40][len(given) :]))
