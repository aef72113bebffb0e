"""The route of single frames for display, in stored pixels."""

from __future__ import annotations

import math
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from fluoromap_service.api.http.etags import is_known, not_modified
from fluoromap_service.api.http.file_pool import Task, run_in_pool
from fluoromap_service.api.http.paths import FrameNumber, InstanceUid, StudyId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.security import Reader
from fluoromap_service.dicom import frame_png
from fluoromap_service.problem import Problem, not_found
from fluoromap_service.store import files
from fluoromap_service.store.engine import reading
from fluoromap_service.study import instances

router = APIRouter(prefix="/v1/studies/{study_id}/instances", tags=["instances"])


@router.get(
    "/{uid}/frames/{n}.png",
    response_class=Response,
    responses={
        200: {
            "content": {"image/png": {"schema": {"type": "string", "format": "binary"}}},
            "description": "The frame.",
        },
        **responses(401, 403, 404, 422, 429),
    },
)
def get_frame(
    study_id: StudyId,
    uid: InstanceUid,
    n: FrameNumber,
    request: Request,
    caller: Reader,
    window: Annotated[
        str | None, Query(description="Centre and width in stored values.", examples=["512,1024"], max_length=60)
    ] = None,
) -> Response:
    """Return one frame as an 8-bit picture in stored pixels.

    Without `window` the picture has the file's own window, otherwise the frame's own range.
    """
    chosen = None if window is None else _window(window)
    with reading() as session:
        run = instances.run_of(session, study_id, uid)
    if n > run.facts.frames:
        raise not_found("frame")
    shown = "" if chosen is None else f"-{chosen[0]:g}-{chosen[1]:g}"
    etag = f'"{run.instance.sha256[:32]}-{n}{shown}"'
    if is_known(request, etag):
        return not_modified(etag)
    picture = run_in_pool(Task.DRAW_PICTURE, frame_png, files.path_of(run.instance.sha256), run.facts, n - 1, chosen)
    # A stored file never changes, so a browser may keep the picture.
    return Response(
        picture, media_type="image/png", headers={"ETag": etag, "Cache-Control": "private, max-age=3600, immutable"}
    )


def _window(text: str) -> tuple[float, float]:
    try:
        centre, width = (float(part) for part in text.split(","))
    except ValueError:
        centre, width = math.nan, math.nan
    if not (math.isfinite(centre) and 1 <= width <= 1e6 and abs(centre) <= 1e6):
        raise Problem(
            422,
            "invalid",
            "A window is a centre and a width of 1 or more, as in 512,1024.",
            [("query.window", "wrong")],
        )
    return centre, width
