"""The route of epipolar lines between two runs."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from fastapi import Query
from pydantic import BaseModel, Field

from fluoromap_service.api.http.paths import InstanceUid, StudyId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.results.epipolar import epipolar_line
from fluoromap_service.store.engine import reading

router = new_router("/v1/studies/{study_id}/instances", tags=["electrodes"])

Pixel = Annotated[float, Query(ge=-10_000, le=10_000)]


class EpipolarLine(BaseModel):
    """A straight line in stored pixels; its ends may lie outside the image."""

    start_px: tuple[float, float] = Field(description="[u, v] of the end nearer to the first run's source.")
    end_px: tuple[float, float]


@router.get("/{uid}/epipolar-line", responses=responses(401, 403, 404, 409, 422))
def get_epipolar_line(
    study_id: StudyId,
    uid: InstanceUid,
    caller: Reader,
    other: Annotated[str, Query(max_length=64, description="SOP Instance UID of the run that shows the line.")],
    u_px: Pixel,
    v_px: Pixel,
) -> EpipolarLine:
    """Return the line in another run on which a pixel of this run lies.

    With a finished job the line contains the job's self-calibration.
    """
    with reading() as session:
        ends = epipolar_line(session, study_id, uid, other, np.array([u_px, v_px]))
    (start_u, start_v), (end_u, end_v) = ends.tolist()
    return EpipolarLine(start_px=(start_u, start_v), end_px=(end_u, end_v))
