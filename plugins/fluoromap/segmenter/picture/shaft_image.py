"""Shaft images: pictures in which the dark shafts of catheters are visible."""

from __future__ import annotations

from dataclasses import dataclass

from fluoromap.segmenter.picture.log_image import Image

_SIDE_MM = 1.75


@dataclass(frozen=True, slots=True, eq=False)
class ShaftImage:
    """An image in which the dark shafts of catheters are visible.

    smooth : the log image without most of its noise, ``reduction`` times smaller than the frame. clear : depth of a clearly
    visible shaft, log units. px_per_mm : of the frame, at the isocentre.
    """

    smooth: Image
    reduction: int
    clear: float
    px_per_mm: float

    @property
    def side_px(self) -> float:
        """Distance beside a shaft at which its surroundings are measured, pixels of the frame."""
        return max(2.0, _SIDE_MM * self.px_per_mm)
