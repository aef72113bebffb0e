"""Fit the network to synthetic scenes."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from fluoromap.training.network import ElectrodeNetwork, losses
from fluoromap.training.targets import Prepared, training_pair

BATCH = 12
STEPS_A_SHARD = 120

_SHARDS_KEPT = 8
_RATE, _LAST_RATE = 3e-3, 1e-5
_WARM_UP_STEPS = 100
_DECAY = 1e-4
_MOST_GRADIENT = 10.0
_AVERAGED = 0.998
_WEIGHTS = 1.0, 0.5, 0.05, 0.1


@dataclass(frozen=True, slots=True)
class Progress:
    """Mean losses (heat, place, spread, tip) of the last shard, and seconds since the start."""

    shard: int
    losses: tuple[float, ...]
    seconds: float


def fit(
    scenes: Iterable[list[Prepared]], shard_count: int, seed: int, threads: int, report: Callable[[Progress], None]
) -> ElectrodeNetwork:
    """Train on the scenes and return the network.

    Its weights are a running mean over the last steps. The same seed, scenes and ``threads`` give the same weights on
    the same kind of processor.
    """
    torch.manual_seed(seed)
    torch.set_num_threads(threads)
    torch.use_deterministic_algorithms(True)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    # A processor without bfloat16 takes several times as long for it as for single precision.
    fast_halves = device.type == "cuda" or bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
    network: ElectrodeNetwork = ElectrodeNetwork().to(device, memory_format=torch.channels_last)
    averaged = {name: value.detach().clone() for name, value in network.state_dict().items()}
    optimiser = torch.optim.AdamW(network.parameters(), _RATE, weight_decay=_DECAY)
    random = np.random.default_rng([seed, 1])
    started, step, last_step = time.monotonic(), 0, shard_count * STEPS_A_SHARD
    kept: deque[list[Prepared]] = deque(maxlen=_SHARDS_KEPT)
    for number, shard in enumerate(scenes):
        kept.append(shard)
        sums = torch.zeros(len(_WEIGHTS))
        for pictures, targets in _batches(random, kept):
            for group in optimiser.param_groups:
                group["lr"] = _rate(step, last_step)
            inputs = pictures.to(device, memory_format=torch.channels_last)
            with torch.autocast(device.type, torch.bfloat16, enabled=fast_halves):
                answer = network(inputs)
            parts = losses(answer.float(), targets.to(device))
            optimiser.zero_grad()
            torch.stack([weight * part for weight, part in zip(_WEIGHTS, parts, strict=True)]).sum().backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), _MOST_GRADIENT)
            optimiser.step()
            _average(averaged, network, min(_AVERAGED, step / (step + 10.0)))
            sums += torch.stack([part.detach() for part in parts]).cpu()
            step += 1
        report(Progress(number + 1, tuple((sums / STEPS_A_SHARD).tolist()), time.monotonic() - started))
    network.load_state_dict(averaged)
    network.cpu().eval()
    return network


def _batches(random: np.random.Generator, kept: deque[list[Prepared]]) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield batches of scenes of the last shards.

    The newest shard's scenes come as often as the others'.
    """
    for _ in range(STEPS_A_SHARD):
        pairs = []
        for _ in range(BATCH):
            shard = kept[int(random.integers(len(kept)))]
            pairs.append(training_pair(random, shard[int(random.integers(len(shard)))]))
        pictures, targets = (np.stack(side) for side in zip(*pairs, strict=True))
        yield torch.from_numpy(pictures[:, None]), torch.from_numpy(targets)


def _rate(step: int, last_step: int) -> float:
    cosine = 0.5 * (1.0 + math.cos(math.pi * step / last_step))
    return max(_RATE * min(1.0, (step + 1) / _WARM_UP_STEPS) * cosine, _LAST_RATE)


def _average(averaged: dict[str, Tensor], network: ElectrodeNetwork, kept: float) -> None:
    for name, value in network.state_dict().items():
        if value.dtype.is_floating_point:
            averaged[name].mul_(kept).add_(value, alpha=1.0 - kept)
        else:
            averaged[name].copy_(value)
