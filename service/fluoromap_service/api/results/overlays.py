"""The routes of the overlays: the activation map fused on fluoroscopy frames."""

from __future__ import annotations

from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import quote

from fastapi import Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from fluoromap.drawing.colours import Palette
from fluoromap.drawing.overlay import Look
from fluoromap_service.api.http.etags import file_response
from fluoromap_service.api.http.file_names import plain_name
from fluoromap_service.api.http.file_pool import Task, run_in_pool
from fluoromap_service.api.http.paths import InstanceUid, JobId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.problem import Problem
from fluoromap_service.results.dependencies import overlay_dependencies
from fluoromap_service.results.finished import job_of
from fluoromap_service.results.fusion import Fusion, draw_fusion, draw_fusion_jpeg, fusion_of
from fluoromap_service.results.placement import LocatedView, located_views
from fluoromap_service.store import files
from fluoromap_service.store.engine import reading
from fluoromap_service.store.renderings import KeptFile, find_rendering, kept_rendering
from fluoromap_service.study.run_files import check_not_deleted, checked_run

router = new_router(tags=["results"])


class Overlay(BaseModel):
    """A picture that the service can draw; by default of the frame that located the site."""

    sop_instance_uid: str
    site: str
    view: Literal["a", "b"]
    frame: int = Field(description="The diastolic frame, counted from 1.")
    href: str


class Overlays(BaseModel):
    """All pictures that the service can draw of a job."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "overlays": [
                        {
                            "sop_instance_uid": "1.2.826.0.1.3680043.8.498.1", "site": "S03", "view": "a", "frame": 37,
                            "href": "/v1/jobs/7f0c.../overlays/1.2.826.0.1.3680043.8.498.1.png",
                        }
                    ]
                }
            ]
        }
    )  # fmt: skip

    overlays: list[Overlay]


def picture_of(job_id: str, fusion: Fusion, look: Look, *, moving: bool = False) -> KeptFile:
    """Return the kept PNG or GIF of an overlay.

    The GIF shows the propagation. The picture is drawn when none is kept. It says when the run is simulated.
    """
    look = _marked(fusion, look)

    def make() -> bytes:
        with _run_file(fusion) as path:
            return run_in_pool(Task.DRAW_PICTURE, draw_fusion, path, fusion, look, moving)

    return kept_rendering(job_id, overlay_dependencies(fusion, look, moving=moving), make)


def check_picture(job_id: str, fusion: Fusion, look: Look) -> None:
    """Check the run from which :func:`picture_of` will draw; a kept picture needs none.

    A deleted run passes, because its picture has a problem of its own.

    Raises
    ------
    BrokenFile
    """
    dependencies = overlay_dependencies(fusion, _marked(fusion, look), moving=False)
    if find_rendering(job_id, dependencies) is None:
        with suppress(Problem):
            check_not_deleted([fusion.sha256])
            files.checked_path(fusion.sha256)


def jpeg_of(fusion: Fusion, look: Look) -> bytes:
    """Return a new JPEG of an overlay, which nothing keeps."""
    with _run_file(fusion) as path:
        return run_in_pool(Task.DRAW_PICTURE, draw_fusion_jpeg, path, fusion, _marked(fusion, look))


def _marked(fusion: Fusion, look: Look) -> Look:
    """Return the look that says when the run is simulated."""
    return replace(look, simulated=fusion.facts.simulated)


def _run_file(fusion: Fusion) -> AbstractContextManager[Path]:
    check_not_deleted([fusion.sha256])
    return checked_run(fusion.sha256, fusion.facts)


@router.get(
    "/v1/jobs/{job_id}/overlays",
    summary="Pictures of the map on fluoroscopy",
    response_model=Overlays,
    responses=responses(401, 403, 404, 409),
)
def list_overlays(job_id: JobId, caller: Reader) -> Overlays:
    """Return one entry for each view of each located site.

    The answer is 409 `not_ready` before the stage `fuse` is done, and 409 `no_map` when the sites support no map.
    """
    with reading() as session:
        views = located_views(session, job_of(session, job_id))
    return Overlays(overlays=[_overlay(job_id, view) for view in views])


def _overlay(job_id: str, view: LocatedView) -> Overlay:
    href = f"/v1/jobs/{job_id}/overlays/{quote(view.uid)}.png"
    return Overlay(sop_instance_uid=view.uid, site=view.site, view=view.view, frame=view.frame + 1, href=href)


FrameQuery = Annotated[
    int | None, Query(ge=1, description="Frame of the run, counted from 1; by default the diastolic frame.")
]
ScaleQuery = Annotated[Literal["1", "2"], Query(description="Pixels of the picture per stored pixel, along each side.")]
ColoursQuery = Annotated[
    Literal["safe", "red-early"],
    Query(
        description="`safe`: colours that colour-blind readers can order; `red-early`: the colours of mapping systems."
    ),
]
StepQuery = Annotated[
    Literal["5", "10"] | None, Query(description="Time between isochrones in ms; by default a step that suits the map.")
]
EllipsesQuery = Annotated[bool, Query(description="Draw each site's 95 % ellipse.")]
ElectrodesQuery = Annotated[bool, Query(description="Draw the electrodes that the service found in this frame.")]


def _look(fusion: Fusion, scale: str, colours: Palette, step_ms: str | None, ellipses: bool, electrodes: bool) -> Look:
    return Look(
        scale=int(scale),
        palette=colours,
        step_ms=None if step_ms is None else float(step_ms),
        covariances_mm2=fusion.covariances_mm2 if ellipses else {},
        electrodes_uv=fusion.electrodes_uv if electrodes else {},
    )


def _picture_answers(media_type: str) -> dict[int | str, dict[str, Any]]:
    content = {media_type: {"schema": {"type": "string", "format": "binary"}}}
    return {
        200: {"content": content, "description": "The picture."},
        304: {"description": "Unchanged since the ETag sent."},
        **responses(401, 403, 404, 409, 422, 429),
    }


@router.get(
    "/v1/jobs/{job_id}/overlays/{uid}.png",
    summary="The map on one fluoroscopy frame",
    response_class=Response,
    responses=_picture_answers("image/png"),
)
def get_overlay(
    job_id: JobId,
    uid: InstanceUid,
    request: Request,
    caller: Reader,
    frame: FrameQuery = None,
    scale: ScaleQuery = "1",
    colours: ColoursQuery = "safe",
    step_ms: StepQuery = None,
    ellipses: EllipsesQuery = False,
    electrodes: ElectrodesQuery = False,
    until_ms: Annotated[
        float | None,
        Query(
            ge=-10_000,
            le=10_000,
            description="Colour only the wall that is activated by this time; the front is a thick line.",
        ),
    ] = None,
) -> Response:
    """Return a frame with the map.

    The picture has isochrones, hull outline, sites with times in ms, a star at the tip and a colour bar in ms. The
    picture is in stored pixels.
    """
    with reading() as session:
        fusion = fusion_of(session, job_of(session, job_id), uid, frame)
    look = replace(_look(fusion, scale, colours, step_ms, ellipses, electrodes), until_ms=until_ms)
    picture = picture_of(job_id, fusion, look)
    name = f"overlay-{plain_name(fusion.site)}-{fusion.frame + 1}.png"
    return file_response(request, picture.path, picture.sha256, "image/png", name, inline=True)


@router.get(
    "/v1/jobs/{job_id}/overlays/{uid}.gif",
    summary="The activation that runs over the map, on one fluoroscopy frame",
    response_class=Response,
    responses=_picture_answers("image/gif"),
)
def get_propagation(
    job_id: JobId,
    uid: InstanceUid,
    request: Request,
    caller: Reader,
    frame: FrameQuery = None,
    scale: ScaleQuery = "1",
    colours: ColoursQuery = "safe",
    step_ms: StepQuery = None,
    ellipses: EllipsesQuery = False,
    electrodes: ElectrodesQuery = False,
) -> Response:
    """Return the overlay as a moving picture of the activation.

    From the earliest time to the latest, each picture colours the wall that is activated by then.
    """
    with reading() as session:
        fusion = fusion_of(session, job_of(session, job_id), uid, frame)
    picture = picture_of(job_id, fusion, _look(fusion, scale, colours, step_ms, ellipses, electrodes), moving=True)
    name = f"propagation-{plain_name(fusion.site)}-{fusion.frame + 1}.gif"
    return file_response(request, picture.path, picture.sha256, "image/gif", name, inline=True)
