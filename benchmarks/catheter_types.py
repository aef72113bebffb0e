"""Catheters of many types in synthetic scenes: ``python benchmarks/catheter_types.py [first seed] [scenes] [--weights FILE]``.

Each scene has the catheters of one catalogue, crossing at random, among cables, wires, probes and vessels: 512 x 512, 8 bit, half
of them JPEG, 3.0 to 4.4 px/mm. A run is the same picture three times. Prints for each catalogue the electrodes found within 5 px,
false ones, and those with the right name and the right number; then the same for a catalogue that lacks one of the catheters, where
an electrode of the unlisted catheter counts as false. Scenes come from the generator that the network is trained with, other seeds:
these are figures of the chain search in hard scenes, not of the network on real frames.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from memory_frames import MemoryFrames
from real_frames import LabelledRun, score

from fluoromap.catheters import Catalogue, Catheter, catheter_type
from fluoromap.contracts import PixelFacts, Run, Silent
from fluoromap.segmenter.learned_chain.plugin import LearnedChain, LearnedChainParams
from fluoromap.training.anatomy import anatomy
from fluoromap.training.appearance import take_picture
from fluoromap.training.distractors import draw_distractors
from fluoromap.training.drawing import Canvas
from fluoromap.training.drawn_catheters import design_of, draw_catheters
from fluoromap.training.exposure import Exposure

SIZE_PX = 512
FRAMES = 3
METAL = 0.4, 2.3
"""Range of the electrodes' attenuation, log units."""
CATALOGUES = {
    "2 quadripolar, ablation": ("quadripolar-2-5-2", "quadripolar-2-5-2", "ablation-4"),
    "decapolar, hexapolar, ablation": ("decapolar-2-5-2", "hexapolar-2-5-2", "ablation-4"),
    "duodecapolar, decapolar, ablation 8": ("duodecapolar-2-2-2", "decapolar-2-8-2", "ablation-8"),
    "6 catheters": (
        "decapolar-2-5-2", "hexapolar-2-5-2", "quadripolar-2-5-2", "quadripolar-5-5-5", "ablation-3.5", "octapolar-2-5-2",
    ),
}  # fmt: skip


def main() -> None:
    """Print a row for each catalogue."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seed", type=int, nargs="?", default=5000)
    parser.add_argument("scenes", type=int, nargs="?", default=20)
    parser.add_argument("--weights")
    given = parser.parse_args()
    segmenter = LearnedChain(LearnedChainParams(weights=given.weights))
    print(f"{'':44}{'recall':>8}{'precision':>11}{'named':>8}{'numbered':>10}{'ms':>8}")
    for title, types in CATALOGUES.items():
        catheters = tuple(catheter_type(name, f"{number} {name}") for number, name in enumerate(types))
        for missing in (None, 0):
            sums, spent = np.zeros(5, np.int64), 0.0
            for scene in range(given.scenes):
                one = _scene(np.random.default_rng([given.seed, scene]), catheters, missing)
                started = time.process_time()
                found = segmenter.segment(one.run, one.catalogue, {}, Silent())
                spent += time.process_time() - started
                for entry, labels in zip(found.frames, one.labels, strict=True):
                    sums += score(entry.chains, labels)
            right, missed, false, named, numbered = sums.tolist()
            there = max(right + missed, 1)
            heading = title if missing is None else f"  without {types[0]}"
            print(
                f"{heading:44}{right / there:>8.3f}{right / max(right + false, 1):>11.3f}{named / there:>8.3f}"
                f"{numbered / there:>10.3f}{1000 * spent / given.scenes / FRAMES:>8.1f}"
            )


def _scene(random: np.random.Generator, catheters: tuple[Catheter, ...], missing: int | None) -> LabelledRun:
    """Make a run of one scene with all catheters, and a catalogue.

    The catalogue lacks the ``missing`` catheter, whose electrodes have no labels.
    """
    px_per_mm = float(random.uniform(3.0, 4.4))
    canvas = Canvas.empty(SIZE_PX)
    draw_distractors(random, canvas, px_per_mm)
    drawn = draw_catheters(random, canvas, px_per_mm, [design_of(one) for one in catheters], METAL)[:, :2]
    ends = np.cumsum([one.electrodes for one in catheters])[:-1]
    places = dict(zip((one.name for one in catheters), np.split(drawn, ends), strict=True))
    exposure = Exposure(
        photons=float(random.uniform(300.0, 5000.0)), scatter=float(random.uniform(0.0, 1.0)), metal=METAL, detector=1.0,
        grain_px=0.6, gain=1.2, frontal=False, plain=False, printed=False,
    )  # fmt: skip
    body = anatomy(random, SIZE_PX, px_per_mm, exposure.frontal)
    pictures = [take_picture(random, canvas.depth, body, exposure).pixels] * FRAMES
    listed = tuple(one for number, one in enumerate(catheters) if number != missing)
    labels = {
        one.name: {
            number + 1: uv
            for number, uv in enumerate(places[one.name])
            if (uv > 20).all() and (uv < SIZE_PX - 20).all()
        }
        for one in listed
    }
    run = Run(MemoryFrames(pictures), np.arange(FRAMES) * 66.7, px_per_mm, PixelFacts(True, 8, False))
    return LabelledRun("", run, Catalogue(listed, listed[0].name, listed[-1].name), [labels] * FRAMES)


if __name__ == "__main__":
    main()
