"""What the electrode network is made of. Training builds it in PyTorch, segmenting runs it compiled, from this one table."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Convolution:
    """One layer: channels in and out, width of the square window, step, distance between the window's taps; rectified or not."""

    inputs: int
    outputs: int
    width: int = 3
    stride: int = 1
    dilation: int = 1
    rectified: bool = True

    @property
    def border(self) -> int:
        """How many pixels round a pixel its answer depends on."""
        return self.width // 2 * self.dilation


HEADS = "heat", "offset_u", "offset_v", "log_variance", "tip"
"""Answers of each cell of 2 x 2 px: logit of an electrode's centre, its offset from the cell's middle in cells, logarithm of the
variance of that offset in cells squared, logit of a tip electrode."""

CELL_PX = 2
STRIDE_PX = 8
"""Rows and columns of a picture are multiples of this."""

AROUND = "around_1", "around_2", "around_3", "around_4", "around_5"
"""Layers whose answers are added to what they are asked about."""

CONVOLUTIONS = {
    "at_half": Convolution(1, 16, width=5, stride=2),
    "at_quarter": Convolution(16, 32, stride=2),
    "at_quarter_again": Convolution(32, 32),
    "at_eighth": Convolution(32, 64, stride=2),
    "around_1": Convolution(64, 64),
    "around_2": Convolution(64, 64, dilation=2),
    "around_3": Convolution(64, 64, dilation=4),
    "around_4": Convolution(64, 64, dilation=2),
    "around_5": Convolution(64, 64),
    "back": Convolution(64, 32, width=1, rectified=False),
    "merged": Convolution(32, 32),
    "heads": Convolution(32, 4 * len(HEADS), width=1, rectified=False),
}
