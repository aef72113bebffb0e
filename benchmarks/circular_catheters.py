"""Circular catheters from face on to edge on: ``python benchmarks/circular_catheters.py [frames]``.

Lateral runs of the phantom show a loop and an ablation catheter: 512 x 512, 3.5 px/mm, 12 bits. The loop's normal is turned
from the ray towards four sides. Prints for each type and turn the share of frames with the whole loop within 5 px, that with the
right numbers too, false chains in all frames, and the runs that were reported as ``extra_catheter``.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

from fluoromap.catheters import CATHETER_TYPES, Catalogue, catheter_type
from fluoromap.contracts import PixelFacts, Run, Silent
from fluoromap.geometry import Camera, Gantry, camera_from_gantry
from fluoromap.phantom import APPEARANCES
from fluoromap.phantom.fluoroscopy import RenderedFrames, detect, expected_photons, transmission
from fluoromap.phantom.shaft import Shaft
from fluoromap.phantom.torso import torso
from fluoromap.reasons import Reason
from fluoromap.segmenter.learned_chain.plugin import LearnedChain

Array = NDArray[np.float64]

NEAR_PX = 5.0
TURNS_DEG = 0, 20, 40, 50, 60, 70, 80, 88
SIDES_DEG = 20, 100, 160, 250
FRAME_MS = 66.7
ENTRY_MM = np.array([-18.0, 8.0, 95.0])
ABLATION = catheter_type("ablation-4", "ablation")
ABLATION_MM = ((4.0, -18.0, -24.0), (0.0, -8.0, -4.0), (-4.0, 6.0, 40.0), (-8.0, 10.0, 95.0))
"""Points of the ablation catheter's course."""


def main() -> None:
    """Print a row for each type."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("frames", type=int, nargs="?", default=12)
    frames = parser.parse_args().frames
    print(f"{'':20}" + "".join(f"{f'{turn} deg':>20}" for turn in TURNS_DEG))
    for name in (name for name in CATHETER_TYPES if catheter_type(name, "loop").is_circular):
        cells = [_cell(name, turn, frames) for turn in TURNS_DEG]
        print(f"{name:20}" + "".join(f"{cell:>20}" for cell in cells), flush=True)


def _cell(loop_type: str, turn_deg: float, frames: int) -> str:
    found = numbered = false = reported = 0
    for side_deg in SIDES_DEG:
        run, catalogue, truth = loop_run(loop_type, turn_deg, side_deg, frames)
        segmentation = LearnedChain().segment(run, catalogue, {}, Silent())
        reported += segmentation.diastole.manual_needed is Reason.EXTRA_CATHETER
        for entry in segmentation.frames:
            for chain in entry.chains:
                near = {
                    name: np.linalg.norm(chain.pixels_uv[:, None] - uv[entry.frame][None], axis=2).min(axis=1) < NEAR_PX
                    for name, uv in truth.items()
                }
                false += not any(one.mean() >= 0.9 for one in near.values())
                if len(chain.electrodes) == truth["loop"].shape[1] and near["loop"].mean() >= 0.9:
                    found += 1
                    away = np.linalg.norm(chain.pixels_uv - truth["loop"][entry.frame], axis=1)
                    numbered += bool((away < NEAR_PX).all())
    runs = frames * len(SIDES_DEG)
    return f"{found / runs:.2f} {numbered / runs:.2f} {false:3} {reported}"


def loop_run(loop_type: str, turn_deg: float, side_deg: float, frames: int) -> tuple[Run, Catalogue, dict[str, Array]]:
    """Render a run of a loop and an ablation catheter.

    The loop's normal is turned from the ray towards a side. The electrodes of each catheter come with it, (frames, n, 2) pixels.
    """
    turn, side = np.deg2rad(turn_deg), np.deg2rad(side_deg)
    normal = np.array([np.cos(turn), np.sin(turn) * np.cos(side), np.sin(turn) * np.sin(side)])
    spacing = 292.0 / 512
    gantry = Gantry(90.0, 0.0, 1000.0, 500.0, (spacing, spacing), 512, 512)
    camera, appearance = camera_from_gantry(gantry), APPEARANCES["LAT"]
    loop = Shaft.around(catheter_type(loop_type, "loop"), 0.75, np.array([0.0, 10.0, 5.0]), normal, ENTRY_MM)
    shafts = [loop, Shaft.through(ABLATION, 1.17, True, *map(np.array, ABLATION_MM))]
    moves = np.arange(frames)[:, None] * np.array([0.0, 0.3, 0.2])
    behind = torso(gantry, appearance, np.random.default_rng(1), np.random.default_rng(2), 0.0)

    def render(frame: int) -> NDArray[np.uint16]:
        lines = [shaft.lines_mm(moves[frame : frame + 1]) for shaft in shafts]
        passed = np.asarray(transmission(camera, shafts, lines, appearance), dtype=np.float32)
        return detect(expected_photons(behind, passed, appearance, 1.0), appearance.photons, frame)

    pictures, facts = RenderedFrames((512, 512), frames, render), PixelFacts(False, 12, False)
    catalogue = Catalogue((loop.catheter, ABLATION), "loop", "ablation")
    run = Run(pictures, np.arange(frames) * FRAME_MS, camera.px_per_mm, facts)
    return run, catalogue, _places(camera, shafts, moves)


def _places(camera: Camera, shafts: list[Shaft], moves: Array) -> dict[str, Array]:
    return {
        shaft.catheter.name: np.asarray(camera.project(shaft.electrodes_mm(shaft.lines_mm(moves)))) for shaft in shafts
    }


if __name__ == "__main__":
    main()
