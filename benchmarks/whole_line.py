"""Accuracy of the whole line in a laboratory's setting: ``python benchmarks/whole_line.py [first seed] [seeds] [options]``.

A phantom's study with a decapolar catheter in the coronary sinus as reference, a hexapolar and an ablation catheter: 3.5 px/mm at
the isocentre, shown and stored as 8 bit JPEG, with gantry errors (0.3 degrees, 0.6 mm an axis of a view) and breathing. The runs go
through the stages of a job: ``learned-chain``, matching, triangulation. ``--case`` chooses other catalogues of 2 to 6 catheters.

Prints for each seed and for all: sites that were located, catheters with the right name (all electrodes within 5 px of their own
place in both views at diastole), the mapping tip's error relative to the reference catheter and the same for all electrodes (RMS,
mm), and the share of 95 % ellipsoids that hold the true relative position. The last line gives the bootstrap interval over seeds.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from ellipsoid_coverage import misidentified
from memory_frames import MemoryFrames
from numpy.typing import NDArray
from segmentation import DISPLAYED, as_jpeg

from fluoromap.catheters import Catalogue, catheter_type
from fluoromap.contracts import CHI2_95_3D, LocatedSite, MatchedSite, Run, Segmentation, Segmenter, Silent
from fluoromap.geometry import Gantry, camera_from_gantry
from fluoromap.matching import SiteRuns, match_study
from fluoromap.phantom import Contrast, SimulatedRun, SimulatedSite, SimulatedStudy, StudySpec, simulate_study
from fluoromap.segmenter.catheter_chain.plugin import CatheterChain
from fluoromap.segmenter.learned_chain.plugin import LearnedChain
from fluoromap.triangulator.maximum_likelihood import MaximumLikelihood
from fluoromap.triangulator.reference_origin import usual_electrodes
from fluoromap.triangulator.uncertainty import UncertaintyParams

Array = NDArray[np.float64]

FIELD_MM = 292.0
CASES: dict[str, tuple[str, ...]] = {
    "lab": ("decapolar-2-5-2", "hexapolar-2-5-2", "ablation-4"),
    "two": ("quadripolar-2-5-2", "ablation-4"),
    "leads": ("quadripolar-2-5-2", "pacing-lead", "ablation-4"),
    "circular": ("quadripolar-2-5-2", "circular-10", "ablation-4"),
    "duodecapolar": ("duodecapolar-2-2-2", "quadripolar-2-5-2", "ablation-8"),
    "six": (
        "decapolar-2-5-2", "hexapolar-2-5-2", "quadripolar-2-5-2", "quadripolar-5-5-5", "octapolar-2-5-2", "ablation-3.5",
    ),
}  # fmt: skip
"""Types of the catheters: the first is the reference, the last maps."""
CONTRASTS: dict[str, tuple[Contrast, Contrast]] = {"LAT": ("LAT", "LAT"), "PA": ("PA", "PA"), "LAT+PA": ("LAT", "PA")}
SEGMENTERS: dict[str, type[Segmenter]] = {"learned-chain": LearnedChain, "catheter-chain": CatheterChain}


@dataclass
class Tally:
    """Results of one seed, or of several.

    tip_mm, all_mm : squared errors relative to the reference. inside : of the ellipsoids, 1 or 0.
    """

    sites: int = 0
    located: int = 0
    named: int = 0
    wrong: int = 0
    catheters: int = 0
    tip_mm2: list[float] = field(default_factory=list)
    all_mm2: list[float] = field(default_factory=list)
    inside: list[bool] = field(default_factory=list)

    def row(self) -> str:
        """Return the tally as a line of the table."""
        return (
            f"{self.located:5}/{self.sites:<4}{self.named:7}/{self.catheters:<5}{self.wrong:6}{_rms(self.tip_mm2):9.2f}"
            f"{_rms(self.all_mm2):9.2f}{_mean(self.inside):10.3f}{len(self.inside):9}"
        )


def main() -> None:
    """Print a line for each seed, and one for all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seed", type=int, nargs="?", default=9300)
    parser.add_argument("seeds", type=int, nargs="?", default=5)
    parser.add_argument("--case", choices=CASES, default="lab")
    parser.add_argument("--segmenter", choices=SEGMENTERS, default="learned-chain")
    parser.add_argument("--sites", type=int, default=5)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--contrast", choices=CONTRASTS, default="LAT", help="appearance of the views")
    parser.add_argument("--draw", type=Path, metavar="FOLDER", help="draw a frame of each run")
    given = parser.parse_args()
    catalogue = catalogue_of(CASES[given.case])
    print(
        f"{given.case}: {', '.join(CASES[given.case])}; {given.segmenter}, {given.contrast}, {given.frames} frames a run"
    )
    print(f"{'seed':8}{'located':>10}{'named':>13}{'wrong':>6}{'tip mm':>9}{'all mm':>9}{'inside':>10}{'points':>9}")
    tallies = []
    for seed in range(given.seed, given.seed + given.seeds):
        spec = StudySpec(
            seed, sites=given.sites, frames=given.frames, contrast=CONTRASTS[given.contrast], gantries=gantries(),
            gantry_error_deg=0.3, isocentre_error_mm=0.6, catalogue=catalogue,
        )  # fmt: skip
        tallies.append(measure(spec, SEGMENTERS[given.segmenter](), given.draw))
        print(f"{seed:<8}{tallies[-1].row()}", flush=True)
    _show_all(tallies)


def catalogue_of(types: Sequence[str]) -> Catalogue:
    """Return the catalogue of these types: the first is the reference, the last maps."""
    names = ["reference", *(f"{number} {name}" for number, name in enumerate(types[1:-1], 2)), "mapping"]
    catheters = tuple(catheter_type(type_name, name) for type_name, name in zip(types, names, strict=True))
    return Catalogue(catheters, "reference", "mapping")


def gantries() -> tuple[Gantry, Gantry]:
    """Return a lateral and a frontal view with 3.5 px/mm at the isocentre."""
    spacing = FIELD_MM / 512
    lateral, frontal = (Gantry(angle, 0.0, 1000.0, 500.0, (spacing, spacing), 512, 512) for angle in (90.0, 0.0))
    return lateral, frontal


def measure(spec: StudySpec, segmenter: Segmenter, pictures: Path | None = None) -> Tally:
    """Take one simulated study through the stages and compare it with its truth."""
    study = simulate_study(spec)
    runs = []
    for site in study.sites:
        found = [_segment(run, study.catalogue, segmenter) for run in site.runs]
        if pictures is not None:
            _draw(site, found, pictures, spec.seed)
        cameras = [camera_from_gantry(run.gantry) for run in site.runs]
        runs.append(SiteRuns(site.name, cameras[0], cameras[1], found[0], found[1]))
    matching = match_study(runs, study.catalogue, Silent())
    located = MaximumLikelihood(UncertaintyParams()).triangulate(matching.sites, study.catalogue, Silent())
    tally = Tally(sites=spec.sites, catheters=spec.sites * len(study.catalogue.catheters))
    for matched in matching.sites:
        truth = next(site for site in study.sites if site.name == matched.site)
        for catheter in study.catalogue.catheters:
            wrong = [misidentified(matched, truth, (catheter.name, k + 1)) for k in range(catheter.electrodes)]
            seen = all(_is_seen(matched, catheter.name, view) for view in (0, 1))
            tally.named += seen and not any(wrong)
            tally.wrong += any(wrong)
    origin = usual_electrodes(located.sites, study.catalogue.reference)
    for at_site in located.sites:
        _count(tally, at_site, study, origin)
    return tally


def _segment(run: SimulatedRun, catalogue: Catalogue, segmenter: Segmenter) -> Segmentation:
    frames = MemoryFrames([as_jpeg(frame) for frame in run.frames])
    px_per_mm = camera_from_gantry(run.gantry).px_per_mm
    return segmenter.segment(Run(frames, run.frame_times_ms, px_per_mm, DISPLAYED), catalogue, {}, Silent())


def _is_seen(matched: MatchedSite, name: str, view: int) -> bool:
    observation = (matched.runs.diastole.a, matched.runs.diastole.b)[view]
    return any(chain.catheter == name for chain in observation.chains)


def _count(tally: Tally, at_site: LocatedSite, study: SimulatedStudy, origin: tuple[int, ...]) -> None:
    """Compare a site with its truth.

    The origin is the mean of these electrodes of the reference catheter.
    """
    truth = next(site for site in study.sites if site.name == at_site.site).truth
    if not origin:
        tally.located += 1
        return
    origin_mm = truth.relative_mm[study.catalogue.reference][[number - 1 for number in origin]].mean(axis=0)
    tally.located += 1
    for point in at_site.points:
        if point.relative_mm is None or point.relative_covariance_mm2 is None:
            continue
        error = point.relative_mm - truth.relative_mm[point.catheter][point.electrode - 1] + origin_mm
        square = float(error @ error)
        tally.all_mm2.append(square)
        if (point.catheter, point.electrode) == (study.catalogue.mapping, 1):
            tally.tip_mm2.append(square)
        tally.inside.append(float(error @ np.linalg.solve(point.relative_covariance_mm2, error)) <= CHI2_95_3D)


def _show_all(tallies: Sequence[Tally]) -> None:
    together = Tally()
    for tally in tallies:
        for name, value in vars(tally).items():
            setattr(together, name, getattr(together, name) + value)
    print(f"{'all':<8}{together.row()}")
    random = np.random.default_rng(0)
    drawn = [[tallies[k] for k in random.integers(0, len(tallies), len(tallies))] for _ in range(1000)]
    tips = [_rms([square for tally in some for square in tally.tip_mm2]) for some in drawn]
    covered = [_mean([one for tally in some for one in tally.inside]) for some in drawn]
    low, high = np.nanpercentile(tips, [2.5, 97.5])
    first, last = np.nanpercentile(covered, [2.5, 97.5])
    print(f"95 % bootstrap interval over seeds: tip {low:.2f} to {high:.2f} mm, inside {first:.3f} to {last:.3f}")


def _draw(site: SimulatedSite, found: Sequence[Segmentation], folder: Path, seed: int) -> None:
    from real_frames import drawn

    folder.mkdir(parents=True, exist_ok=True)
    for run, segmentation in zip(site.runs, found, strict=True):
        entry = segmentation.frames[len(segmentation.frames) // 2]
        labels = {
            name: {k + 1: uv for k, uv in enumerate(pixels[entry.frame])}
            for name, pixels in run.truth.pixels_uv.items()
        }
        drawn(as_jpeg(run.frames[entry.frame]), entry.chains, labels).save(
            folder / f"{seed}-{site.name}-{run.view}.png"
        )


def _rms(squares: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(squares))) if squares else np.nan


def _mean(values: Sequence[bool]) -> float:
    return float(np.mean(values)) if values else np.nan


if __name__ == "__main__":
    main()
