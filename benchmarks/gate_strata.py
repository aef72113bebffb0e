"""The strata of the segmenter's gate: kinds of runs with truth, each drawn from a seed or read from the labelled real run."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from circular_catheters import loop_run
from decapolar_runs import CATALOGUE as DECAPOLAR_CATALOGUE
from decapolar_runs import decapolar_run
from memory_frames import MemoryFrames
from numpy.typing import NDArray
from real_frames import copies_of, empty_runs, labelled_runs
from segmentation import DISPLAYED, FACTS, VIEWS, as_jpeg, gantries, hard_studies

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue, catheter_type
from fluoromap.contracts import PixelFacts, Run
from fluoromap.phantom import SimulatedRun, StudySpec, simulate_study
from fluoromap.training import contrast_medium, implants, lines, probes
from fluoromap.training.cines import CineConditions, draw_cine

Array = NDArray[np.float64]

NEAR_PX = 5.0
"""How far an electrode may lie from its truth. Neighbouring rings in the image plane are 3 mm apart or more, 7 px at 2.4 px/mm."""
_REAL_SCALES = 2.4, 2.6, 2.7, 2.8, 3.1, 3.3, 3.45, 3.8, 4.0
_COPIES = 24
_VESSEL_LISTS = (
    ("quadripolar-2-5-2", "ablation-4"),
    ("decapolar-2-5-2", "ablation-4"),
    ("circular-10", "ablation-3.5"),
)
_SHOWN = {"quad_a": "ablation", "ablation": "quad_a"}
"""The labelled run's file names catheters by position; the long tip of an ablation catheter is on the row that it calls quad_a."""
_LIST = "decapolar-2-5-2", "ablation-4"
_PAIR = "quadripolar-2-5-2", "ablation-4"


@dataclass(frozen=True, slots=True, eq=False)
class GateRun:
    """A run and its truth.

    truth : of each frame, catheter -> (electrodes, 2) pixels, electrode 1 first; NaN where an electrode has no label. near_px : how
    far an electrode may lie from its truth.
    """

    run: Run
    catalogue: Catalogue
    truth: list[dict[str, Array]]
    near_px: float = NEAR_PX


@dataclass(frozen=True, slots=True)
class Stratum:
    """A kind of run: what it is called, and the run of a number from 0 on; ``most`` where there are only so many."""

    name: str
    draw: Callable[[int], GateRun]
    most: int | None = None


def strata(first_seed: int, real: Path | None) -> Iterator[Stratum]:
    """Yield all strata; those of real files only with a folder of them."""
    for name, kinds in _CINES.items():
        yield Stratum(name, _Drawn(name, kinds, first_seed))
    yield Stratum("phantom, 3 catheters", _Phantom(first_seed))
    yield Stratum("phantom, dose 0.4", _Phantom(first_seed, "dose 0.4"))
    yield Stratum("phantom, 4.1 px/mm", _Phantom(first_seed, "4.1 px/mm"))
    yield Stratum("phantom, decapolar, JPEG", _Decapolar(first_seed, cables=False))
    yield Stratum("phantom, decapolar under cables", _Decapolar(first_seed, cables=True))
    yield Stratum("phantom, loops", _loop)
    if real is None:
        return
    labelled = argparse.Namespace(folder=real / "real", frames=1000, px_per_mm=None, catheter=[])
    catalogue = Catalogue(
        (catheter_type("quadripolar-2-5-2", "quad_a"), catheter_type("quadripolar-2-5-2", "quad_b"),
         catheter_type("ablation-4", "ablation")), "quad_a", "ablation",
    )  # fmt: skip
    yield from _of_real_run(labelled, catalogue)
    vessels = argparse.Namespace(folder=real / "real_c_arm", frames=8, px_per_mm=None, catheter=[])
    yield Stratum("vessel phantom, three lists", *_vessels(vessels))


@dataclass(frozen=True, slots=True)
class _Drawn:
    """Cines of one kind; the kinds of a stratum take turns."""

    name: str
    kinds: tuple[CineConditions, ...]
    first_seed: int

    def __call__(self, number: int) -> GateRun:
        seed = [self.first_seed + number, *self.name.encode()]
        cine = draw_cine(np.random.default_rng(seed), self.kinds[number % len(self.kinds)])
        run = Run(MemoryFrames(cine.pixels), cine.times_ms, cine.px_per_mm, PixelFacts(cine.logarithmic, 8, False))
        truth = [{name: uv[frame] for name, uv in cine.truth.items()} for frame in range(len(cine.pixels))]
        return GateRun(run, cine.catalogue, truth)


def _clip(**more: object) -> CineConditions:
    return replace(CineConditions(_LIST), **more)  # type: ignore[arg-type]


_CINES: Mapping[str, tuple[CineConditions, ...]] = {
    "cines": (_clip(), _clip(types=_PAIR), _clip(types=("hexapolar-2-5-2", "decapolar-2-8-2", "ablation-3.5"))),
    "single frames": (_clip(frames=1), _clip(frames=1, types=_PAIR)),
    "3 to 6 frames": (_clip(frames=3), _clip(frames=4, types=_PAIR), _clip(frames=6)),
    "30 frames": (_clip(frames=30, rate_hz=30.0),),
    "120 frames": (_clip(frames=120, rate_hz=30.0, size=256),),
    "echo probe": (_clip(things=((probes.draw_echo_probe, True), (probes.draw_segmented_shaft, False))),),
    "leads": (_clip(leads=1), _clip(leads=2, types=_PAIR)),
    "ECG cables": (_clip(things=((lines.draw_cable, False),) * 2 + ((lines.draw_ecg_electrode, False),) * 2),),
    "contrast-filled vessels": (
        _clip(things=((contrast_medium.draw_vessels, True),) * 2),
        _clip(types=_PAIR, things=((contrast_medium.draw_vessels, True), (contrast_medium.draw_tubing, False))),
    ),
    "valve frames": (_clip(things=((implants.draw_valve_ring, True), (implants.draw_coil, False))),),
    "JPEG": (_clip(storage="jpeg"), _clip(storage="jpeg", types=_PAIR)),
    "coded video": (_clip(storage="video", display="sharp"), _clip(storage="video", types=_PAIR)),
    "edges enhanced": (_clip(display="sharp"), _clip(display="sharp", types=_PAIR)),
    "grey levels evened out by tiles": (_clip(display="tiles"), _clip(display="tiles", types=_PAIR)),
    "photographs of screens": (_clip(display="screen", frames=4), _clip(display="screen", frames=1)),
    "20 to 60 px a frame": (_clip(frames=4, step_px=(20.0, 60.0)), _clip(frames=6, step_px=(20.0, 60.0), types=_PAIR)),
    "blur 0.5 to 2.5 px": tuple(_clip(blur_px=blur) for blur in (0.5, 1.0, 1.6, 2.0, 2.5)),
    "2.4 to 2.8 px/mm": (_clip(px_per_mm=(2.4, 2.8)),),
    "4.5 to 6.5 px/mm": (_clip(px_per_mm=(4.5, 6.5), size=448),),
    "unlisted catheter": (_clip(types=("hexapolar-2-5-2", *_PAIR), listed=_PAIR),),
    "list with one too many": (_clip(types=_PAIR, listed=("decapolar-2-5-2", *_PAIR)),),
    "list with one too few": (_clip(types=("decapolar-2-5-2", *_PAIR), listed=_LIST),),
    "nothing but things": (
        _clip(types=(), listed=_LIST, leads=1, things=((lines.draw_cable, False), (contrast_medium.draw_vessels, True))),
        _clip(types=(), listed=_PAIR, things=((probes.draw_echo_probe, True), (implants.draw_coil, False))),
        _clip(types=(), listed=_LIST, frames=4, things=((probes.draw_sensor_row, True), (lines.draw_guide_wire, True))),
    ),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Phantom:
    """Runs of the simulated hearts, of both views in turn."""

    first_seed: int
    hard: str | None = None
    frames: int = 8

    def __call__(self, number: int) -> GateRun:
        seed, view = self.first_seed + number // 2, number % 2
        spec = StudySpec(seed, sites=1, frames=self.frames, frame_rate_hz=60.0, heart="dog", contrast=VIEWS)
        if self.hard is not None:
            spec = hard_studies(seed, self.frames)[self.hard]
        return _of_simulated(simulate_study(spec).sites[0].runs[view])


def _of_simulated(simulated: SimulatedRun) -> GateRun:
    gantry, truth = simulated.gantry, simulated.truth.pixels_uv
    px_per_mm = gantry.source_detector_mm / gantry.source_isocentre_mm / gantry.pixel_spacing_mm[0]
    frames = MemoryFrames(simulated.frames)
    run = Run(frames, simulated.frame_times_ms, px_per_mm, FACTS)
    return GateRun(run, DEFAULT_CATALOGUE, [{name: uv[k] for name, uv in truth.items()} for k in range(len(frames))])


@dataclass(frozen=True, slots=True)
class _Decapolar:
    first_seed: int
    cables: bool
    frames: int = 8

    def __call__(self, number: int) -> GateRun:
        seed, view = self.first_seed + number // 2, number % 2
        rendered = decapolar_run(seed, VIEWS[view], gantries(292.0)[view], self.frames, self.cables)
        frames = MemoryFrames([as_jpeg(frame) for frame in rendered.frames])
        run = Run(frames, rendered.times_ms, rendered.px_per_mm, DISPLAYED)
        truth = [{name: uv[k] for name, uv in rendered.truth.items()} for k in range(len(frames))]
        return GateRun(run, DECAPOLAR_CATALOGUE, truth)


def _loop(number: int) -> GateRun:
    """Return a run with a circular catheter.

    Each number turns it by 10 degrees more, 80 at most.
    """
    run, catalogue, truth = loop_run("circular-10", 10.0 * (number % 9), 100.0 + number, frames=6)
    return GateRun(run, catalogue, [{name: uv[k] for name, uv in truth.items()} for k in range(len(run.frames))])


def _of_real_run(given: argparse.Namespace, catalogue: Catalogue) -> Iterator[Stratum]:
    """Yield the labelled real run at nine scales, and its changed copies."""
    (one,) = labelled_runs(given)
    one = replace(one, catalogue=catalogue)

    def of(labelled: object, px_per_mm: float) -> GateRun:
        truth = [
            {_SHOWN.get(name, name): _rows(4, numbered) for name, numbered in labels.items()}
            for labels in labelled.labels  # type: ignore[attr-defined]
        ]
        run = replace(labelled.run, px_per_mm=px_per_mm)  # type: ignore[attr-defined]
        return GateRun(run, catalogue, truth, labelled.near_px)  # type: ignore[attr-defined]

    copies = copies_of([one], _COPIES)
    yield Stratum("labelled real run, nine scales", lambda number: of(one, _REAL_SCALES[number]), len(_REAL_SCALES))
    yield Stratum("labelled real run, copies", lambda number: of(copies[number], copies[number].run.px_per_mm), _COPIES)


def _rows(electrodes: int, numbered: Mapping[int, Array]) -> Array:
    places = np.full((electrodes, 2), np.nan)
    for number, uv in numbered.items():
        places[number - 1] = uv
    return places


def _vessels(given: argparse.Namespace) -> tuple[Callable[[int], GateRun], int]:
    """Return the runs of the vessel phantom with each of three lists.

    No catheter is in them.
    """
    empty = empty_runs(given)

    def draw(number: int) -> GateRun:
        one, kinds = empty[number // len(_VESSEL_LISTS)], _VESSEL_LISTS[number % len(_VESSEL_LISTS)]
        catheters = tuple(catheter_type(kind, kind) for kind in kinds)
        return GateRun(one.run, Catalogue(catheters, kinds[0], kinds[-1]), [{} for _ in one.labels])

    return draw, len(empty) * len(_VESSEL_LISTS)
