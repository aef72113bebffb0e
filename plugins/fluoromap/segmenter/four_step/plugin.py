"""Segmenter ``four-step``: the paper's filters in every frame and in the diastolic mean."""

from __future__ import annotations

from typing import ClassVar

from pydantic import BaseModel

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Context, Marks, Run, Segmentation
from fluoromap.segmenter.four_step.frame_chains import FourStepDetector, FourStepParams
from fluoromap.segmenter.runs.run_segmentation import segment_run


class FourStep:
    """The paper's segmenter: equations (4) to (7), disks, Otsu, components; then linking.

    Every frame is filtered and linked on its own. So is the mean of the quiet frames round diastole: steeply angulated,
    noisy views succeed there that fail frame by frame.
    """

    name: ClassVar[str] = "four-step"
    version: ClassVar[str] = "24"
    Params: ClassVar[type[BaseModel]] = FourStepParams

    def __init__(self, params: FourStepParams | None = None) -> None:
        self.params = params or FourStepParams()

    def segment(self, run: Run, catalogue: Catalogue, marks: Marks, context: Context) -> Segmentation:
        """Segment a run; see :class:`~fluoromap.contracts.Segmenter`."""
        return segment_run(
            run,
            catalogue,
            marks,
            context,
            lambda field: FourStepDetector(catalogue, field, run.px_per_mm, self.params),
        )
