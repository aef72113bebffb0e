"""Segmenter ``learned-chain``: a network proposes electrodes; they are linked to the chains that the catalogue allows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from pydantic import BaseModel, Field

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Context, Marks, Run, Segmentation
from fluoromap.segmenter.chain_detector import Acceptance, ChainDetector
from fluoromap.segmenter.field_mask import FieldMask
from fluoromap.segmenter.learned_chain.network_response import NetworkResponse
from fluoromap.segmenter.learned_chain.weights import SHIPPED, read_weights
from fluoromap.segmenter.linking import Trust
from fluoromap.segmenter.log_image import Image
from fluoromap.segmenter.run_segmentation import segment_run
from fluoromap.segmenter.visible_part import visible_part
from fluoromap.segmenter.warm_up import compile_kernels

_TRUST = Trust(share=0.25, chain=0.7)
_IN_A_RUN = Acceptance(
    least_clearness=0.1,
    again_clearness=0.1,
    sure_clearness=0.1,
    extra_clearness=0.3,
    least_score=0.4,
    seen_score=0.15,
    least_seen=0.85,
    unseen_evidence=-1.5,
    strict=True,
    trust=_TRUST,
)
_ALONE = replace(_IN_A_RUN, least_clearness=0.3, sure_clearness=0.5, least_score=0.4)
"""Scores are probabilities. In a single frame no other frame confirms a chain."""

_DIM_BELOW = 0.02
"""Probabilities fall fast: an electrode of a fiftieth of its chain's best probability was only predicted."""
_COARSE_BITS = 8
_COARSE_NOISE = 0.004


class LearnedChainParams(BaseModel, extra="forbid"):
    """Parameters of the learned segmenter."""

    weights: str | None = Field(
        None,
        max_length=1024,
        description="Path of a weights file of ``python -m fluoromap.training``; the shipped one by default.",
    )


class LearnedChain:
    """Electrodes that a small network proposes, catheters as chains of them that fit the catalogue, the best set of chains.

    The network was trained on synthetic fluoroscopy with cables, wires, probes and contrast-filled vessels. Everything after it
    is shared with ``catheter-chain``.
    """

    name: ClassVar[str] = "learned-chain"
    version: ClassVar[str] = "2"
    Params: ClassVar[type[BaseModel]] = LearnedChainParams

    def __init__(self, params: LearnedChainParams | None = None) -> None:
        self.params = params or LearnedChainParams()

    @classmethod
    def warm_up(cls) -> None:
        """Compile the kernels, or load them from the cache."""
        compile_kernels(cls())

    def segment(self, run: Run, catalogue: Catalogue, marks: Marks, context: Context) -> Segmentation:
        """Segment a run; see :class:`~fluoromap.contracts.Segmenter`."""
        trained = read_weights(SHIPPED if self.params.weights is None else Path(self.params.weights))
        acceptance = _IN_A_RUN if len(run.frames) > 1 else _ALONE
        least_noise = _COARSE_NOISE if run.pixels.bits_stored <= _COARSE_BITS else 0.0

        def detector_of(field: FieldMask) -> ChainDetector:
            def ask(x: Image) -> NetworkResponse:
                return NetworkResponse.of_image(x, field.inside, trained, run.px_per_mm, least_noise)

            return ChainDetector(catalogue, field, run.px_per_mm, ask, acceptance)

        return visible_part(segment_run(run, catalogue, marks, context, detector_of, search_again=True), _DIM_BELOW)
