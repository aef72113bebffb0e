"""Every second frame of a fast run without a pass of the network of its own: most of the network's time is saved."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from fluoromap.contracts import Array, Chain, FrameChains
from fluoromap.segmenter.chain_detector import ChainDetector
from fluoromap.segmenter.learned_chain.network_response import NetworkResponse
from fluoromap.segmenter.log_image import Image

LONGEST_MS = 21.0
"""Time between frames up to which the network's answer for one frame says where electrodes are in the next."""


@dataclass(slots=True, eq=False)
class LatestNetwork:
    """The network's answer that the next image is judged with.

    of_image : asks the network. borrowed : whether the answer for another image is used.
    """

    of_image: Callable[[Image], NetworkResponse]
    borrowed: bool = False
    _response: NetworkResponse | None = None

    def __call__(self, x: Image) -> NetworkResponse:
        """Return the latest answer where it is borrowed, else the one for this image."""
        if not self.borrowed or self._response is None:
            self._response = self.of_image(x)
        return self._response


@dataclass(slots=True, eq=False)
class AlternatingDetector:
    """Detector that uses the network's answer for a frame in the next one too, where nothing is lost by it.

    A frame that shows fewer chains than the one before, or none for sure, is searched again with an answer of its own.
    """

    detector: ChainDetector
    network: LatestNetwork
    _complete: int = field(default=-1, init=False)
    _chains: int = field(default=0, init=False)

    def find_chains(self, x: Image, frame: int) -> FrameChains:
        """Return the chains of one log image; see :class:`~fluoromap.segmenter.run_segmentation.Detector`."""
        if frame == self._complete + 1:
            self.network.borrowed = True
            entry = self.detector.find_chains(x, frame)
            self.network.borrowed = False
            if entry.manual_needed is None and len(entry.chains) >= self._chains:
                return entry
            self.detector.forget_image()
        entry = self.detector.find_chains(x, frame)
        if entry.manual_needed is None:
            self._complete, self._chains = frame, len(entry.chains)
        return entry

    def find_again(self, x: Image, chain: Chain, shift: Array, reach_px: float, taken: Sequence[Chain]) -> Chain | None:
        """Return a chain of another frame at its place in this log image."""
        return self.detector.find_again(x, chain, shift, reach_px, taken)

    def shows_extra_catheter(self, x: Image, chains: Sequence[Chain]) -> bool:
        """Return whether the log image clearly shows a catheter besides these chains."""
        return self.detector.shows_extra_catheter(x, chains)
