"""The routes of the chamber's activation map and of its mesh files."""

from __future__ import annotations

from typing import Annotated

from fastapi import Path, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from fluoromap.contracts import Array, ChamberMap, SurfaceSite
from fluoromap.drawing.map_picture import draw_map_views
from fluoromap.drawing.png import encode_png
from fluoromap.reasons import Reason
from fluoromap_service.api.http.etags import file_response, is_known, not_modified
from fluoromap_service.api.http.file_pool import Task, run_in_pool
from fluoromap_service.api.http.paths import JobId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.api.results.origins import FrameOfReference, OriginQuery, Position
from fluoromap_service.results.dependencies import map_picture_dependencies
from fluoromap_service.results.finished import job_of
from fluoromap_service.results.maps import FinishedMap, map_of
from fluoromap_service.results.mesh_files import MESH_MEDIA_TYPES, MeshFormat, mesh_of
from fluoromap_service.results.origins import Origin
from fluoromap_service.store.engine import reading
from fluoromap_service.store.renderings import KeptFile, kept_rendering

router = new_router(tags=["results"])


class MapSite(BaseModel):
    """A site on the map."""

    site: str
    x_mm: float
    y_mm: float
    z_mm: float
    surface_mm: Position = Field(description="The site's place on the surface.")
    distance_mm: float = Field(description="From the site to that place.")
    lat_ms: float
    leave_one_out_error_ms: float | None = Field(
        description="Time that the other sites predict here, minus the measured time."
    )
    reasons: list[Reason] = Field(description="For example `lat_outlier`.")


class Earliest(BaseModel):
    """A site that may be the earliest."""

    site: str
    probability: float = Field(description="Probability that this site is the earliest, given the errors of the times.")


class Velocity(BaseModel):
    """Speed of activation along the wall: median and 95 % interval, from places with four or more sites within 15 mm."""

    median_m_per_s: float
    low_m_per_s: float
    high_m_per_s: float


class ActivationMap(BaseModel):
    """The chamber's surface with activation times at its vertices."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "frame": {"axes": "LPS", "origin": "reference", "unit": "mm"},
                    "vertices_mm": [[31.0, -8.0, 13.0], [28.0, -4.0, 9.0], [25.0, -9.0, 12.0], [27.0, -8.0, 20.0]],
                    "faces": [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]],
                    "lat_ms": [41.0, 38.5, 36.0, None],
                    "lat_sd_ms": [2.0, 2.6, 2.9, None],
                    "covered": [True, True, True, False],
                    "sites": [
                        {
                            "site": "S03", "x_mm": 31.2, "y_mm": -8.4, "z_mm": 12.9, "surface_mm": [31.0, -8.0, 13.0],
                            "distance_mm": 0.5, "lat_ms": 41.0, "leave_one_out_error_ms": 1.7, "reasons": [],
                        }
                    ],
                    "earliest": [{"site": "S03", "probability": 0.92}],
                    "total_activation_time_ms": 74.0,
                    "leave_one_out_rms_ms": 5.1,
                    "volume_ml": 96.0,
                    "area_cm2": 104.0,
                    "coverage": 0.83,
                    "warnings": [],
                    "conduction_velocity": {"median_m_per_s": 0.78, "low_m_per_s": 0.7, "high_m_per_s": 0.87},
                    "cycle_length_ms": None,
                    "simulated": False,
                }
            ]
        }
    )  # fmt: skip

    frame: FrameOfReference
    vertices_mm: list[Position]
    faces: list[tuple[int, int, int]] = Field(description="Vertices counted from 0; outward by the right-hand rule.")
    lat_ms: list[float | None] = Field(description="Activation time at each vertex; null where no site is near.")
    lat_sd_ms: list[float | None]
    covered: list[bool]
    sites: list[MapSite]
    earliest: list[Earliest] = Field(description="Most probable first, until they reach 99 % together.")
    total_activation_time_ms: float
    leave_one_out_rms_ms: float | None
    volume_ml: float
    area_cm2: float
    coverage: float = Field(ge=0, le=1, description="Covered share of the area.")
    warnings: list[Reason]
    conduction_velocity: Velocity | None = Field(description="Null where no sites lie close enough together.")
    cycle_length_ms: float | None = Field(
        description="Cycle length of a re-entry: times repeat after it, so early meets late."
    )
    simulated: bool = Field(description="True where all runs of the job are simulated.")


def activation_map(finished: FinishedMap, origin: Origin) -> ActivationMap:
    """Return a finished map in the shape of the answer."""
    chamber, shift = finished.chamber, finished.shift_mm(origin)
    covered = chamber.covered.tolist()
    return ActivationMap(
        frame=FrameOfReference(origin=finished.origin(origin)),
        vertices_mm=(chamber.vertices_mm + shift).tolist(),
        faces=chamber.faces.tolist(),
        lat_ms=_where(covered, chamber.lat_ms.tolist()),
        lat_sd_ms=_where(covered, chamber.lat_sd_ms.tolist()),
        covered=covered,
        sites=[_site(site, shift) for site in chamber.sites],
        earliest=[Earliest(site=site, probability=probability) for site, probability in chamber.earliest],
        total_activation_time_ms=chamber.total_activation_time_ms,
        leave_one_out_rms_ms=chamber.leave_one_out_rms_ms,
        volume_ml=chamber.volume_ml,
        area_cm2=chamber.area_cm2,
        coverage=chamber.coverage,
        warnings=list(finished.warnings),
        conduction_velocity=_velocity(chamber),
        cycle_length_ms=chamber.cycle_length_ms,
        simulated=finished.simulated,
    )


def _velocity(chamber: ChamberMap) -> Velocity | None:
    velocity = chamber.conduction_velocity
    if velocity is None:
        return None
    return Velocity(
        median_m_per_s=velocity.median_m_per_s, low_m_per_s=velocity.low_m_per_s, high_m_per_s=velocity.high_m_per_s
    )


def _where(covered: list[bool], values: list[float]) -> list[float | None]:
    return [value if inside else None for inside, value in zip(covered, values, strict=True)]


def _site(site: SurfaceSite, shift: Array) -> MapSite:
    x, y, z = (site.position_mm + shift).tolist()
    return MapSite(
        site=site.site,
        x_mm=x,
        y_mm=y,
        z_mm=z,
        surface_mm=(site.surface_mm + shift).tolist(),
        distance_mm=site.distance_mm,
        lat_ms=site.lat_ms,
        leave_one_out_error_ms=site.leave_one_out_error_ms,
        reasons=list(site.reasons),
    )


@router.get(
    "/v1/jobs/{job_id}/map",
    summary="Activation map",
    response_model=ActivationMap,
    responses={304: {"description": "Unchanged since the ETag sent."}, **responses(401, 403, 404, 409, 422)},
)
def get_map(job_id: JobId, request: Request, caller: Reader, origin: OriginQuery = Origin.REFERENCE) -> Response:
    """Return the chamber's surface with activation times.

    The map is available as soon as the stage `fuse` is done; before that the answer is 409 `not_ready`. When the located
    sites support no surface, the answer is 409 `no_map` with a sentence that says why.
    """
    with reading() as session:
        finished = map_of(session, job_of(session, job_id))
    etag = f'"{finished.sha256}-{origin}-{len(finished.warnings)}"'
    if is_known(request, etag):
        return not_modified(etag)
    # The model is right by construction: FastAPI would check thousands of vertices once more.
    content = activation_map(finished, origin).model_dump_json()
    return Response(content, media_type="application/json", headers={"ETag": etag})


def map_picture_of(job_id: str, finished: FinishedMap) -> KeptFile:
    """Return the kept PNG of the map from six sides.

    The picture is drawn when none is kept.
    """
    return kept_rendering(
        job_id,
        map_picture_dependencies(finished.sha256, simulated=finished.simulated),
        lambda: run_in_pool(Task.DRAW_PICTURE, _map_picture, finished.chamber, finished.simulated),
    )


def _map_picture(chamber: ChamberMap, simulated: bool) -> bytes:
    return encode_png(draw_map_views(chamber, simulated=simulated))


@router.get(
    "/v1/jobs/{job_id}/map.png",
    summary="Activation map from six sides",
    response_class=Response,
    responses={
        200: {
            "content": {"image/png": {"schema": {"type": "string", "format": "binary"}}},
            "description": "The picture.",
        },
        304: {"description": "Unchanged since the ETag sent."},
        **responses(401, 403, 404, 409, 422, 429),
    },
)
def get_map_picture(job_id: JobId, request: Request, caller: Reader) -> Response:
    """Return a picture of the map from six sides.

    It has sites, isochrones and the colour bar in ms.
    """
    with reading() as session:
        finished = map_of(session, job_of(session, job_id))
    picture = map_picture_of(job_id, finished)
    return file_response(request, picture.path, picture.sha256, "image/png", f"map-{job_id}.png", inline=True)


_MESHES = {
    media: {"schema": {"type": "string"} if media.startswith("text/") else {"type": "string", "format": "binary"}}
    for media in MESH_MEDIA_TYPES.values()
}


@router.get(
    "/v1/jobs/{job_id}/mesh.{mesh_format}",
    summary="Chamber mesh",
    response_class=Response,
    responses={
        200: {"content": _MESHES, "description": "The mesh file."},
        304: {"description": "Unchanged since the ETag sent."},
        **responses(401, 403, 404, 409, 422),
    },
)
def get_mesh(
    job_id: JobId,
    mesh_format: Annotated[
        MeshFormat,
        Path(description="PLY and GLB have colours, VTP has the times as scalars, MAT is OpenEP's structure."),
    ],
    request: Request,
    caller: Reader,
    origin: OriginQuery = Origin.REFERENCE,
) -> Response:
    """Return the chamber with activation times as a mesh file.

    Coordinates are in mm along DICOM patient axes; GLB is in metres with y up, as glTF demands.
    """
    with reading() as session:
        finished = map_of(session, job_of(session, job_id))
    mesh = mesh_of(job_id, finished, mesh_format, origin)
    media_type = MESH_MEDIA_TYPES[mesh_format]
    return file_response(
        request, mesh.path, mesh.sha256, media_type, f"chamber-{finished.origin(origin)}.{mesh_format}"
    )
