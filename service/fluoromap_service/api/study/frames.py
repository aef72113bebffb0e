"""The routes of single frames for display, in stored pixels, and of the electrodes that they show."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Annotated

from fastapi import Query, Request, Response
from pydantic import BaseModel, Field

from fluoromap.catheters import Catalogue
from fluoromap_service.api.http.etags import is_known, not_modified
from fluoromap_service.api.http.file_pool import Task, run_in_pool
from fluoromap_service.api.http.middleware.download_limit import PICTURE
from fluoromap_service.api.http.paths import FrameNumber, InstanceUid, StudyId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.dicom import frame_png
from fluoromap_service.problem import Problem, not_found
from fluoromap_service.store import files
from fluoromap_service.store.engine import reading
from fluoromap_service.study import instances, preview, studies
from fluoromap_service.study.catheters import catalogue_of
from fluoromap_service.study.instances import StudyRun
from fluoromap_service.study.preview import ScaleSource
from fluoromap_service.study.run_files import checked_run

router = new_router("/v1/studies/{study_id}/instances", tags=["instances"])


class PreviewElectrodeOut(BaseModel):
    """One electrode of a preview."""

    catheter: str | None = Field(description="Null where no catheter of the study fits.", examples=["mapping"])
    electrode: int = Field(description="1 is the tip.", examples=[1])
    u_px: float = Field(examples=[251.5])
    v_px: float = Field(examples=[233.0])
    sd_px: float = Field(examples=[0.6])


class PreviewOut(BaseModel):
    """Electrodes of one frame, for showing only: a job does not use them."""

    px_per_mm: float | None = Field(description="At the isocentre; null where `scale` is unknown.", examples=[3.6])
    scale: ScaleSource = Field(
        description="`measured`: from the run's geometry. `found`: the scale at which the study's catheters explain the pictures "
        "best, right to about 20 %. `unknown`: no scale explains them."
    )
    inverted: bool = Field(description="Whether high values are dark although the header does not say so.")
    electrodes: list[PreviewElectrodeOut]


@router.get(
    "/{uid}/frames/{n}.png",
    dependencies=[PICTURE],
    response_class=Response,
    responses={
        200: {
            "content": {"image/png": {"schema": {"type": "string", "format": "binary"}}},
            "description": "The frame.",
        },
        **responses(401, 403, 404, 409, 422, 429, 503),
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
    electrodes: Annotated[bool, Query(description="Whether to draw the electrodes of the preview.")] = False,
) -> Response:
    """Return one frame as an 8-bit picture in stored pixels.

    Without `window` the picture has the file's own window, otherwise the frame's own range. With `electrodes` it has a ring round
    each electrode of the preview.
    """
    chosen = None if window is None else _window(window)
    run, catalogue = _run_with_frame(study_id, uid, n)
    if electrodes:
        path, px_per_mm = files.checked_path(run.sha256), _px_per_mm(run)
        marked = run_in_pool(
            Task.FIND_ELECTRODES, preview.preview_png, path, run.facts, catalogue, n - 1, px_per_mm, chosen
        )
        return Response(marked, media_type="image/png", headers={"Cache-Control": "no-store"})
    shown = "" if chosen is None else f"-{chosen[0]:g}-{chosen[1]:g}"
    etag = f'"{run.sha256[:32]}-{n}{shown}"'
    with checked_run(run.sha256, run.facts) as path:
        if is_known(request, etag):
            return not_modified(etag)
        picture = run_in_pool(Task.DRAW_PICTURE, frame_png, path, run.facts, n - 1, chosen)
    # A stored file never changes, so a browser may keep the picture.
    return Response(
        picture, media_type="image/png", headers={"ETag": etag, "Cache-Control": "private, max-age=3600, immutable"}
    )


@router.get(
    "/{uid}/frames/{n}/preview",
    dependencies=[PICTURE],
    responses=responses(401, 403, 404, 409, 422, 429, 503),
)
def get_preview(study_id: StudyId, uid: InstanceUid, n: FrameNumber, caller: Reader) -> PreviewOut:
    """Find the electrodes of one frame without a job, for showing only.

    The run's geometry may be incomplete: then the scale is found from the study's catheters, and `scale` says so.
    """
    run, catalogue = _run_with_frame(study_id, uid, n)
    path = files.checked_path(run.sha256)
    found = run_in_pool(
        Task.FIND_ELECTRODES, preview.preview_electrodes, path, run.facts, catalogue, n - 1, _px_per_mm(run)
    )
    return PreviewOut.model_validate(asdict(found))


def _run_with_frame(study_id: str, uid: str, n: int) -> tuple[StudyRun, Catalogue]:
    with reading() as session:
        run = instances.run_of(session, study_id, uid)
        catalogue = catalogue_of(studies.get(session, study_id))
    if n > run.facts.frames:
        raise not_found("frame")
    return run, catalogue


def _px_per_mm(run: StudyRun) -> float | None:
    """Return the measured scale at the isocentre.

    It needs no angles. None while a length is missing.
    """
    gantry = run.gantry
    lengths = gantry["source_detector_mm"], gantry["source_isocentre_mm"], gantry["pixel_spacing_mm"]
    if any(length is None for length in lengths):
        return None
    return float(lengths[0] / lengths[1] / math.sqrt(lengths[2][0] * lengths[2][1]))


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
