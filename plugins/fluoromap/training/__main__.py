"""Make a weights file: ``python -m fluoromap.training --help``."""

from __future__ import annotations

import argparse
import functools
import json
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fluoromap.catheters import Catheter, catheter_type
from fluoromap.segmenter.electrodes.network.ensemble import NetworkEnsemble
from fluoromap.segmenter.electrodes.network.weights import SHIPPED
from fluoromap.training.anatomy import read_backgrounds
from fluoromap.training.export import check_folded, halved, stacked, write_reference, write_weights
from fluoromap.training.fitting import BATCH, STEPS_A_SHARD, Progress, fit
from fluoromap.training.scenes import CLINICAL_CROWD, make_scene
from fluoromap.training.shards import SCENES_A_SHARD, shards
from fluoromap.training.validation import validate

NETWORKS = 2
SHARDS = 150
VALIDATION_SCENES = 160
_VALIDATION_PX = 320
_VALIDATION_KEY = 9_999_999


def main(arguments: Sequence[str]) -> None:
    """Train and calibrate, then write the weights and their facts.

    The networks are calibrated together, by their mean answer, on scenes that the training did not see.
    """
    given = _parser().parse_args(arguments)
    if given.reference:
        write_reference(given.reference, given.out)
        return
    catalogue = tuple(_catheter(entry) for entry in json.loads(given.catalogue.read_text())) if given.catalogue else ()
    backgrounds = read_backgrounds(given.backgrounds) if given.backgrounds else ()
    trained = []
    for seed in range(given.seed, given.seed + given.networks):
        scenes = shards(seed, given.shards, given.workers, catalogue, backgrounds)
        trained.append(fit(scenes, given.shards, seed, given.threads, functools.partial(_show, seed)))
        check_folded(trained[-1])
    weights = stacked([halved(network) for network in trained])
    ensemble = NetworkEnsemble.of_weights({name: value.astype(np.float32) for name, value in weights.items()})
    fresh = [
        make_scene(
            np.random.default_rng([given.seed, _VALIDATION_KEY, k]),
            _VALIDATION_PX,
            catalogue,
            backgrounds,
            CLINICAL_CROWD,
        )
        for k in range(VALIDATION_SCENES)
    ]
    validated = validate(ensemble, fresh)
    facts = {
        "command": shlex.join(["python", "-m", "fluoromap.training", *arguments]),
        "seed": given.seed,
        "networks": given.networks,
        "scenes_a_network": given.shards * SCENES_A_SHARD,
        "samples_a_network": given.shards * STEPS_A_SHARD * BATCH,
        "parameters_a_network": sum(parameter.numel() for parameter in trained[0].parameters()),
        "pictures": f"synthetic scenes and {len(backgrounds)} frames of a lab"
        if backgrounds
        else "synthetic scenes only",
        "validation": validated.figures(),
    }
    write_weights(given.out, weights, validated.calibration(), facts)
    print(f"{given.out}: {facts['validation']}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m fluoromap.training", description=__doc__)
    parser.add_argument("--out", type=Path, default=SHIPPED, help="weights file to write; the package's own by default")
    parser.add_argument(
        "--reference", type=Path, help="train nothing; write PyTorch's answers with the weights of --out to this file"
    )
    parser.add_argument(
        "--seed",
        type=int,
        default=1,
        help="of the first network; same seed, same weights on the same kind of processor",
    )
    parser.add_argument("--networks", type=_count, default=NETWORKS, help="networks to train, each from the next seed")
    parser.add_argument("--shards", type=_count, default=SHARDS, help=f"lists of {SCENES_A_SHARD} scenes to train on")
    parser.add_argument(
        "--threads", type=_count, default=1, help="of the fit; another number gives slightly other weights"
    )
    parser.add_argument(
        "--workers", type=_count, default=max(1, (os.cpu_count() or 2) - 1), help="processes that draw scenes"
    )
    parser.add_argument(
        "--backgrounds", type=Path, help="folder of a lab's own frames without catheters, PNG, TIFF or JPEG"
    )
    parser.add_argument("--catalogue", type=Path, help="JSON list of a lab's own catheters, as in a study's catheters")
    return parser


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text} is no number of 1 or more")
    return int(text)


def _catheter(entry: dict[str, object]) -> Catheter:
    """Build a catheter by its type, or by its measures.

    The measures are electrodes, spacing_mm, tip_mm and ring_mm.
    """
    if "type" in entry:
        return catheter_type(str(entry["type"]), str(entry.get("name", entry["type"])))
    values = {key: tuple(value) if isinstance(value, list) else value for key, value in entry.items()}
    return Catheter(**values)  # type: ignore[arg-type]


def _show(seed: int, progress: Progress) -> None:
    heat, place, spread, tip = progress.losses
    print(
        f"seed {seed}, shard {progress.shard}: heat {heat:.3f} place {place:.3f} spread {spread:.3f} tip {tip:.3f}, "
        f"{progress.seconds:.0f} s",
        flush=True,
    )


if __name__ == "__main__":
    main(sys.argv[1:])
