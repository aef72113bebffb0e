"""A job's activation map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from sqlalchemy.orm import Session

from fluoromap.contracts import Array, ChamberMap
from fluoromap.reasons import Reason
from fluoromap_service.jobs.stage_results import MapResult, load
from fluoromap_service.problem import Problem
from fluoromap_service.results.finished import done_stage, is_simulated
from fluoromap_service.results.origins import Origin
from fluoromap_service.results.row_order import warnings_of
from fluoromap_service.store.models import Job


@dataclass(frozen=True, eq=False)
class FinishedMap:
    """The map of a job.

    chamber : relative to the reference catheter. reference_mm : (3,) mean position of that catheter over the sites, from the
    isocentre; None where no site has a located reference catheter, and then the map counts from the isocentre. sha256 : hash
    of the stored result. warnings : of the map and of the job. simulated : True where all runs of the job are simulated.
    """

    chamber: ChamberMap
    reference_mm: Array | None
    sha256: str
    warnings: tuple[Reason, ...]
    simulated: bool

    def origin(self, chosen: Origin) -> Origin:
        """Return the origin of the map's answer.

        It is the chosen one, or the isocentre where no site has a located reference catheter.
        """
        return Origin.ISOCENTRE if self.reference_mm is None else chosen

    def shift_mm(self, origin: Origin) -> Array:
        """Return the vector (3,) to add to the map's coordinates.

        The sums count from ``origin``.
        """
        if origin is Origin.REFERENCE or self.reference_mm is None:
            return np.zeros(3)
        return self.reference_mm


def map_of(session: Session, job: Job) -> FinishedMap:
    """Return a job's map.

    Raises
    ------
    Problem
        409 ``not_ready``, or 409 ``no_map`` with a sentence that says why the sites support no map.
    """
    stage = done_stage(session, job, "fuse")
    outcome = load(MapResult, stage)
    if outcome.chamber is None:
        reasons = {"reasons": [str(outcome.refused)]} if outcome.refused else {}
        raise Problem(409, "no_map", outcome.message or "The sites of this study support no map.", extra=reasons)
    reference_mm = None if outcome.reference_mm is None else np.array(outcome.reference_mm)
    warnings = (*outcome.chamber.warnings, *warnings_of(session, job))
    return FinishedMap(outcome.chamber, reference_mm, str(stage.result), warnings, is_simulated(job))
