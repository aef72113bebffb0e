"""The chains of one run gathered into catheters, not yet named."""

from __future__ import annotations

import collections
import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from fluoromap.contracts import Array, Chain, IntArray, Segmentation

LINK_GATE_MM = 3.0
"""A chain without a track number continues the catheter that was this near in a neighbouring frame (at the isocentre)."""
LINK_MEMORY_FRAMES = 10
"""How many frames back a catheter's last place is still a guide."""
SEEN_AT_LEAST = 0.2
"""A track in fewer of the run's frames, absent from the diastolic mean and not set by hand, is taken for a false one."""
SHOWN_IN_MOST = 0.7
"""An electrode is followed when it is in this share of the frames that show its catheter's most constant electrode."""
_NEVER = 1e6


@dataclass(frozen=True, eq=False)
class RunCatheter:
    """One catheter through one run.

    chains : frame -> chain. diastole : the chain that stands for diastole, valid in ``diastole_frame``.
    votes : catheter name -> mean probability over the frames. manual_name : as set by hand, else None.
    """

    chains: dict[int, Chain]
    diastole: Chain
    diastole_frame: int
    votes: dict[str, float]
    manual_name: str | None

    @functools.cached_property
    def seen_throughout(self) -> tuple[IntArray, tuple[int, ...], Array]:
        """Frames (k,), electrodes (e of them) and pixels (k, e, 2): the electrodes that most of its frames show, in the
        frames that show all of those."""
        counts = collections.Counter(number for chain in self.chains.values() for number in chain.electrodes)
        most = max(counts.values(), default=0)
        common = tuple(sorted(number for number, count in counts.items() if count >= SHOWN_IN_MOST * most))
        frames = [f for f in sorted(self.chains) if set(common) <= set(self.chains[f].electrodes)] if common else []
        pixels = np.zeros((len(frames), len(common), 2))
        for row, frame in enumerate(frames):
            chain = self.chains[frame]
            pixels[row] = (
                chain.pixels_uv
                if chain.electrodes == common
                else chain.pixels_uv[[chain.electrodes.index(number) for number in common]]
            )
        return np.array(frames, dtype=np.int64), common, pixels

    @functools.cached_property
    def centroids_uv(self) -> tuple[IntArray, Array]:
        """Frames (k,) and the mean pixel (k, 2) of the electrodes of :attr:`seen_throughout`."""
        frames, _, pixels = self.seen_throughout
        return frames, pixels.mean(axis=1) if len(frames) else np.zeros((0, 2))

    @property
    def motion_px(self) -> float:
        """How far it moves through the run: RMS distance of its centroid from its mean place."""
        _, centroids = self.centroids_uv
        return float(np.sqrt(centroids.var(axis=0).sum())) if len(centroids) else np.inf

    def vote(self, names: Sequence[str]) -> float:
        """Probability that it is one of these, voted over the frames; certain where named by hand."""
        if self.manual_name is not None:
            return float(self.manual_name in names)
        return sum(self.votes.get(name, 0.0) for name in names)


def common_electrodes(first: Chain, second: Chain) -> tuple[list[int], list[int]]:
    """Places in each chain of the electrodes that both hold."""
    both = [number for number in first.electrodes if number in second.electrodes]
    return [first.electrodes.index(number) for number in both], [second.electrodes.index(number) for number in both]


def _distance_px(first: Chain, second: Chain) -> float:
    i, j = common_electrodes(first, second)
    if not i:
        return _NEVER
    return float(np.linalg.norm(first.pixels_uv[i] - second.pixels_uv[j], axis=1).mean())


def _assign(last: list[Chain], chains: list[Chain], gate_px: float) -> dict[int, int]:
    """Chain index -> catheter index of those that lie within the gate, at least total distance."""
    if not last or not chains:
        return {}
    cost = np.array([[_distance_px(known, chain) for chain in chains] for known in last])
    rows, columns = linear_sum_assignment(np.minimum(cost, _NEVER))
    return {int(c): int(r) for r, c in zip(rows, columns, strict=True) if cost[r, c] <= gate_px}


def gather(segmentation: Segmentation, phases: Array | None, px_per_mm: float) -> tuple[RunCatheter, ...]:
    """Gather a run's chains into catheters, by track number and, where that is missing, by nearness in time and place.

    Parameters
    ----------
    segmentation : Segmentation
        Of one run.
    phases : ndarray or None
        (n,) cardiac phase of each frame, where known: a catheter missing at diastole is taken from another beat's.
    px_per_mm : float
        At the isocentre.
    """
    centre = _diastolic_frame(segmentation)
    groups = link_chains(segmentation, px_per_mm)
    diastole = segmentation.diastole.chains if segmentation.diastole else ()
    quiet: dict[int, Chain] = {}
    keys = list(groups)
    unlinked = []
    for chain in diastole:
        if chain.track >= 0:
            quiet[chain.track] = chain
            groups.setdefault(chain.track, {})
        else:
            unlinked.append(chain)
    free = [key for key in keys if key not in quiet and groups[key]]
    places = [groups[key][min(groups[key], key=lambda frame: abs(frame - centre))] for key in free]
    found = _assign(places, unlinked, LINK_GATE_MM * px_per_mm)
    for index, chain in enumerate(unlinked):
        key = free[found[index]] if index in found else max(groups, default=-1) + 1
        groups.setdefault(key, {})
        quiet[key] = chain
    averaged = set(segmentation.diastole_frames) or {centre}
    catheters = [
        _catheter(chains, quiet.get(key), centre, averaged, segmentation, phases)
        for key, chains in groups.items()
        if key in quiet
        or len(chains) >= SEEN_AT_LEAST * len(segmentation.frames)
        or any(chain.manual for chain in chains.values())
    ]
    return tuple(catheters)


def _diastolic_frame(segmentation: Segmentation) -> int:
    if segmentation.diastole is not None:
        return segmentation.diastole.frame
    # Where nothing was averaged, the quietest of the frames that show most stands for diastole.
    seen = np.array([len(entry.chains) for entry in segmentation.frames])
    return int(np.lexsort((segmentation.motion, -seen))[0])


def _catheter(
    chains: dict[int, Chain],
    mean_chain: Chain | None,
    centre: int,
    averaged: set[int],
    segmentation: Segmentation,
    phases: Array | None,
) -> RunCatheter:
    frames = sorted(chains)
    marked = [frame for frame in frames if chains[frame].manual]
    at_hand = [frame for frame in marked if frame in averaged]
    if at_hand:
        frame = min(at_hand, key=lambda f: abs(f - centre))
        chosen = chains[frame]
    elif mean_chain is not None:
        frame, chosen = centre, mean_chain
    else:
        frame = min(
            marked or frames, key=lambda f: (*_from_diastole(f, centre, averaged, phases), segmentation.motion[f])
        )
        chosen = chains[frame]
    weighted = [(chain, 1.0) for chain in chains.values()]
    if mean_chain is not None:
        weighted.append((mean_chain, float(max(1, len(segmentation.diastole_frames)))))
    total = sum(weight for _, weight in weighted)
    votes: dict[str, float] = {}
    for chain, weight in weighted:
        for name, probability in chain.kinds:
            votes[name] = votes.get(name, 0.0) + probability * weight / total
    names = [chain.kinds[0][0] for chain, _ in weighted if chain.manual and chain.kinds]
    manual_name = max(sorted(set(names)), key=names.count) if names else None
    return RunCatheter(chains, chosen, frame, votes, manual_name)


def _from_diastole(frame: int, centre: int, averaged: set[int], phases: Array | None) -> tuple[float, float]:
    """How far a frame is from diastole: first by phase, then by time; the averaged frames come first."""
    if frame in averaged:
        return 0.0, abs(frame - centre)
    if phases is None:
        return 1.0, abs(frame - centre)
    apart = abs(phases[frame] - phases[centre]) % 1.0
    return float(round(min(apart, 1 - apart), 2)), abs(frame - centre)


def link_chains(segmentation: Segmentation, px_per_mm: float) -> dict[int, dict[int, Chain]]:
    """Key -> frame -> chain: track numbers as the segmenter gave them, chains without one joined to the nearest.

    Runs from the diastolic frame outwards, so that a catheter is met first where it moves least.
    """
    groups: dict[int, dict[int, Chain]] = {}
    for entry in segmentation.frames:
        for chain in entry.chains:
            if chain.track >= 0:
                groups.setdefault(chain.track, {})[entry.frame] = chain
    gate_px = LINK_GATE_MM * px_per_mm
    centre = _diastolic_frame(segmentation)
    order = [*range(centre, len(segmentation.frames)), *range(centre - 1, -1, -1)]
    for frame in order:
        loose = [chain for chain in segmentation.frames[frame].chains if chain.track < 0]
        if not loose:
            continue
        near: dict[int, Chain] = {}
        for key, chains in groups.items():
            if frame in chains:
                continue
            closest = min(chains, key=lambda known: abs(known - frame))
            if abs(closest - frame) <= LINK_MEMORY_FRAMES:
                near[key] = chains[closest]
        keys = list(near)
        found = _assign(list(near.values()), loose, gate_px)
        for index, chain in enumerate(loose):
            key = keys[found[index]] if index in found else max(groups, default=-1) + 1
            groups.setdefault(key, {})[frame] = chain
    return groups
