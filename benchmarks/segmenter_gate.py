"""Whether a change of the segmenter is allowed: ``python benchmarks/segmenter_gate.py [--quick] [--real DIR] [--write]``.

It runs ``learned-chain`` over many kinds of runs with known truth (``gate_strata.py``). For each kind it prints, with a 95 %
bootstrap interval over the runs:

- found: electrodes of listed catheters within 5 px of the truth, over those in the picture,
- false: tracks that lie on no listed catheter in half of their frames, a run,
- named: of the tracks on a listed catheter, those whose most probable name is its own or a look-alike's,
- numbered: of the named tracks, those that count from the right end,
- wrong at 0.95: of the tracks that name a catheter with 0.95 or more, those that lie on another one or on none,
- ellipse: 95 % ellipses that hold the truth.

``segmenter_baseline.json`` keeps the figures of the last accepted state. The command ends with 1 where a figure is worse than the
interval of that state. ``--write`` accepts the present state. Drawn and simulated runs are from seeds; the labelled real run and
the vessel phantom need the folder of sample data (``--real``, or ``FLUOROMAP_SAMPLE_DATA``).
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from gate_strata import GateRun, Stratum, strata
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from fluoromap.contracts import Chain, Segmentation, Silent
from fluoromap.segmenter.learned_chain.plugin import LearnedChain

Array = NDArray[np.float64]

BASELINE = Path(__file__).with_name("segmenter_baseline.json")
FIRST_SEED = 51_000
QUICK_RUNS, WHOLE_RUNS = 3, 16
SURE = 0.95
CHI2_95_2D = 5.991464547107979
_AS_PROBABLE = 0.9
_BORDER_PX = 2.0
_RESAMPLES = 1000


@dataclass(slots=True)
class Counts:
    """What one run adds to its stratum."""

    right: int = 0
    there: int = 0
    false: int = 0
    runs: int = 0
    named: int = 0
    on_catheter: int = 0
    numbered: int = 0
    sure_wrong: int = 0
    sure: int = 0
    inside: int = 0
    ellipses: int = 0

    def add_frame(
        self, chains: Iterable[Chain], truth: dict[str, Array], shape: tuple[int, int], near_px: float
    ) -> None:
        """Count the electrodes of one frame."""
        rows, columns = shape
        places = (
            np.concatenate([uv[np.isfinite(uv).all(axis=1)] for uv in truth.values()]) if truth else np.zeros((0, 2))
        )
        last = np.array([columns - 1, rows - 1])
        places = places[((places >= _BORDER_PX) & (places <= last - _BORDER_PX)).all(axis=1)]
        points = [chain.pixels_uv for chain in chains]
        self.there += len(places)
        if points and len(places):
            away = np.linalg.norm(np.concatenate(points)[:, None] - places[None], axis=2)
            pairs = linear_sum_assignment(np.minimum(away, 4 * near_px))
            self.right += int((away[pairs] <= near_px).sum())


FIGURES = {
    "found": ("right", "there"),
    "false": ("false", "runs"),
    "named": ("named", "on_catheter"),
    "numbered": ("numbered", "named"),
    "wrong at 0.95": ("sure_wrong", "sure"),
    "ellipse": ("inside", "ellipses"),
}
"""Figure -> the counts over which it is a ratio."""
LOWER_IS_BETTER = {"false", "wrong at 0.95"}


def count_run(one: GateRun) -> Counts:
    """Segment a run and compare it with its truth."""
    found = LearnedChain().segment(one.run, one.catalogue, {}, Silent())
    counts = Counts(runs=1)
    for entry, truth in zip(found.frames, one.truth, strict=True):
        counts.add_frame(entry.chains, truth, one.run.frames.shape, one.near_px)
    for chains in _tracks(found).values():
        _count_track(counts, chains, one)
    return counts


def _tracks(found: Segmentation) -> dict[tuple[int, int], list[tuple[int, Chain]]]:
    """Return frames and chains of each track.

    A chain without a track is one of its own.
    """
    tracks: dict[tuple[int, int], list[tuple[int, Chain]]] = {}
    for entry in found.frames:
        for number, chain in enumerate(entry.chains):
            key = (chain.track, -1) if chain.track >= 0 else (-1 - entry.frame, number)
            tracks.setdefault(key, []).append((entry.frame, chain))
    return tracks


def _count_track(counts: Counts, chains: list[tuple[int, Chain]], one: GateRun) -> None:
    lies_on: dict[str, int] = {}
    for frame, chain in chains:
        for name, uv in one.truth[frame].items():
            away = np.linalg.norm(chain.pixels_uv[:, None] - uv[None], axis=2)
            near = np.nanmin(np.where(np.isfinite(away), away, np.inf), axis=1) <= one.near_px
            if near.mean() >= 0.5:
                lies_on[name] = lies_on.get(name, 0) + 1
    most = max(lies_on, key=lambda name: lies_on[name]) if lies_on else None
    if most is not None and 2 * lies_on[most] < len(chains):
        most = None
    kinds = dict(chains[0][1].kinds)
    likely = max(kinds, key=lambda name: kinds[name])
    alike = {name for name, probability in kinds.items() if probability >= _AS_PROBABLE * kinds[likely]}
    if kinds[likely] >= SURE:
        counts.sure += 1
        counts.sure_wrong += likely != most
    if most is None:
        counts.false += 1
        return
    counts.on_catheter += 1
    if most not in alike:
        return
    counts.named += 1
    errors, squared = [], []
    for frame, chain in chains:
        uv = one.truth[frame].get(most)
        if uv is None or chain.electrodes[-1] > len(uv):
            continue
        error = chain.pixels_uv - uv[[number - 1 for number in chain.electrodes]]
        known = np.isfinite(error).all(axis=1)
        errors.append(np.linalg.norm(error[known], axis=1))
        squared.append(
            np.einsum("ni,nij,nj->n", error[known], np.linalg.inv(chain.covariance_px2[known]), error[known])
        )
    near = np.concatenate(errors) <= one.near_px if errors else np.zeros(0, bool)
    if len(near) and near.mean() >= 0.5:
        counts.numbered += 1
        counts.inside += int((np.concatenate(squared)[near] <= CHI2_95_2D).sum())
        counts.ellipses += int(near.sum())


def figures(runs: list[Counts]) -> dict[str, tuple[float, float, float]]:
    """Return each figure of a stratum with its interval.

    The interval is the 95 % bootstrap interval over runs; NaN where nothing was counted.
    """
    random = np.random.default_rng(0)
    drawn = random.integers(0, len(runs), (_RESAMPLES, len(runs)))
    shown = {}
    for name, (upper, lower) in FIGURES.items():
        over = np.array([getattr(counts, upper) for counts in runs], float)
        under = np.array([getattr(counts, lower) for counts in runs], float)
        with np.errstate(invalid="ignore", divide="ignore"):
            ratios = over[drawn].sum(axis=1) / under[drawn].sum(axis=1)
            value = float(over.sum() / under.sum())
        valid = ratios[np.isfinite(ratios)]
        low, high = np.percentile(valid, [2.5, 97.5]) if len(valid) else (np.nan, np.nan)
        shown[name] = (value, float(low), float(high))
    return shown


def worse(name: str, value: float, accepted: tuple[float, float, float]) -> bool:
    """Return whether a figure is worse than the interval of the accepted state."""
    _, low, high = accepted
    if not np.isfinite(value) or not np.isfinite(low):
        return False
    slack = 1e-9
    return value > high + slack if name in LOWER_IS_BETTER else value < low - slack


def _segment_all(stratum: Stratum, runs: int, pool: ProcessPoolExecutor) -> list[Counts]:
    count = runs if stratum.most is None else min(runs, stratum.most)
    return list(pool.map(_one, [(stratum.name, number) for number in range(count)]))


_KNOWN: dict[str, Stratum] = {}


def _know(real: Path | None) -> None:
    _KNOWN.update({stratum.name: stratum for stratum in strata(FIRST_SEED, real)})


def _one(task: tuple[str, int]) -> Counts:
    name, number = task
    return count_run(_KNOWN[name].draw(number))


def main() -> int:
    """Measure all strata, compare them with the accepted state, and return the exit code."""
    given = _arguments()
    _know(given.real)
    accepted = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    kind = "quick" if given.quick else "whole"
    runs = QUICK_RUNS if given.quick else WHOLE_RUNS
    started, failed, fresh = time.monotonic(), [], {}
    print(f"{'':34}{'runs':>5}" + "".join(f"{name:>24}" for name in FIGURES) + "   s a run")
    with ProcessPoolExecutor(given.processes, initializer=_know, initargs=(given.real,)) as pool:
        for name, stratum in _KNOWN.items():
            if given.only and given.only not in name:
                continue
            before = time.monotonic()
            counts = _segment_all(stratum, runs, pool)
            shown = figures(counts)
            fresh[name] = shown
            cells = []
            for figure, (value, low, high) in shown.items():
                past = accepted.get(kind, {}).get(name, {}).get(figure)
                mark = ""
                if past is not None and worse(figure, value, past):
                    failed.append(
                        f"{name}: {figure} {value:.3f}, accepted {past[0]:.3f} ({past[1]:.3f} to {past[2]:.3f})"
                    )
                    mark = "!"
                cells.append(f"{mark}{value:.3f} {low:.3f}-{high:.3f}" if np.isfinite(value) else "-")
            spent = given.processes * (time.monotonic() - before) / len(counts)
            print(f"{name:34}{len(counts):5}" + "".join(f"{cell:>24}" for cell in cells) + f"{spent:9.1f}", flush=True)
    print(f"{time.monotonic() - started:.0f} s")
    if given.write:
        accepted.setdefault(kind, {}).update(fresh)
        BASELINE.write_text(json.dumps(accepted, indent=1) + "\n")
        return 0
    for line in failed:
        print(f"worse: {line}")
    return 1 if failed else 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    sample = os.environ.get("FLUOROMAP_SAMPLE_DATA")
    parser.add_argument("--quick", action="store_true", help="few runs of each kind")
    parser.add_argument("--real", type=Path, default=Path(sample) if sample else None, metavar="DIR")
    parser.add_argument("--only", metavar="WORDS", help="the strata whose name has these words")
    parser.add_argument("--write", action="store_true", help="accept the present figures")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
