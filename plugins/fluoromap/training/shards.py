"""Scenes by the hundred from processes of their own, in an order that depends on the seed only."""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.pool import AsyncResult

import numpy as np

from fluoromap.catheters import Catheter
from fluoromap.training.drawing import Image
from fluoromap.training.scenes import make_scene
from fluoromap.training.targets import Prepared

SCENES_A_SHARD = 480
SCENE_PX = 192

_AHEAD = 3


@dataclass(frozen=True, slots=True)
class _Sources:
    catalogue: tuple[Catheter, ...]
    backgrounds: tuple[Image, ...]


_sources = _Sources((), ())


def _start(sources: _Sources) -> None:
    global _sources
    _sources = sources


def _make(key: tuple[int, int, int]) -> list[Prepared]:
    seed, shard, count = key
    return [
        Prepared.of_scene(
            make_scene(np.random.default_rng([seed, shard, k]), SCENE_PX, _sources.catalogue, _sources.backgrounds)
        )
        for k in range(count)
    ]


def shards(
    seed: int, count: int, workers: int, catalogue: Sequence[Catheter] = (), backgrounds: Sequence[Image] = (),
    scenes: int = SCENES_A_SHARD,
) -> Iterator[list[Prepared]]:  # fmt: skip
    """Yield ``count`` lists of scenes, made a few lists ahead by ``workers`` processes."""
    sources = _Sources(tuple(catalogue), tuple(backgrounds))
    with multiprocessing.get_context("spawn").Pool(workers, _start, (sources,)) as pool:
        waiting: deque[AsyncResult[list[Prepared]]] = deque()
        for shard in range(count + workers + _AHEAD):
            if shard < count:
                waiting.append(pool.apply_async(_make, ((seed, shard, scenes),)))
            if shard >= workers + _AHEAD and waiting:
                yield waiting.popleft().get()
        while waiting:
            yield waiting.popleft().get()
