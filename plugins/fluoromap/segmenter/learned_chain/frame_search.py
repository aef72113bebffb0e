"""The search of one frame after the other: in noise on the mean of neighbouring frames, and with few passes of the network."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fluoromap.contracts import Array, Chain, FrameChains
from fluoromap.reasons import Reason
from fluoromap.segmenter.chain_detector import ChainDetector, SearchedImage
from fluoromap.segmenter.learned_chain.network_response import NetworkResponse
from fluoromap.segmenter.log_image import Image

SHARED_MS = 21.0
"""Time between frames up to which the network's answer for one frame says where electrodes are in the next."""

_OWN_CELLS, _MEAN_CELLS, _NEXT_FRAME_CELLS = 1, 2, 3
"""How far from a place the network's answer for it may lie. A catheter moves 2 mm in a frame of a fast run: 3 cells."""
_REACH_PX = 6.0
_LOOSE_PX = 3.0
_LEAST_SHARE = 0.5
"""Least likeness of the frame itself, as a share of what it has when all frames of the mean show the catheter alike."""


@dataclass(slots=True, eq=False)
class LatestNetwork:
    """The network's answer that the next image is judged with.

    of_image : asks the network. reach_cells : how far from a place its answer may lie; above 1 the latest answer is used again.
    """

    of_image: Callable[[Image], NetworkResponse]
    reach_cells: int = _OWN_CELLS
    _response: NetworkResponse | None = None

    def __call__(self, x: Image) -> NetworkResponse:
        """Return the latest answer where it is borrowed, else the one for this image."""
        if self.reach_cells == _OWN_CELLS or self._response is None:
            self._response = self.of_image(x)
        return self._response


@dataclass(slots=True, eq=False)
class FrameSearch:
    """Detector for the frames of one run in their order.

    - A frame that lacks catheters is searched again in the mean of the frame and its neighbours, which has less noise. Chains of
      the mean are found again in the frame itself. Where this helps once, the following frames are searched so first.
    - Where catheters lack still, pairs of electrodes that the network found as one are split.
    - In fast runs (``shares``) the network's answer for a frame is used in the next one too. A frame that then shows fewer chains
      than the one before, or none for sure, is searched again with an answer of its own.
    """

    detector: ChainDetector
    network: LatestNetwork
    catheters: int
    shares: bool
    _complete: int = field(default=-2, init=False)
    _chains: int = field(default=0, init=False)
    _noisy: bool = field(default=False, init=False)

    def find_chains(self, x: Image, frame: int, beside: Sequence[Image] = ()) -> FrameChains:
        """Return the chains of one log image; see :class:`~fluoromap.segmenter.run_segmentation.Detector`."""
        first, second = (beside, ()) if self._noisy else ((), beside)
        if self.shares and frame == self._complete + 1:
            _, entry = self._search(x, first, frame, _NEXT_FRAME_CELLS)
            if entry.manual_needed is None and len(entry.chains) >= self._chains:
                return entry
        searched, entry = self._search(x, first, frame, _OWN_CELLS)
        if beside and self._lacks_catheters(entry):
            again, other = self._search(x, second, frame, _OWN_CELLS)
            if len(other.chains) > len(entry.chains):
                searched, entry, self._noisy = again, other, True
        if self._lacks_catheters(entry):
            split = self.detector.split_pairs(searched)
            if split is not searched:
                other = self._in_frame(x, split, 1 + len(beside), frame, _OWN_CELLS)
                entry = other if len(other.chains) > len(entry.chains) else entry
        if entry.manual_needed is None:
            self._complete, self._chains = frame, len(entry.chains)
        return entry

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
        mean: Image = np.mean([x, *beside], axis=0, dtype=np.float32) if beside else x
        searched = self.detector.search(mean)
        self.network.reach_cells = _OWN_CELLS
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
            # The frame is part of the mean: its place there is no independent measurement.
            loose = replace(chain, covariance_px2=chain.covariance_px2 + _LOOSE_PX**2 * np.eye(2))
            again = self.detector.find_again(x, loose, np.zeros(2), _REACH_PX, chains)
            # The mean has less noise, so the same catheter has more contrast over noise there.
            least = _LEAST_SHARE * np.mean(searched.seen.likeness.at(chain.pixels_uv)) / np.sqrt(averaged)
            if again is not None and np.mean(in_frame.at(again.pixels_uv)) >= least:
                chains.append(again)
        self.network.reach_cells = _OWN_CELLS
        return FrameChains(frame, tuple(chains), entry.manual_needed if chains else Reason.MANUAL_NEEDED)

    def find_again(self, x: Image, chain: Chain, shift: Array, reach_px: float, taken: Sequence[Chain]) -> Chain | None:
        """Return a chain of another frame at its place in this log image."""
        return self.detector.find_again(x, chain, shift, reach_px, taken)

    def find_moving(self, images: Sequence[Image], times_ms: Array, middle: int, frame: int) -> tuple[Chain, ...]:
        """Return the chains that moved means show, most probable first."""
        return self.detector.find_moving(images, times_ms, middle, frame)

    def shows_extra_catheter(self, x: Image, chains: Sequence[Chain]) -> bool:
        """Return whether the log image clearly shows a catheter besides these chains."""
        return self.detector.shows_extra_catheter(x, chains)
