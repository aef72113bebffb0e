"""Catheters that left the field: the reason of a frame that lacks them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fluoromap.contracts import Chain, FrameChains
from fluoromap.reasons import Reason
from fluoromap.segmenter.picture.field_mask import (
    FieldMask,
)

_EDGE_PX = 12


def mark_out_of_field(entries: Sequence[FrameChains], field: FieldMask) -> tuple[FrameChains, ...]:
    """Replace TRACK_INTERRUPTED by OUT_OF_FIELD where catheters left the field.

    Every missing catheter must have been at the edge of the field when it was found last.
    """
    seen: dict[int, list[tuple[int, Chain]]] = {}
    for entry in entries:
        for chain in entry.chains:
            seen.setdefault(chain.track, []).append((entry.frame, chain))
    usual = {track: known for track, known in seen.items() if len(known) > len(entries) / 2}
    told = []
    for entry in entries:
        if entry.manual_needed is Reason.TRACK_INTERRUPTED:
            here = {chain.track for chain in entry.chains}
            last = [
                min(known, key=lambda one: abs(one[0] - entry.frame))[1]
                for track, known in usual.items()
                if track not in here
            ]
            if last and all(_at_edge(chain, field) for chain in last):
                entry = replace(entry, manual_needed=Reason.OUT_OF_FIELD)
        told.append(entry)
    return tuple(told)


def _at_edge(chain: Chain, field: FieldMask) -> bool:
    rows, columns = field.candidates.shape
    for u, v in np.rint(chain.pixels_uv).astype(np.int64):
        left, top = max(u - _EDGE_PX, 0), max(v - _EDGE_PX, 0)
        if u + _EDGE_PX >= columns or v + _EDGE_PX >= rows or min(u, v) < _EDGE_PX:
            return True
        if not field.candidates[top : v + _EDGE_PX + 1, left : u + _EDGE_PX + 1].all():
            return True
    return False
