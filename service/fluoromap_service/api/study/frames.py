"""Single frames for display, in stored pixels."""

from __future__ import annotations

import math
from pathlib import Path as FilePath
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from fluoromap.drawing.png import encode_png
from fluoromap_service.api.http.etags import is_known, not_modified
from fluoromap_service.api.http.file_pool import Task, run_in_pool
from fluoromap_service.api.http.paths import FrameNumber, InstanceUid, StudyId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.security import Reader
from fluoromap_service.dicom import InstanceFacts, frame_to_8bit, open_frames
from fluoromap_service.problem import Problem, not_found
from fluoromap_service.store import files
from fluoromap_service.store.engine import reading
from fluoromap_service.study import instances

router = APIRouter(prefix="/v1/studies/{study_id}/instances", tags=["instances"])


def frame_png(path: FilePath, facts: InstanceFacts, frame: int, window: tuple[float, float] | None) -> bytes:
    """Frame ``frame`` (from 0) as an 8-bit greyscale PNG of the stored size and orientation."""
    return encode_png(frame_to_8bit(open_frames(path, facts)[frame], facts, window))


@router.get(
    "/{uid}/frames/{n}.png",
    response_class=Response,
    responses={200: {"content": {"image/png": {}}, "description": "The frame."}, **responses(401, 403, 404, 422, 429)},
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
    """One frame as an 8-bit picture; without ``window`` the file's own window, else the frame's own range."""
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
    # A stored file never changes.
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
            422, "invalid", "A window is its centre and its width, as in 512,1024.", [("query.window", "wrong")]
        )
    return centre, width
