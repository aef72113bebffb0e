"""The route of many frames in one answer, from which a viewer plays a cine."""

from __future__ import annotations

from typing import Annotated

from fastapi import Query, Request, Response

from fluoromap_service.api.http.etags import is_known, not_modified
from fluoromap_service.api.http.file_pool import Task, run_in_pool
from fluoromap_service.api.http.paths import InstanceUid, StudyId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.dicom import cine_8bit
from fluoromap_service.problem import not_found
from fluoromap_service.store.engine import reading
from fluoromap_service.study import instances
from fluoromap_service.study.run_files import checked_run

router = new_router("/v1/studies/{study_id}/instances", tags=["instances"])

MOST_BYTES = 16 * 2**20
"""Size of an answer, unless a single frame is larger."""

_CONTENT = {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}


@router.get(
    "/{uid}/frames",
    summary="Many frames of a run",
    response_class=Response,
    responses={200: {"content": _CONTENT, "description": "The frames."}, **responses(401, 403, 404, 409, 422, 429)},
)
def get_frames(
    study_id: StudyId,
    uid: InstanceUid,
    request: Request,
    caller: Reader,
    first: Annotated[int, Query(ge=1, description="First frame, counted from 1.")] = 1,
    count: Annotated[int, Query(ge=1, le=10_000, description="Most frames to send.")] = 10_000,
) -> Response:
    """Return many frames of a run.

    They follow one after the other, one byte a pixel, row by row, in stored pixels; 0 is black.
    The answer holds at most 16 MiB, so it may have fewer frames than asked for: divide its length by rows times columns, and
    ask again from the next frame on. All frames have the same window.
    """
    with reading() as session:
        run = instances.run_of(session, study_id, uid)
    facts = run.facts
    if first > facts.frames:
        raise not_found("frame")
    sent = min(count, facts.frames - first + 1, max(1, MOST_BYTES // (facts.rows * facts.columns)))
    etag = f'"{run.sha256[:32]}-{first}-{sent}"'
    with checked_run(run.sha256, facts) as path:
        if is_known(request, etag):
            return not_modified(etag)
        content = run_in_pool(Task.DRAW_PICTURE, cine_8bit, path, facts, first - 1, sent)
    return Response(
        content,
        media_type="application/octet-stream",
        headers={"ETag": etag, "Cache-Control": "private, max-age=3600, immutable"},
    )
