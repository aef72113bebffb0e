"""Segmenter ``catheter-chain``, the default: blobs of electrode size, linked to the chains that the catalogue allows."""

from __future__ import annotations

from typing import ClassVar

from pydantic import BaseModel

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Context, Marks, NoParams, Run, Segmentation
from fluoromap.segmenter.blob_chains import BlobDetector
from fluoromap.segmenter.run_segmentation import segment_run


class CatheterChain:
    """Electrodes as blobs at three scales, catheters as chains of them that fit the catalogue, the best set of chains.

    Every frame is searched on its own; what one frame does not show clearly is carried along the catheter's track. Frames in
    which no chain stands out are handed to the user, not filled.
    """

    name: ClassVar[str] = "catheter-chain"
    version: ClassVar[str] = "1"
    Params: ClassVar[type[BaseModel]] = NoParams

    def __init__(self, params: BaseModel | None = None) -> None:
        self.params = params or NoParams()

    def segment(self, run: Run, catalogue: Catalogue, marks: Marks, context: Context) -> Segmentation:
        """Chains of all frames and of the diastolic mean; see :class:`~fluoromap.contracts.Segmenter`."""
        return segment_run(
            run, catalogue, marks, context, lambda field: BlobDetector(catalogue, field, run.px_per_mm), carry=True
        )
