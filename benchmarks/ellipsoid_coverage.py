"""Coverage of 95 % ellipsoids: ``python benchmarks/ellipsoid_coverage.py [first seed] [hearts] [--given]``.

Hearts are drawn with the triangulator's parameters (gantry angles 0.5 degrees, isocentre 0.5 mm, breathing 4 mm to head
and feet). They go through the whole pipeline: a study is rendered, segmented by ``catheter-chain``, matched, triangulated.
With ``--given`` nothing is rendered: true pixels with 0.5 px of noise go into matching. This is fast enough for hundreds of
hearts; hearts with an exact gantry and with a worse one than assumed are then counted too.

Electrodes graded A to C count. Misidentified electrodes (farther than 5 px from their place in a view) are counted
separately. The interval is a bootstrap over hearts, because the electrodes of one heart share their errors. Errors are RMS
in 3D, beside the errors that the covariances state. The last lines give the mean error budget and the share of hearts whose
gantry was calibrated.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field

import numpy as np
from memory_frames import MemoryFrames
from numpy.typing import NDArray

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import (
    CHI2_95_3D,
    Chain,
    FrameChains,
    MatchedSite,
    Matching,
    PixelFacts,
    Run,
    Segmentation,
    Silent,
    Triangulation,
)
from fluoromap.diastole import diastolic_frames
from fluoromap.geometry import camera_from_gantry
from fluoromap.matching import SiteRuns, match_study
from fluoromap.phantom import SimulatedRun, SimulatedSite, SimulatedStudy, StudySpec, simulate_study
from fluoromap.segmenter.catheter_chain.plugin import CatheterChain
from fluoromap.triangulator.maximum_likelihood import MaximumLikelihood
from fluoromap.triangulator.uncertainty import UncertaintyParams

Array = NDArray[np.float64]

NEAR_PX = 5.0
NOISE_PX = 0.5
SITES = 4
FRAMES = 30
FACTS = PixelFacts(logarithmic=False, bits_stored=12, monochrome1=False)
GANTRIES = {"gantry as assumed": (0.5, 0.5), "gantry exact": (0.0, 0.0), "gantry 0.7 deg, 1.4 mm a view": (0.7, 1.4)}
"""Standard deviation per axis of a view's rotation in degrees and of its offset in mm."""


@dataclass(frozen=True, eq=False)
class Sample:
    """An estimate's error (3,) in mm and its covariance (3, 3); a ``misidentified`` estimate does not count."""

    heading: str
    error_mm: Array
    covariance_mm2: Array
    misidentified: bool = False


@dataclass(frozen=True, eq=False)
class Heart:
    """One simulated study with its truth, its matching and its triangulation."""

    study: SimulatedStudy
    matching: Matching
    triangulation: Triangulation

    def truth(self, site: str) -> SimulatedSite:
        return next(one for one in self.study.sites if one.name == site)

    def matched(self, site: str) -> MatchedSite:
        return next(one for one in self.matching.sites if one.site == site)


def segment_rendered(run: SimulatedRun, seed: int) -> Segmentation:
    """Segment the rendered run by ``catheter-chain``."""
    camera = camera_from_gantry(run.gantry)
    frames = MemoryFrames(run.frames)
    return CatheterChain().segment(
        Run(frames, run.frame_times_ms, camera.px_per_mm, FACTS), DEFAULT_CATALOGUE, {}, Silent()
    )


def segment_ideally(run: SimulatedRun, seed: int) -> Segmentation:
    """Return the run's true pixels with noise, as an ideal segmenter.

    Diastole follows the segmenters' own rule.
    """
    rng = np.random.default_rng([seed, int(run.start_seconds * 1000)])
    names = DEFAULT_CATALOGUE.names
    n = len(run.frame_times_ms)
    places = np.concatenate([run.truth.pixels_uv[name] for name in names], axis=1)
    moved = np.sqrt((np.diff(places, axis=0) ** 2).sum(axis=2).mean(axis=1))
    motion = np.concatenate([moved[:1], moved]) + 0.05
    quiet = diastolic_frames(motion, run.frame_times_ms)

    def chains(frames: list[int]) -> tuple[Chain, ...]:
        found = []
        for track, name in enumerate(names):
            pixels = run.truth.pixels_uv[name][frames].mean(axis=0)
            electrodes = len(pixels)
            p = 0.8 if name == DEFAULT_CATALOGUE.mapping else 0.1
            kinds = tuple((other, p if other == DEFAULT_CATALOGUE.mapping else (1 - p) / 2) for other in names)
            found.append(
                Chain(
                    tuple(range(1, electrodes + 1)),
                    pixels + rng.normal(0, NOISE_PX, pixels.shape),
                    np.broadcast_to(NOISE_PX**2 * np.eye(2), (electrodes, 2, 2)),
                    np.full(electrodes, 10.0),
                    kinds,
                    track,
                )
            )
        return tuple(found)

    frames = tuple(FrameChains(frame, chains([frame])) for frame in range(n))
    diastole = FrameChains(quiet[len(quiet) // 2], chains(list(quiet)))
    return Segmentation(frames, diastole, quiet, motion, run.frame_times_ms)


def process_heart(spec: StudySpec, segment: Callable[[SimulatedRun, int], Segmentation]) -> Heart:
    """Simulate, segment, match and triangulate one study."""
    study = simulate_study(spec)
    runs = tuple(
        SiteRuns(
            site.name,
            camera_from_gantry(site.runs[0].gantry),
            camera_from_gantry(site.runs[1].gantry),
            segment(site.runs[0], spec.seed),
            segment(site.runs[1], spec.seed),
        )
        for site in study.sites
    )
    matching = match_study(runs, DEFAULT_CATALOGUE, Silent())
    solver = MaximumLikelihood(UncertaintyParams())
    return Heart(study, matching, solver.triangulate(matching.sites, DEFAULT_CATALOGUE, Silent()))


def point_samples(heart: Heart) -> Iterator[Sample]:
    """Yield every electrode located at diastole, from the isocentre and from the reference catheter."""
    for site in heart.triangulation.sites:
        truth, matched = heart.truth(site.site), heart.matched(site.site)
        for point in site.points:
            label = point.catheter, point.electrode
            wrong = misidentified(matched, truth, label)
            place = truth.truth.diastole_mm[point.catheter][point.electrode - 1]
            yield Sample("points, absolute", point.position_mm - place, point.covariance_mm2, wrong)
            if point.relative_mm is not None and point.relative_covariance_mm2 is not None:
                # Where the reference itself is misidentified, no relative position counts.
                lost = wrong or any(
                    misidentified(matched, truth, (DEFAULT_CATALOGUE.reference, electrode)) for electrode in range(1, 5)
                )
                place = truth.truth.relative_mm[point.catheter][point.electrode - 1]
                yield Sample("points, relative", point.relative_mm - place, point.relative_covariance_mm2, lost)


def misidentified(matched: MatchedSite, truth: SimulatedSite, label: tuple[str, int]) -> bool:
    """Return whether a view took something else for this electrode at diastole."""
    for observation, run in zip((matched.runs.diastole.a, matched.runs.diastole.b), truth.runs, strict=True):
        for chain in observation.chains:
            if chain.catheter == label[0] and label[1] in chain.electrodes:
                pixel = chain.pixels_uv[chain.electrodes.index(label[1])]
                if np.linalg.norm(pixel - run.truth.pixels_uv[label[0]][observation.frame, label[1] - 1]) > NEAR_PX:
                    return True
    return False


@dataclass
class Coverage:
    """Samples of each heart under each heading."""

    hearts: dict[str, list[list[Sample]]] = field(default_factory=dict)
    studies: dict[str, list[Triangulation]] = field(default_factory=dict)

    def add(self, prefix: str, samples: Iterable[Sample]) -> None:
        mine: dict[str, list[Sample]] = {}
        for sample in samples:
            mine.setdefault(f"{prefix}: {sample.heading}", []).append(sample)
        for heading, found in mine.items():
            self.hearts.setdefault(heading, []).append(found)

    def show(self) -> None:
        print(
            f"{'':48}{'in 95 % ellipsoid':>22}{'RMS mm':>9}{'stated':>9}{'estimates':>11}{'misident.':>11}{'hearts':>8}"
        )
        for heading, hearts in self.hearts.items():
            sums = np.array([_sums(samples) for samples in hearts])
            inside, count, squares, stated, wrong = sums.sum(axis=0)
            drawn = sums[np.random.default_rng(0).integers(0, len(sums), (2000, len(sums)))].sum(axis=1)
            low, high = np.percentile(drawn[:, 0] / np.maximum(drawn[:, 1], 1), [2.5, 97.5])
            share = f"{inside / max(count, 1):.3f} {low:.3f}-{high:.3f}"
            rms, said = np.sqrt(squares / max(count, 1)), np.sqrt(stated / max(count, 1))
            print(f"{heading:48}{share:>22}{rms:9.3f}{said:9.3f}{count:11.0f}{wrong:11.0f}{len(hearts):8}")

    def show_budgets(self) -> None:
        for name, studies in self.studies.items():
            budgets = [asdict(study.budget) for study in studies if study.budget is not None]
            applied = np.mean([study.calibration is not None and study.calibration.applied for study in studies])
            mean = {key: float(np.mean([budget[key] for budget in budgets])) for key in budgets[0]}
            parts = ", ".join(f"{key.removesuffix('_mm').replace('_', ' ')} {value:.2f}" for key, value in mean.items())
            print(f"{name}: calibrated {applied:.2f}; error budget in mm: {parts}")


def _sums(samples: list[Sample]) -> list[float]:
    """Return the sums: inside, counted, squared error, stated variance, misidentified."""
    counted = [sample for sample in samples if not sample.misidentified]
    errors = np.array([sample.error_mm for sample in counted]).reshape(-1, 3)
    covariances = np.array([sample.covariance_mm2 for sample in counted]).reshape(-1, 3, 3)
    distances = np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[..., None])[..., 0])
    return [
        float((distances <= CHI2_95_3D).sum()), len(counted), float((errors**2).sum()),
        float(np.trace(covariances, axis1=1, axis2=2).sum()), len(samples) - len(counted),
    ]  # fmt: skip


def main(first_seed: int, hearts: int, use_given: bool) -> None:
    table = Coverage()
    populations = list(GANTRIES.items()) if use_given else list(GANTRIES.items())[:1]
    for number, seed in enumerate(range(first_seed, first_seed + hearts)):
        for name, (angle_deg, offset_mm) in populations:
            spec = StudySpec(seed, sites=SITES, frames=FRAMES, gantry_error_deg=angle_deg, isocentre_error_mm=offset_mm)
            heart = process_heart(spec, segment_ideally if use_given else segment_rendered)
            table.add(name, point_samples(heart))
            table.studies.setdefault(name, []).append(heart.triangulation)
        if sys.stderr.isatty() or (number + 1) % 10 == 0:
            print(f"{number + 1} of {hearts} hearts", file=sys.stderr, flush=True)
    table.show()
    table.show_budgets()


if __name__ == "__main__":
    words = [word for word in sys.argv[1:] if not word.startswith("-")]
    main(int(words[0]) if words else 9000, int(words[1]) if len(words) > 1 else 200, "--given" in sys.argv)
