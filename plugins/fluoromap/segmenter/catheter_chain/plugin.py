"""Segmenter ``catheter-chain``: blobs linked to chains that fit the catalogue."""

from __future__ import annotations

from typing import ClassVar

from pydantic import BaseModel

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Context, Marks, NoParams, Run, Segmentation
from fluoromap.segmenter.electrodes.blob_response import BlobResponse
from fluoromap.segmenter.frames.chain_detector import ChainDetector
from fluoromap.segmenter.judge.acceptance import Acceptance, ScoreLimits
from fluoromap.segmenter.judge.visible_part import visible_part
from fluoromap.segmenter.picture.field_mask import FieldMask
from fluoromap.segmenter.picture.log_image import Image
from fluoromap.segmenter.runs.run_segmentation import segment_run
from fluoromap.segmenter.warm_up import prepare

_ACCEPTANCE = Acceptance(
    least_clearness=0.75, again_clearness=0.6, sure_clearness=1.1, extra_clearness=1.3, scores=ScoreLimits(3.5)
)
"""Scores are contrast over noise."""


class CatheterChain:
    """Segmenter that links blobs at three scales to the best set of chains.

    Every frame is searched on its own. A catheter that one frame does not show clearly is searched again along its
    track. Frames without a clear chain are left to the user.
    """

    name: ClassVar[str] = "catheter-chain"
    version: ClassVar[str] = "32"
    Params: ClassVar[type[BaseModel]] = NoParams

    def __init__(self, params: BaseModel | None = None) -> None:
        self.params = params or NoParams()

    @classmethod
    def warm_up(cls) -> None:
        """Compile the kernels, or load them from the cache."""
        prepare(cls())

    def segment(self, run: Run, catalogue: Catalogue, marks: Marks, context: Context) -> Segmentation:
        """Segment a run; see :class:`~fluoromap.contracts.Segmenter`."""
        return visible_part(
            segment_run(
                run,
                catalogue,
                marks,
                context,
                lambda field: blob_chains(catalogue, field, run.px_per_mm),
                search_again=True,
            )
        )


def blob_chains(catalogue: Catalogue, field: FieldMask, px_per_mm: float) -> ChainDetector:
    """Return the detector of one run.

    It finds blobs of the size of the catalogue's electrodes, and the chains of them.
    """
    ring_mm = min(catheter.ring_mm for catheter in catalogue.catheters)

    def blobs(x: Image) -> BlobResponse:
        return BlobResponse.of_image(x, field.inside, ring_mm, px_per_mm)

    return ChainDetector(catalogue, field, px_per_mm, blobs, _ACCEPTANCE)
