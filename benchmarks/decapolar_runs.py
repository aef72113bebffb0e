"""Runs that the phantom's studies do not have: a decapolar catheter in the coronary sinus, a 4 mm ablation tip, thick cables."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fluoromap.catheters import Catalogue, catheter_type
from fluoromap.geometry import Gantry, camera_from_gantry
from fluoromap.phantom import APPEARANCES, Contrast
from fluoromap.phantom.fluoroscopy import detect, expected_photons, transmission
from fluoromap.phantom.shaft import Shaft
from fluoromap.phantom.torso import torso

Array = NDArray[np.float64]

CATALOGUE = Catalogue(
    (catheter_type("decapolar-2-5-2", "cs"), catheter_type("ablation-4", "ablation")),
    reference="cs",
    mapping="ablation",
)
_FRAME_MS = 1000.0 / 60
_BEAT_MS = 700.0
_MOVED_MM = 4.0
_CABLES = 4


@dataclass(frozen=True, slots=True, eq=False)
class RenderedRun:
    """frames : 12 bits. truth : catheter -> (frames, electrodes, 2) pixels."""

    frames: list[NDArray[np.uint16]]
    times_ms: Array
    truth: dict[str, Array]
    px_per_mm: float


def decapolar_run(seed: int, contrast: Contrast, gantry: Gantry, frames: int, cables: bool) -> RenderedRun:
    """Render a run of two catheters that move with the heart.

    With ``cables``, lines as thick as catheters lie over them and do not move.
    """
    random = np.random.default_rng([seed, 77])
    camera, appearance = camera_from_gantry(gantry), APPEARANCES[contrast]
    behind = torso(gantry, appearance, np.random.default_rng(seed), np.random.default_rng([seed, 1]), 0.0)
    shafts = _shafts(random)
    times_ms = np.arange(frames) * _FRAME_MS
    moves = _MOVED_MM * np.sin(2.0 * np.pi * times_ms / _BEAT_MS)[:, None] * random.normal(0.0, 0.6, (2, 1, 3))
    over = _cables(random, (gantry.rows, gantry.columns), camera.px_per_mm) if cables else 1.0
    pictures = []
    for frame in range(frames):
        lines = [shaft.lines_mm(moves[k][frame : frame + 1]) for k, shaft in enumerate(shafts)]
        passed = np.asarray(transmission(camera, shafts, lines, appearance) * over, dtype=np.float32)
        photons = expected_photons(behind, passed, appearance, 1.0)
        pictures.append(detect(photons, appearance.photons, 1000 * seed + frame))
    truth = {
        shaft.catheter.name: np.asarray(camera.project(shaft.electrodes_mm(shaft.lines_mm(moves[k]))))
        for k, shaft in enumerate(shafts)
    }
    return RenderedRun(pictures, times_ms, truth, camera.px_per_mm)


def _shafts(random: np.random.Generator) -> tuple[Shaft, Shaft]:
    """Draw the decapolar catheter round the mitral ring and the ablation catheter in the left ventricle."""

    def near(x: float, y: float, z: float) -> Array:
        return np.array([x, y, z]) + random.normal(0.0, 2.5, 3)

    entry = np.array([-20.0, 8.0, 95.0])
    sinus = Shaft.through(
        CATALOGUE["cs"], 1.0, False, near(26.0, -6.0, 12.0), near(12.0, 18.0, 4.0), near(-22.0, 20.0, 2.0), entry
    )
    ablation = Shaft.through(
        CATALOGUE["ablation"], 1.17, True, near(4.0, -18.0, -24.0), near(0.0, -8.0, -4.0), near(-4.0, 6.0, 40.0), entry
    )
    return sinus, ablation


def _cables(random: np.random.Generator, shape: tuple[int, int], px_per_mm: float) -> Array:
    """Draw what thick cables let through, (rows, columns)."""
    v, u = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    passed = np.ones(shape)
    for _ in range(_CABLES):
        angle, at = random.uniform(0.0, np.pi), random.uniform(0.2, 0.8, 2) * shape
        along = (u - at[1]) * np.cos(angle) + (v - at[0]) * np.sin(angle)
        across = (v - at[0]) * np.cos(angle) - (u - at[1]) * np.sin(angle)
        across += random.uniform(2.0, 8.0) * px_per_mm * np.sin(along / (random.uniform(15.0, 30.0) * px_per_mm))
        inside = 1.0 - (across / (random.uniform(0.8, 1.6) * px_per_mm)) ** 2
        passed *= np.exp(-random.uniform(0.3, 1.0) * np.sqrt(np.maximum(inside, 0.0)))
    return passed
