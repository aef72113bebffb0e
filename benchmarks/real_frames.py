"""How well electrodes are found in real frames: ``python benchmarks/real_frames.py DIR [options]``; ``--help`` lists them.

DIR holds pictures (PNG, JPEG, TIFF) and DICOM files, and label files ``*_labels.csv`` with the columns ``file``, ``catheter``,
``electrode`` (1 is the tip), ``u_px``, ``v_px`` (the centre of the first pixel is (0, 0)). The files of one label file, in the
order of their names, are one run; a label file ``NAME_labels.csv`` without rows is of the pictures ``NAME_*.png``, in which no
electrode is. DICOM files without a label file are runs without catheters: all that is found in them is false.
Beside a label file, ``*_set.json`` may describe the run: ``{"px_per_mm": 3.1, "frame_ms": 66.7, "logarithmic": false, "catheters":
[{"name": "cs", "type": "decapolar-2-5-2"}]}``; the catheters' names are those of the label file.

Prints, for each run: electrodes found within 5 px, missed, false, found with the right catheter's name, found with the right
number too, milliseconds a frame, frames, and the lag of the frames.
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from changed_copies import changed_copy
from memory_frames import MemoryFrames
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.optimize import linear_sum_assignment

from fluoromap.catheters import CATHETER_TYPES, DEFAULT_CATALOGUE, Catalogue, Catheter, catheter_type
from fluoromap.contracts import Chain, FrameChains, PixelFacts, Run, Segmenter, Silent
from fluoromap.segmenter.catheter_chain.plugin import CatheterChain
from fluoromap.segmenter.learned_chain.plugin import LearnedChain, LearnedChainParams
from fluoromap.segmenter.picture.field_mask import find_field
from fluoromap.segmenter.picture.lag import measure_lag
from fluoromap_service.dicom import open_frames, read_instance

Array = NDArray[np.float64]

NEAR_PX = 5.0
_AS_PROBABLE = 0.9
_PICTURES = {".png", ".jpg", ".jpeg", ".tif", ".tiff"}
_COLOURS = (255, 70, 70), (70, 255, 70), (90, 160, 255), (255, 80, 255), (255, 180, 40), (80, 255, 255)


@dataclass(frozen=True, slots=True, eq=False)
class LabelledRun:
    """One run and its truth.

    labels : of each frame, catheter -> {electrode: (2,) pixels}; none where nothing is there. near_px : how far an electrode that
    was found may lie from its label.
    """

    name: str
    run: Run
    catalogue: Catalogue
    labels: list[dict[str, dict[int, Array]]]
    near_px: float = NEAR_PX


def main() -> None:
    """Measure the segmenters on all runs of a folder."""
    given = _arguments()
    labelled = labelled_runs(given)
    runs = [*labelled, *copies_of(labelled, given.copies), *empty_runs(given)]
    print(f"{'':44}{'found':>12}{'missed':>8}{'false':>7}{'named':>7}{'numbered':>10}{'ms':>7}  frames   lag")
    for name in given.segmenter:
        for one in runs:
            _measure(name, one, given)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--segmenter", nargs="+", default=["catheter-chain", "learned-chain"])
    parser.add_argument("--weights", help="weights file of learned-chain")
    parser.add_argument(
        "--px-per-mm", type=float, help="at the isocentre; else from set file or DICOM header, else 3.4"
    )
    parser.add_argument("--catheter", action="append", default=[], metavar="NAME=TYPE", help=", ".join(CATHETER_TYPES))
    parser.add_argument("--frames", type=int, default=1000, help="at most so many of each run")
    parser.add_argument("--copies", type=int, default=0, help="so many changed copies of each labelled run too")
    parser.add_argument("--single", action="store_true", help="every frame on its own, as stills are")
    parser.add_argument("--draw", type=Path, metavar="FOLDER", help="draw the chains, with crosses for labels")
    return parser.parse_args()


def _segmenter(name: str, weights: str | None) -> Segmenter:
    return CatheterChain() if name == "catheter-chain" else LearnedChain(LearnedChainParams(weights=weights))


def labelled_runs(given: argparse.Namespace) -> list[LabelledRun]:
    runs = []
    for path in sorted(given.folder.glob("*_labels.csv")):
        described = path.with_name(path.name.replace("_labels.csv", "_set.json"))
        facts = json.loads(described.read_text()) if described.exists() else {}
        with path.open(newline="") as lines:
            rows = list(csv.DictReader(lines))
        name = path.name.removesuffix("_labels.csv")
        # Of a run without electrodes no picture is named in the labels.
        named = {row["file"] for row in rows} or {picture.name for picture in path.parent.glob(f"{name}_*.png")}
        files = sorted(named)[: given.frames]
        labels: list[dict[str, dict[int, Array]]] = [{} for _ in files]
        for row in rows:
            if row["file"] in files:
                of_frame = labels[files.index(row["file"])].setdefault(row["catheter"], {})
                of_frame[int(row["electrode"])] = np.array([float(row["u_px"]), float(row["v_px"])])
        catalogue = _catalogue(given.catheter, facts)
        frames = [np.asarray(Image.open(path.parent / file).convert("L")) for file in files]
        px_per_mm = given.px_per_mm or facts.get("px_per_mm", 3.4)
        times = np.arange(len(frames), dtype=np.float64) * float(facts.get("frame_ms", 66.7))
        pixels = PixelFacts(bool(facts.get("logarithmic", False)), 8, False)
        runs.append(LabelledRun(path.stem, Run(MemoryFrames(frames), times, px_per_mm, pixels), catalogue, labels))
    return runs


def copies_of(runs: Sequence[LabelledRun], count: int) -> list[LabelledRun]:
    """Return changed copies of runs; the seed of each is its number."""
    copies = []
    for one in runs:
        frames = [one.run.frames[index] for index in range(len(one.run.frames))]
        for seed in range(count):
            changed, labels, size = changed_copy(np.random.default_rng(seed), frames, one.labels)
            run = replace(one.run, frames=MemoryFrames(changed), px_per_mm=size * one.run.px_per_mm)
            copies.append(LabelledRun(f"{one.name} copy {seed}", run, one.catalogue, labels, size * NEAR_PX))
    return copies


def empty_runs(given: argparse.Namespace) -> list[LabelledRun]:
    runs = []
    for path in sorted(given.folder.glob("*.dcm")):
        try:
            facts = read_instance(path)
            source = open_frames(path, facts)
            frames = [np.asarray(source[k]) for k in range(min(len(source), given.frames))]
        except Exception as error:
            print(f"{path.name}: left out, {error}")
            continue
        px_per_mm = given.px_per_mm or 3.4
        if facts.source_detector_mm and facts.source_isocentre_mm and facts.pixel_spacing_mm:
            px_per_mm = facts.source_detector_mm / facts.source_isocentre_mm / facts.pixel_spacing_mm[0]
        run = Run(MemoryFrames(frames), np.arange(len(frames), dtype=np.float64) * 66.7, px_per_mm, facts.pixels)
        runs.append(LabelledRun(path.stem, run, _catalogue(given.catheter, {}), [{} for _ in frames]))
    return runs


def _catalogue(pairs: list[str], facts: dict[str, list[dict[str, str]]]) -> Catalogue:
    catheters: list[Catheter] = [catheter_type(entry["type"], entry["name"]) for entry in facts.get("catheters", [])]
    if pairs:
        catheters = [catheter_type(type_name, name) for name, type_name in (pair.split("=") for pair in pairs)]
    if not catheters:
        return DEFAULT_CATALOGUE
    reference = catheters[0].name if len(catheters) > 1 else None
    return Catalogue(tuple(catheters), reference, catheters[-1].name)


def _measure(name: str, one: LabelledRun, given: argparse.Namespace) -> None:
    segmenter = _segmenter(name, given.weights)
    started = time.process_time()
    entries = _segment(segmenter, one, given.single)
    spent = 1000 * (time.process_time() - started) / len(entries)
    sums = np.zeros(5, np.int64)
    for entry, labels in zip(entries, one.labels, strict=True):
        sums += score(entry.chains, labels, one.near_px)
    found, missed, false, named, numbered = sums.tolist()
    inside = find_field(one.run.frames, one.run.pixels).inside
    lag = measure_lag(one.run.frames, inside, one.run.pixels)
    print(
        f"{name + ' ' + one.name:44}{found:>7}/{found + missed:<4}{missed:>8}{false:>7}{named:>7}{numbered:>10}{spent:>7.1f}"
        f"  {len(entries):<6}{lag:>6.2f}"
    )
    if given.draw:
        given.draw.mkdir(parents=True, exist_ok=True)
        for index in range(0, len(entries), max(1, len(entries) // 4)):
            picture = drawn(one.run.frames[index], entries[index].chains, one.labels[index])
            picture.save(given.draw / f"{name}_{one.name.replace(' ', '_')}_{index}.png")


def _segment(segmenter: Segmenter, one: LabelledRun, single: bool) -> list[FrameChains]:
    if not single:
        return list(segmenter.segment(one.run, one.catalogue, {}, Silent()).frames)
    entries = []
    for index in range(len(one.run.frames)):
        still = Run(MemoryFrames([one.run.frames[index]]), np.zeros(1), one.run.px_per_mm, one.run.pixels)
        entries.append(segmenter.segment(still, one.catalogue, {}, Silent()).frames[0])
    return entries


def score(
    chains: tuple[Chain, ...], labels: dict[str, dict[int, Array]], near_px: float = NEAR_PX
) -> NDArray[np.int64]:
    """Count found, missed, false, named and numbered electrodes of one frame."""
    there = [(name, number, uv) for name, electrodes in labels.items() for number, uv in electrodes.items()]
    seen = [
        (_names(chain), number, uv)
        for chain in chains
        for number, uv in zip(chain.electrodes, chain.pixels_uv, strict=True)
    ]
    if not there or not seen:
        return np.array([0, len(there), len(seen), 0, 0])
    away = np.array([[np.linalg.norm(mine[2] - theirs[2]) for theirs in there] for mine in seen])
    rows, columns = linear_sum_assignment(np.minimum(away, 4 * near_px))
    pairs = [(seen[r], there[c]) for r, c in zip(rows, columns, strict=True) if away[r, c] <= near_px]
    named = [(mine, theirs) for mine, theirs in pairs if theirs[0] in mine[0]]
    numbered = sum(mine[1] == theirs[1] for mine, theirs in named)
    return np.array([len(pairs), len(there) - len(pairs), len(seen) - len(pairs), len(named), numbered])


def _names(chain: Chain) -> set[str]:
    """Return the most probable name of a chain, and those of look-alikes.

    Look-alikes are as probable.
    """
    most = max(probability for _, probability in chain.kinds)
    return {name for name, probability in chain.kinds if probability >= _AS_PROBABLE * most}


def drawn(pixels: NDArray[np.generic], chains: tuple[Chain, ...], labels: dict[str, dict[int, Array]]) -> Image.Image:
    grey = pixels.astype(np.float64)
    low, high = np.percentile(grey, [0.5, 99.5])
    level = (np.clip((grey - low) / max(high - low, 1e-9), 0, 1) * 255).astype(np.uint8)
    picture = (
        Image.fromarray(level).resize((2 * level.shape[1], 2 * level.shape[0]), Image.Resampling.BICUBIC).convert("RGB")
    )
    pen = ImageDraw.Draw(picture)
    for electrodes in labels.values():
        for u, v in (2 * uv + 0.5 for uv in electrodes.values()):
            pen.line([u - 4, v, u + 4, v], fill=(255, 255, 0))
            pen.line([u, v - 4, u, v + 4], fill=(255, 255, 0))
    for chain, colour in zip(chains, _COLOURS * 4, strict=False):
        places = 2 * chain.pixels_uv + 0.5
        pen.line([(u, v) for u, v in places], fill=colour)
        for number, (u, v) in zip(chain.electrodes, places, strict=True):
            pen.ellipse([u - 6, v - 6, u + 6, v + 6], outline=colour)
            pen.text((u + 7, v - 12), str(number), fill=colour)
        name, probability = max(chain.kinds, key=lambda kind: kind[1])
        pen.text((places[0, 0] + 12, places[0, 1] + 10), f"{name} {probability:.2f}", fill=colour)
    return picture


if __name__ == "__main__":
    main()
