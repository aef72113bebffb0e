"""Segmenter ``four-step``: the paper's filter in every frame, linked to chains, and once more in the diastolic mean."""

from __future__ import annotations

from typing import ClassVar

from pydantic import BaseModel

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Context, Marks, Run, Segmentation
from fluoromap.segmenter.four_step.frame_chains import FourStepDetector, FourStepParams
from fluoromap.segmenter.run_segmentation import segment_run


class FourStep:
    """The paper's segmentation: equations (4) to (7), disk morphology, Otsu, components; then linking by the catalogue.

    Every frame is filtered and linked on its own, and so is the mean of the quiet frames round diastole, in which the
    steeply angulated, noisy views succeed too that fail frame by frame.
    """

    name: ClassVar[str] = "four-step"
    version: ClassVar[str] = "4"
    Params: ClassVar[type[BaseModel]] = FourStepParams

    def __init__(self, params: FourStepParams | None = None) -> None:
        self.params = params or FourStepParams()

    def segment(self, run: Run, catalogue: Catalogue, marks: Marks, context: Context) -> Segmentation:
        """Chains of all frames and of the diastolic mean; see :class:`~fluoromap.contracts.Segmenter`."""
        return segment_run(
            run,
            catalogue,
            marks,
            context,
            lambda field: FourStepDetector(catalogue, field, run.px_per_mm, self.params),
        )
