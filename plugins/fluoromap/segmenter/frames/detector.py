"""The detector of a run's frames: what each plugin brings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from fluoromap.contracts import Array, Chain, FrameChains
from fluoromap.segmenter.picture.log_image import Image


class Detector(Protocol):
    """Search for chains in the log images of one run."""

    def find_chains(self, x: Image, frame: int, beside: Sequence[Image] = ()) -> FrameChains:
        """Return the chains of one log image.

        With ``manual_needed`` the chains are uncertain: they may continue a track but do not begin one.

        Parameters
        ----------
        x : (rows, columns) float32
            Log image.
        frame : int
        beside : sequence of (rows, columns) float32
            The frames before and after, where they show nearly the same moment.
        """

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
        """Return a chain of another frame at its place in this log image.

        Parameters
        ----------
        x : (rows, columns) float32
            Log image.
        chain : Chain
            The catheter in another frame.
        shift : (2,)
            Expected displacement, pixels.
        reach_px : float
            Largest distance from the expected place.
        taken : sequence of Chain
            Other catheters that were already found in this image.
        frame : int, optional
            Number of the frame; None for a mean of frames.
        same_shape : bool
            Whether the electrodes must lie as in the other frame.
        confirmed : bool
            Whether means of several frames show the catheter. Then contrast alone decides whether this image shows it.

        Returns
        -------
        Chain or None
            None where the image does not show the chain, and from a detector that searches whole frames only.
        """

    def find_moving(self, images: Sequence[Image], times_ms: Array, middle: int, frame: int) -> tuple[Chain, ...]:
        """Return the chains that moved means show, most probable first.

        See :func:`~fluoromap.segmenter.picture.moved_means.moved_means`.

        Parameters
        ----------
        images : sequence of (rows, columns) float32
            Log images of successive frames.
        times_ms : (images,)
        middle : int
            Index of the image whose places the chains have.
        frame : int
            Its number in the run.

        Returns
        -------
        tuple of Chain
            No two have two electrodes in common. Empty from a detector that searches single frames only.
        """

    def shows_extra_catheter(self, x: Image, chains: Sequence[Chain]) -> bool:
        """Return whether the log image clearly shows a catheter besides these chains."""
