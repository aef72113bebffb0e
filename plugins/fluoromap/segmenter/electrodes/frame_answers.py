"""What network and blobs said: about the latest images, and about single frames of a run."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

from fluoromap.segmenter.electrodes.blob_response import BlobResponse
from fluoromap.segmenter.electrodes.network.carried_network import CarriedNetwork, Motion
from fluoromap.segmenter.electrodes.network.network_response import NetworkEvidence, NetworkResponse
from fluoromap.segmenter.picture.log_image import Image

OWN_CELLS = 1
"""How far from a place the network's answer for it lies, in cells, where the answer is for the same image."""


class _Sized(Protocol):
    @property
    def nbytes(self) -> int: ...


T = TypeVar("T", bound=_Sized)


@dataclass(slots=True, eq=False)
class StoredByFrame(Generic[T]):
    """Answers for single frames of one run, up to ``most_bytes``."""

    most_bytes: int = 64 << 20
    _of_frame: dict[int, T] = field(default_factory=dict, init=False)
    _bytes: int = field(default=0, init=False)

    def of_frame(self, frame: int | None) -> T | None:
        """Return the answer for a frame where it is stored."""
        return None if frame is None else self._of_frame.get(frame)

    def store(self, frame: int, answer: T | None) -> None:
        """Store the answer for a frame, if there is one and room for it."""
        if answer is not None and frame not in self._of_frame and self._bytes + answer.nbytes <= self.most_bytes:
            self._of_frame[frame] = answer
            self._bytes += answer.nbytes


@dataclass(slots=True, eq=False)
class StoredAnswers:
    """The answers for single frames of one run. Tracking searches some of these frames again."""

    network: StoredByFrame[NetworkResponse] = field(default_factory=lambda: StoredByFrame[NetworkResponse]())
    blobs: StoredByFrame[BlobResponse] = field(default_factory=lambda: StoredByFrame[BlobResponse]())


@dataclass(slots=True, eq=False)
class LatestNetwork:
    """The network's answer that the next image is judged with.

    of_image : asks the network about an image. of_places : the same for questions about few places of it. reach_cells : how far
    from a place its answer may lie; above 1 the latest answer is used again. motion : of catheters since the latest answer.
    """

    of_image: Callable[[Image], NetworkResponse]
    of_places: Callable[[Image], NetworkEvidence]
    reach_cells: int = OWN_CELLS
    motion: Motion | None = None
    _latest: tuple[Image, NetworkEvidence] | None = field(default=None, init=False)

    def __call__(self, x: Image) -> NetworkEvidence:
        """Return the latest answer where it is borrowed, else the one for this image."""
        if self._latest is None or (self.reach_cells == OWN_CELLS and self._latest[0] is not x):
            self._latest = x, self.of_image(x)
        latest = self._latest[1]
        return latest if self.motion is None else CarriedNetwork(latest, self.motion)

    def latest_for(self, x: Image) -> NetworkResponse | None:
        """Return the latest answer where it is the one for this whole image."""
        if self._latest is None or self._latest[0] is not x or not isinstance(self._latest[1], NetworkResponse):
            return None
        return self._latest[1]

    def remember(self, x: Image, answer: NetworkEvidence | None) -> None:
        """Make a stored answer for this image the latest one.

        Without one, the network is asked about few places only.
        """
        if answer is not None:
            self._latest = x, answer
        elif self._latest is None or self._latest[0] is not x:
            self._latest = x, self.of_places(x)


@dataclass(slots=True, eq=False)
class LatestBlobs:
    """The blobs of the two latest images: a frame and its mean with its neighbours are asked about in turn.

    of_image : finds the blobs of an image.
    """

    of_image: Callable[[Image], BlobResponse]
    _latest: deque[tuple[Image, BlobResponse]] = field(default_factory=lambda: deque(maxlen=2), init=False)

    def __call__(self, x: Image) -> BlobResponse:
        """Return the blobs of an image."""
        blobs = self.latest_for(x)
        if blobs is None:
            blobs = self.of_image(x)
            self._latest.append((x, blobs))
        return blobs

    def latest_for(self, x: Image) -> BlobResponse | None:
        """Return the blobs of this image where they are among the latest."""
        return next((blobs for image, blobs in self._latest if image is x), None)

    def remember(self, x: Image, blobs: BlobResponse | None) -> None:
        """Make stored blobs of this image the latest ones."""
        if blobs is not None and self.latest_for(x) is None:
            self._latest.append((x, blobs))
