"""One search of a run, at the scale that it states."""

from __future__ import annotations

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Context, Marks, Run, Segmentation
from fluoromap.segmenter.electrodes.frame_answers import StoredAnswers
from fluoromap.segmenter.electrodes.network.weights import Trained
from fluoromap.segmenter.frames.detector import Detector
from fluoromap.segmenter.frames.electrode_detector import electrode_chains
from fluoromap.segmenter.judge.track_evidence import TrackEvidence
from fluoromap.segmenter.judge.visible_part import visible_part
from fluoromap.segmenter.picture.field_mask import FieldMask
from fluoromap.segmenter.places.chain_fitting import names_with_long_tips
from fluoromap.segmenter.runs.run_segmentation import segment_run

_DIM_BELOW = 0.02
"""Probabilities fall fast: an electrode of a fiftieth of its chain's best probability was only predicted."""


def search_at_scale(run: Run, catalogue: Catalogue, marks: Marks, context: Context, trained: Trained) -> Segmentation:
    """Segment a run at ``run.px_per_mm``."""
    alone = len(run.frames) == 1
    frame_ms = float(np.diff(run.frame_times_ms).max(initial=0.0))

    answers = StoredAnswers()

    def detector_of(field: FieldMask) -> Detector:
        return electrode_chains(catalogue, field, run.pixels, run.px_per_mm, trained, alone, frame_ms, answers)

    judge = (
        None
        if alone
        else TrackEvidence(
            trained,
            run.px_per_mm,
            run.frame_times_ms,
            names_with_long_tips(catalogue),
            frozenset(catheter.name for catheter in catalogue.catheters if catheter.is_circular),
        )
    )
    found = segment_run(run, catalogue, marks, context, detector_of, True, True, judge, oblique=True)
    return visible_part(found, _DIM_BELOW)
