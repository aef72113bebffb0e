"""Segmenter ``catheter-chain``, the default: blobs of electrode size, linked to the chains that the catalogue allows."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np
from pydantic import BaseModel

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Chain, Context, FrameChains, Marks, NoParams, Run, Segmentation
from fluoromap.reasons import Reason
from fluoromap.segmenter.catheter_chain.blob_chains import BlobDetector
from fluoromap.segmenter.run_segmentation import segment_run
from fluoromap.segmenter.warm_run import compile_on_drawn_run

DIM_BELOW = 0.2
"""An electrode that is fainter than this share of its chain's clearest was predicted, not seen: it is not told."""
LEAST_SEEN = 3
"""A catheter of which fewer electrodes are seen cannot be told from background, nor which end is its tip."""


class CatheterChain:
    """Electrodes as blobs at three scales, catheters as chains of them that fit the catalogue, the best set of chains.

    Every frame is searched on its own; what one frame does not show clearly is carried along the catheter's track. Frames in
    which no chain stands out are handed to the user, not filled.
    """

    name: ClassVar[str] = "catheter-chain"
    version: ClassVar[str] = "4"
    Params: ClassVar[type[BaseModel]] = NoParams

    def __init__(self, params: BaseModel | None = None) -> None:
        self.params = params or NoParams()

    @classmethod
    def warm_up(cls) -> None:
        """Compile the kernels, or load what is kept of them."""
        compile_on_drawn_run(cls())

    def segment(self, run: Run, catalogue: Catalogue, marks: Marks, context: Context) -> Segmentation:
        """Chains of all frames and of the diastolic mean; see :class:`~fluoromap.contracts.Segmenter`."""
        found = segment_run(
            run, catalogue, marks, context, lambda field: BlobDetector(catalogue, field, run.px_per_mm), carry=True
        )
        diastole = None if found.diastole is None else _as_seen(found.diastole)
        return replace(found, frames=tuple(map(_as_seen, found.frames)), diastole=diastole)


def _as_seen(entry: FrameChains) -> FrameChains:
    """The chains without electrodes that the image does not show; where none is left, that is said."""
    chains = tuple(seen for chain in entry.chains if (seen := _seen_part(chain)) is not None)
    reason = entry.manual_needed
    if entry.chains and not chains:
        reason = reason or Reason.MANUAL_NEEDED
    return replace(entry, chains=chains, manual_needed=reason)


def _seen_part(chain: Chain) -> Chain | None:
    if chain.manual:
        return chain
    seen = np.flatnonzero(chain.scores >= DIM_BELOW * chain.scores.max())
    if len(seen) == len(chain.electrodes):
        return chain
    if len(seen) < LEAST_SEEN:
        return None
    return replace(
        chain,
        electrodes=tuple(chain.electrodes[index] for index in seen),
        pixels_uv=chain.pixels_uv[seen],
        covariance_px2=chain.covariance_px2[seen],
        scores=chain.scores[seen],
    )
