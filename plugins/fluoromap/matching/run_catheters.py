"""Catheters of one run, gathered from its chains and not yet named."""

from __future__ import annotations

import collections
import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from fluoromap.contracts import Array, Chain, IntArray, Segmentation

LINK_GATE_MM = 3.0
"""A chain without a track number continues the catheter within this distance in a neighbouring frame (at the isocentre)."""
LINK_MEMORY_FRAMES = 10
"""Number of frames for which a catheter's last place is used."""
LEAST_SHARE = 0.2
"""A track in a smaller share of the frames is false, unless it is in the diastolic mean or was set by hand."""
CONSTANT_SHARE = 0.7
"""An electrode is constant when it is in this share of the frames of its catheter's most frequent electrode."""
_NEVER = 1e6


@dataclass(frozen=True, slots=True)
class CatheterFacts:
    """What the matching of a study needs to know about a catheter of one run.

    frames : number of frames that show it. manual_name : the name set by hand, else None. motion_px : RMS distance of the
    centroid from its mean place through the run.
    """

    frames: int
    manual_name: str | None
    motion_px: float


@dataclass(frozen=True, eq=False)
class RunCatheter:
    """One catheter through one run.

    chains : frame -> chain. diastole : the chain at diastole, valid in ``diastole_frame``.
    votes : catheter name -> mean probability over the frames. manual_name : the name set by hand, else None.
    """

    chains: dict[int, Chain]
    diastole: Chain
    diastole_frame: int
    votes: dict[str, float]
    manual_name: str | None

    @functools.cached_property
    def electrode_paths(self) -> tuple[IntArray, tuple[int, ...], Array]:
        """Frames (k,), numbers of the e constant electrodes, and pixels (k, e, 2).

        The frames are those that show all constant electrodes.
        """
        counts = collections.Counter(number for chain in self.chains.values() for number in chain.electrodes)
        most = max(counts.values(), default=0)
        common = tuple(sorted(number for number, count in counts.items() if count >= CONSTANT_SHARE * most))
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
        """Frames (k,) and the mean pixel (k, 2) of the electrodes of :attr:`electrode_paths`."""
        frames, _, pixels = self.electrode_paths
        return frames, pixels.mean(axis=1) if len(frames) else np.zeros((0, 2))

    @property
    def motion_px(self) -> float:
        """RMS distance of the centroid from its mean place through the run."""
        _, centroids = self.centroids_uv
        return float(np.sqrt(centroids.var(axis=0).sum())) if len(centroids) else np.inf

    @functools.cached_property
    def electrodes(self) -> int:
        """The highest electrode number in any frame."""
        return max(chain.electrodes[-1] for chain in (self.diastole, *self.chains.values()))

    @functools.cached_property
    def tip_odds(self) -> float | None:
        """Log-odds that the numbers begin at the tip, the mean over the frames.

        None where the segmenter does not doubt it, and where a person has numbered the electrodes.
        """
        chains = (self.diastole, *self.chains.values())
        if any(chain.manual for chain in chains):
            return None
        odds = [chain.tip_odds for chain in self.chains.values() or (self.diastole,) if chain.tip_odds is not None]
        return sum(odds) / len(odds) if odds else None

    @property
    def facts(self) -> CatheterFacts:
        """The few facts that name the catheter over the study."""
        return CatheterFacts(len(self.chains), self.manual_name, self.motion_px)

    def vote(self, names: Sequence[str]) -> float:
        """Return the probability of these names, averaged over the frames.

        It is 0 or 1 where the catheter was named by hand.
        """
        if self.manual_name is not None:
            return float(self.manual_name in names)
        return sum(self.votes.get(name, 0.0) for name in names)


def common_electrodes(first: Chain, second: Chain) -> tuple[list[int], list[int]]:
    """Return the indices in each chain of the electrodes that both have."""
    both = [number for number in first.electrodes if number in second.electrodes]
    return [first.electrodes.index(number) for number in both], [second.electrodes.index(number) for number in both]


def _distance_px(first: Chain, second: Chain) -> float:
    i, j = common_electrodes(first, second)
    if not i:
        return _NEVER
    return float(np.linalg.norm(first.pixels_uv[i] - second.pixels_uv[j], axis=1).mean())


def _assign(last: list[Chain], chains: list[Chain], gate_px: float) -> dict[int, int]:
    """Assign chains to catheters within the gate at the least total distance.

    Returns chain index -> catheter index.
    """
    if not last or not chains:
        return {}
    cost = np.array([[_distance_px(known, chain) for chain in chains] for known in last])
    rows, columns = linear_sum_assignment(np.minimum(cost, _NEVER))
    return {int(c): int(r) for r, c in zip(rows, columns, strict=True) if cost[r, c] <= gate_px}


def gather(segmentation: Segmentation, phases: Array | None, px_per_mm: float) -> tuple[RunCatheter, ...]:
    """Gather a run's chains into catheters.

    Chains belong together by track number or, without one, by nearness in time and place.

    Parameters
    ----------
    segmentation : Segmentation
        Of one run.
    phases : ndarray or None
        (n,) cardiac phase of each frame, where known: a catheter missing at diastole is taken from another beat.
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
        or len(chains) >= LEAST_SHARE * len(segmentation.frames)
        or any(chain.manual for chain in chains.values())
    ]
    return tuple(catheters)


def _diastolic_frame(segmentation: Segmentation) -> int:
    if segmentation.diastole is not None:
        return segmentation.diastole.frame
    # Without averaged frames, the quietest of the frames with most chains is used.
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
    quiet_marks = [frame for frame in marked if frame in averaged]
    if quiet_marks:
        frame = min(quiet_marks, key=lambda f: abs(f - centre))
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
    """Return a frame's distance from diastole, by phase and then by time.

    The averaged frames come first.
    """
    if frame in averaged:
        return 0.0, abs(frame - centre)
    if phases is None:
        return 1.0, abs(frame - centre)
    apart = abs(phases[frame] - phases[centre]) % 1.0
    return float(round(min(apart, 1 - apart), 2)), abs(frame - centre)


def link_chains(segmentation: Segmentation, px_per_mm: float) -> dict[int, dict[int, Chain]]:
    """Return key -> frame -> chain for all catheters of a run.

    The key is the segmenter's track number. Chains without one join the nearest catheter. Frames are visited from
    diastole outwards, so that a catheter begins where it moves least.
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
