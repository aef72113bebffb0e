"""Segmenter ``learned-chain``: a network proposes electrodes; they are linked to the chains that the catalogue allows."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import ClassVar

from pydantic import BaseModel, Field

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Context, Marks, Preview, Run, Segmentation
from fluoromap.segmenter.electrodes.network.weights import SHIPPED, read_weights
from fluoromap.segmenter.learned_chain.preview import preview
from fluoromap.segmenter.runs.hypotheses.run_search import RunSearch
from fluoromap.segmenter.runs.hypotheses.scale_and_polarity import is_inverted
from fluoromap.segmenter.warm_up import prepare

_log = logging.getLogger(__name__)


class LearnedChainParams(BaseModel, extra="forbid"):
    """Parameters of the learned segmenter."""

    weights: str | None = Field(
        None,
        max_length=1024,
        description="Path of a weights file of ``python -m fluoromap.training``; the shipped one by default.",
    )


class LearnedChain:
    """Electrodes that a small network and blobs propose, chains of them that fit the catalogue, the best set of chains.

    The network was trained on synthetic fluoroscopy with cables, wires, probes and contrast-filled vessels. Everything after it
    is shared with ``catheter-chain``.
    """

    name: ClassVar[str] = "learned-chain"
    version: ClassVar[str] = "48"
    Params: ClassVar[type[BaseModel]] = LearnedChainParams

    def __init__(self, params: LearnedChainParams | None = None) -> None:
        self.params = params or LearnedChainParams()

    @classmethod
    def warm_up(cls) -> None:
        """Compile the kernels, or load them from the cache."""
        prepare(cls())

    def segment(self, run: Run, catalogue: Catalogue, marks: Marks, context: Context) -> Segmentation:
        """Segment a run; see :class:`~fluoromap.contracts.Segmenter`."""
        trained = read_weights(SHIPPED if self.params.weights is None else Path(self.params.weights))
        search = RunSearch(run, catalogue, marks, context, trained)
        found = search.listed_catheters()
        if not any(entry.chains for entry in found.frames) and is_inverted(run, catalogue, trained):
            inverted = search.inverted()
            if any(entry.chains for entry in inverted.frames):
                _log.warning(
                    "The electrodes are bright: the grey levels were inverted although the header does not say so."
                )
                found = inverted
        return found

    def preview(self, run: Run, catalogue: Catalogue, frame: int, scale_is_known: bool) -> Preview:
        """Find the electrodes of one frame for showing; see :class:`~fluoromap.contracts.Previewer`."""
        return preview(self, run, catalogue, frame, scale_is_known)
