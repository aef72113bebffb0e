"""The search of one frame after the other: in noise on the mean of neighbouring frames, and with few passes of the network."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from fluoromap.contracts import Array, Chain, FrameChains
from fluoromap.reasons import Reason
from fluoromap.segmenter.electrodes.frame_answers import OWN_CELLS, LatestBlobs, LatestNetwork, StoredAnswers
from fluoromap.segmenter.electrodes.network.carried_network import Motion
from fluoromap.segmenter.electrodes.network.network_response import NetworkResponse
from fluoromap.segmenter.frames.chain_detector import ChainDetector, SearchedImage
from fluoromap.segmenter.frames.chain_following import follow_chains
from fluoromap.segmenter.picture.log_image import Image
from fluoromap.segmenter.places import ellipse
from fluoromap.segmenter.shape.chain_comparison import reverse

SHARED_MS = 21.0
"""Time between frames up to which the network's answer for one frame says where electrodes are in the next."""

_CARRIED_MS, _NEAR_MM = 40.0, 1.0
"""Time between frames up to which catheters move on as before, and how far they may be from where they would be then."""

_MEAN_CELLS, _NEXT_FRAME_CELLS, _CARRIED_CELLS = 2, 3, 2
"""How far from a place the network's answer for it may lie. A catheter moves 2 mm in a frame of a fast run: 3 cells."""
_MOST_CARRIED = 12
"""How many frames may use an answer that is carried along with the catheters."""
_MOST_FOLLOWED = 3
"""How many frames in a row may be fitted without a search."""
_CARRIED_WITHIN = 4.0
"""How far from an electrode the image moves with it, over ``near_px``."""
_REACH_PX = 6.0
_LEAST_SHARE = 0.5
"""Least likeness of the frame itself, as a share of what it has when all frames of the mean show the catheter alike."""


def near_distance_mm(frame_ms: float) -> float:
    """Return how far catheters may be from where they are expected.

    They are expected where they would be if they moved on as before. ``frame_ms`` : longest time between frames. In slow runs
    the distance is 0: nothing is known about where they are.
    """
    return _NEAR_MM if frame_ms <= _CARRIED_MS else 0.0


_NO_FRAME = FrameChains(-2, (), Reason.MANUAL_NEEDED)


@dataclass(slots=True, eq=False)
class FrameSearch:
    """Detector for the frames of one run in their order.

    - A frame that lacks catheters is searched again in the mean of the frame and its neighbours, which has less noise. Chains of
      the mean are found again in the frame itself. The search that helped last comes first.
    - Where catheters lack still, pairs of electrodes that the network found as one are split.
    - In fast runs (``shares``) the network's answer for a frame is used in the next one too.
    - Where all catheters were found in the frames before, twelve more frames use the answer, carried along with the catheters.
    - Of these frames, three of four are not searched: clear catheters that move on as before are only fitted.
    - A frame that was searched with the answer of another frame is searched again with its own in three cases: it shows fewer
      chains than that frame, it shows none for sure, or a catheter lies more than ``near_px`` from where it would be if it moved
      on. The frames after it have answers of their own too, until catheters move on again.
    """

    detector: ChainDetector
    network: LatestNetwork
    blobs: LatestBlobs
    catheters: int
    shares: bool
    near_px: float = 0.0
    answers: StoredAnswers = field(default_factory=StoredAnswers)
    _next: int = field(default=0, init=False)
    _own: NetworkResponse | None = field(default=None, init=False)
    _answered: FrameChains = field(default=_NO_FRAME, init=False)
    _latest: FrameChains = field(default=_NO_FRAME, init=False)
    _before: FrameChains = field(default=_NO_FRAME, init=False)
    _noisy: bool = field(default=False, init=False)
    _noise: float | None = field(default=None, init=False)
    _may_follow: int = field(default=0, init=False)
    _erratic: bool = field(default=False, init=False)

    def find_chains(self, x: Image, frame: int, beside: Sequence[Image] = ()) -> FrameChains:
        """Return the chains of one log image; see :class:`~fluoromap.segmenter.frames.detector.Detector`."""
        # The mean of a run's frames follows its last frame, with the number of another one.
        is_next = frame == self._next
        expected = self._expected(frame)
        entry = None if expected is None else self._follow(x, expected)
        if entry is None:
            entry = self._find_chains(x, frame, beside, expected)
            if expected is not None:
                self._erratic = _motion_px(expected, entry) > self.near_px
            self._may_follow = _MOST_FOLLOWED if expected is not None and not self._erratic else 0
        if is_next:
            self.answers.network.store(frame, self._own)
            self._store_blobs(x, frame)
        self._next, self._own = frame + 1, None
        self._before, self._latest = self._latest, entry
        return entry

    def _find_chains(self, x: Image, frame: int, beside: Sequence[Image], expected: FrameChains | None) -> FrameChains:
        first, second = (beside, ()) if self._noisy else ((), beside)
        if self.shares and frame == self._answered.frame + 1:
            _, entry = self._search(x, first, frame, _NEXT_FRAME_CELLS)
            if entry.manual_needed is None and len(entry.chains) >= len(self._answered.chains):
                return entry
        elif expected is not None and not self._erratic:
            carried = self._search_carried(x, first, expected)
            if carried is not None:
                return carried
        searched, entry = self._search(x, first, frame, OWN_CELLS)
        if beside and self._lacks_catheters(entry):
            again, other = self._search(x, second, frame, OWN_CELLS)
            if len(other.chains) > len(entry.chains):
                # In fast motion the mean shows less than the frame itself.
                searched, entry, self._noisy = again, other, not self._noisy
        if self._lacks_catheters(entry) or self.detector.has_doubtful_places(searched):
            split = self.detector.split_pairs(searched)
            if split is not searched:
                other = self._in_frame(x, split, 1 + len(beside), frame, OWN_CELLS)
                entry = other if len(other.chains) >= len(entry.chains) else entry
        if entry.manual_needed is None:
            self._answered = entry
        return entry

    def _follow(self, x: Image, expected: FrameChains) -> FrameChains | None:
        """Fit the chains where they would be if they moved on, without a search.

        None where a search is due, or where the fit does not show all of them.
        """
        families = [self.detector.family_of(chain) for chain in expected.chains]
        catheters = [family.catheter for family in families if family is not None]
        if self._noise is None or self._may_follow == 0 or len(catheters) < len(families):
            return None
        chains = follow_chains(
            x, expected.chains, catheters, self.detector.field.inside, self.detector.px_per_mm, self._noise, self.near_px
        )  # fmt: skip
        if chains is None:
            return None
        self._may_follow -= 1
        return replace(expected, chains=chains)

    def _search_carried(self, x: Image, beside: Sequence[Image], expected: FrameChains) -> FrameChains | None:
        """Search with the latest answer, carried along with the catheters.

        None where catheters are not where they would be if they moved on.
        """
        self.network.motion = self._motion_to(expected)
        _, entry = self._search(x, beside, expected.frame, _CARRIED_CELLS)
        self.network.motion = None
        return entry if entry.manual_needed is None and _motion_px(expected, entry) <= self.near_px else None

    def _motion_to(self, entry: FrameChains) -> Motion:
        """Return the motion since the latest answer.

        The chains of ``entry`` have the same order as those of the answered frame.
        """
        places, before = (
            np.concatenate([chain.pixels_uv for chain in chains]) for chains in (entry.chains, self._answered.chains)
        )
        return Motion(cKDTree(places), places - before, _CARRIED_WITHIN * self.near_px)

    def _expected(self, frame: int) -> FrameChains | None:
        """Return where catheters are in a frame if they move on.

        None where the answer is too old, or where one of them was not found in both frames before.
        """
        if (
            self.near_px == 0.0
            or frame - self._answered.frame > _MOST_CARRIED
            or (self._before.frame, self._latest.frame) != (frame - 2, frame - 1)
            or self._lacks_catheters(self._answered)
        ):
            return None
        chains = []
        for chain in self._answered.chains:
            latest = _nearest(chain, self._latest)
            before = None if latest is None else _nearest(latest, self._before)
            if latest is None or before is None:
                return None
            step = (latest.pixels_uv - before.pixels_uv).mean(axis=0)
            chains.append(replace(latest, pixels_uv=latest.pixels_uv + step))
        return FrameChains(frame, tuple(chains))

    def _lacks_catheters(self, entry: FrameChains) -> bool:
        return len(entry.chains) < self.catheters or entry.manual_needed is not None

    def _search(
        self, x: Image, beside: Sequence[Image], frame: int, reach_cells: int
    ) -> tuple[SearchedImage, FrameChains]:
        """Search an image, or its mean with the images beside it.

        The chains of the mean are returned at their places in the image.
        """
        self.detector.forget_image()
        self.network.reach_cells = reach_cells
        mean = _mean(x, beside) if beside else x
        searched = self.detector.search(mean)
        self.network.reach_cells = OWN_CELLS
        self._own = self.network.latest_for(x) or self._own
        if not beside:
            # The mean of several frames has less noise than a frame.
            self._noise = searched.seen.position_noise
        return searched, self._in_frame(x, searched, 1 + len(beside), frame, reach_cells)

    def _in_frame(self, x: Image, searched: SearchedImage, averaged: int, frame: int, reach_cells: int) -> FrameChains:
        """Return the chains at their places in the image.

        They were searched in the image, or in the mean of ``averaged`` images.
        """
        entry = searched.entry(frame)
        if searched.x is x:
            return entry
        self.network.reach_cells = max(reach_cells, _MEAN_CELLS)
        in_frame = self.detector.image_evidence(x).likeness
        chains: list[Chain] = []
        for chain in entry.chains:
            again = self.detector.find_again(x, ellipse.of_mean(chain), np.zeros(2), _REACH_PX, chains)
            # The mean has less noise, so the same catheter has more contrast over noise there.
            least = _LEAST_SHARE * np.mean(searched.seen.likeness.at(chain.pixels_uv)) / np.sqrt(averaged)
            if again is not None and np.mean(in_frame.at(again.pixels_uv)) >= least:
                chains.append(replace(again, tip_odds=chain.tip_odds))
        self.network.reach_cells = OWN_CELLS
        return FrameChains(frame, tuple(chains), entry.manual_needed if chains else Reason.MANUAL_NEEDED)

    def find_again(
        self,
        x: Image,
        chain: Chain,
        shift: Array,
        reach_px: float,
        taken: Sequence[Chain],
        frame: int | None = None,
        same_shape: bool = False,
        confirmed: bool = False,
    ) -> Chain | None:
        """Return a chain of another frame at its place in this log image."""
        if frame is None:
            return self.detector.find_again(x, chain, shift, reach_px, taken, frame, same_shape, confirmed)
        self.network.remember(x, self.answers.network.of_frame(frame))
        self.blobs.remember(x, self.answers.blobs.of_frame(frame))
        again = self.detector.find_again(x, chain, shift, reach_px, taken, frame, same_shape, confirmed)
        self._store_blobs(x, frame)
        return again

    def _store_blobs(self, x: Image, frame: int) -> None:
        blobs = self.blobs.latest_for(x)
        if blobs is not None and self.answers.blobs.of_frame(frame) is None:
            self.answers.blobs.store(frame, blobs.without_stack())

    def find_moving(self, images: Sequence[Image], times_ms: Array, middle: int, frame: int) -> tuple[Chain, ...]:
        """Return the chains that moved means show, most probable first."""
        return self.detector.find_moving(images, times_ms, middle, frame)

    def shows_extra_catheter(self, x: Image, chains: Sequence[Chain]) -> bool:
        """Return whether the log image clearly shows a catheter besides these chains."""
        return self.detector.shows_extra_catheter(x, chains)


def _mean(x: Image, beside: Sequence[Image]) -> Image:
    total = x + beside[0]
    for other in beside[1:]:
        total += other
    total /= np.float32(1 + len(beside))
    return total


def _nearest(chain: Chain, entry: FrameChains) -> Chain | None:
    """Return the nearest chain of another frame with as many electrodes.

    It is in the order in which it is nearest: frames may disagree about which end is the tip, and nothing has moved then.
    """
    alike = [other for other in entry.chains if other.electrodes == chain.electrodes]
    both_ways = [order for other in alike for order in (other, reverse(other))]
    return min(both_ways, key=lambda other: _farthest(chain, other), default=None)


def _farthest(chain: Chain, other: Chain) -> float:
    away = chain.pixels_uv - other.pixels_uv
    return math.sqrt((away * away).sum(axis=1).max())


def _motion_px(before: FrameChains, after: FrameChains) -> float:
    """Return the largest motion of an electrode from one frame to another.

    It is infinite where a catheter has no chain of as many electrodes in the other frame.
    """
    nearest = [(chain, _nearest(chain, after)) for chain in before.chains]
    if len(after.chains) < len(before.chains) or any(other is None for _, other in nearest):
        return np.inf
    return max((_farthest(chain, other) for chain, other in nearest if other is not None), default=0.0)
