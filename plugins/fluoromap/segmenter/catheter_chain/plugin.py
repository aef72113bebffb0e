"""Segmenter ``catheter-chain``, the default: blobs linked to chains that fit the catalogue."""

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
from fluoromap.segmenter.warm_up import compile_kernels

DIM_BELOW = 0.2
"""An electrode fainter than this share of its chain's clearest one was only predicted; it is left out."""
LEAST_VISIBLE = 3
"""A chain with fewer visible electrodes may be background, and its tip may be at either end."""


class CatheterChain:
    """Segmenter that links blobs at three scales to the best set of chains.

    Every frame is searched on its own. A catheter that one frame does not show clearly is searched again along its track.
    Frames
    without a clear chain are left to the user.
    """

    name: ClassVar[str] = "catheter-chain"
    version: ClassVar[str] = "4"
    Params: ClassVar[type[BaseModel]] = NoParams

    def __init__(self, params: BaseModel | None = None) -> None:
        self.params = params or NoParams()

    @classmethod
    def warm_up(cls) -> None:
        """Compile the kernels, or load them from the cache."""
        compile_kernels(cls())

    def segment(self, run: Run, catalogue: Catalogue, marks: Marks, context: Context) -> Segmentation:
        """Segment a run; see :class:`~fluoromap.contracts.Segmenter`."""
        found = segment_run(
            run,
            catalogue,
            marks,
            context,
            lambda field: BlobDetector(catalogue, field, run.px_per_mm),
            search_again=True,
        )
        diastole = None if found.diastole is None else _visible_chains(found.diastole)
        return replace(found, frames=tuple(map(_visible_chains, found.frames)), diastole=diastole)


def _visible_chains(entry: FrameChains) -> FrameChains:
    """Return the entry without electrodes that the image does not show.

    Where no chain is left, ``manual_needed`` is set.
    """
    chains = tuple(visible for chain in entry.chains if (visible := _visible_part(chain)) is not None)
    reason = entry.manual_needed
    if entry.chains and not chains:
        reason = reason or Reason.MANUAL_NEEDED
    return replace(entry, chains=chains, manual_needed=reason)


def _visible_part(chain: Chain) -> Chain | None:
    if chain.manual:
        return chain
    visible = np.flatnonzero(chain.scores >= DIM_BELOW * chain.scores.max())
    if len(visible) == len(chain.electrodes):
        return chain
    if len(visible) < LEAST_VISIBLE:
        return None
    return replace(
        chain,
        electrodes=tuple(chain.electrodes[index] for index in visible),
        pixels_uv=chain.pixels_uv[visible],
        covariance_px2=chain.covariance_px2[visible],
        scores=chain.scores[visible],
    )
