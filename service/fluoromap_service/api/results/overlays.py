"""The activation map fused on fluoroscopy frames."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Annotated, Any, Literal
from urllib.parse import quote

import numpy as np
from fastapi import APIRouter, Path, Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.orm import Session

from fluoromap.contracts import Array, ChamberMap, LocatedSite, Matching, NamedChain, Triangulation, View
from fluoromap.drawing.animation import draw_propagation
from fluoromap.drawing.colours import Palette
from fluoromap.drawing.overlay import Look, draw_overlay
from fluoromap.drawing.png import encode_png
from fluoromap.geometry import Camera
from fluoromap_service.api.http.etags import file_response
from fluoromap_service.api.http.file_names import plain_name
from fluoromap_service.api.http.file_pool import Task, run_in_pool
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.security import Reader
from fluoromap_service.api.jobs.finished import done_stage, job_of, map_of, snapshot_of
from fluoromap_service.api.results.maps import chamber_of
from fluoromap_service.api.results.track_samples import camera_of, reference
from fluoromap_service.dicom import InstanceFacts, frame_to_8bit, open_frames
from fluoromap_service.jobs.stage_results import MapResult, SiteTracks, load, stage_of
from fluoromap_service.problem import Problem, not_found
from fluoromap_service.store import files
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Job, StageState
from fluoromap_service.store.renderings import Rendered, rendered
from fluoromap_service.study.snapshot import Snapshot

router = APIRouter(tags=["results"])

VIEWS: tuple[View, ...] = ("a", "b")

JobId = Annotated[str, Path(description="The job's id.")]


class Overlay(BaseModel):
    """A picture that can be had; by default of the frame that located the site."""

    sop_instance_uid: str
    site: str
    view: Literal["a", "b"]
    frame: int = Field(description="The diastolic frame, counted from 1.")
    href: str


class Overlays(BaseModel):
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


@dataclass(frozen=True, eq=False)
class Fusion:
    """Everything that one overlay is drawn of; ``frame`` counts from 0, ``shift_mm`` (3,) takes the map to the world."""

    uid: str
    sha256: str
    facts: InstanceFacts
    frame: int
    camera: Camera
    map_sha256: str
    chamber: ChamberMap
    shift_mm: Array
    site: str
    tip_uv: Array | None
    covariances_mm2: dict[str, Array]
    """Of each site on the map, (3, 3)."""

    def asked(self, look: Look, moving: bool) -> dict[str, Any]:
        """What the picture depends on, as JSON values."""
        return {
            "overlay": self.uid,
            "file": self.sha256,
            "frame": self.frame,
            "camera": self.camera.matrix.ravel().tolist(),
            "map": self.map_sha256,
            "shift_mm": self.shift_mm.tolist(),
            "tip_uv": None if self.tip_uv is None else self.tip_uv.tolist(),
            "scale": look.scale,
            "palette": look.palette,
            "step_ms": look.step_ms,
            "until_ms": look.until_ms,
            "ellipses": {site: covariance.tolist() for site, covariance in look.covariances_mm2.items()},
            "moving": moving,
        }


def overlays_of(session: Session, job: Job) -> list[Overlay]:
    """An overlay for each view of each located site; 409 while there is no map."""
    map_of(session, job)
    snapshot = snapshot_of(job)
    listed = []
    for located in load(Triangulation, done_stage(session, job, "triangulate")).sites:
        for view in VIEWS:
            uid = snapshot.site(located.site).run(view)
            href = f"/v1/jobs/{job.id}/overlays/{quote(uid)}.png"
            frame = _diastolic_frame(located, view) + 1
            listed.append(Overlay(sop_instance_uid=uid, site=located.site, view=view, frame=frame, href=href))
    return listed


def fusion_of(session: Session, job: Job, uid: str, frame: int | None) -> Fusion:
    """What the overlay of a run is drawn of.

    Parameters
    ----------
    frame : int or None
        Counted from 1; None takes the diastolic frame.

    Raises
    ------
    Problem
        404 for a run that is not a view of a located site, 422 for a frame the run does not have, 409 without a map.
    """
    outcome, fuse = map_of(session, job)
    snapshot = snapshot_of(job)
    triangulation = load(Triangulation, done_stage(session, job, "triangulate"))
    located, view = _view_of(triangulation, snapshot, uid)
    plan = snapshot.runs[uid]
    facts = InstanceFacts.from_json(plan.facts)
    index = _diastolic_frame(located, view) if frame is None else frame - 1
    if not 0 <= index < facts.frames:
        raise Problem(
            422, "no_such_frame", f"This run has the frames 1 to {facts.frames}.", [("frame", "out of range")]
        )
    camera = camera_of(located, view)
    shift = _shift(session, job, snapshot, outcome, located, view, index)
    return Fusion(
        uid=uid,
        sha256=plan.sha256,
        facts=facts,
        frame=index,
        camera=camera,
        map_sha256=str(fuse.result),
        chamber=chamber_of(outcome),
        shift_mm=shift,
        site=located.site,
        tip_uv=_tip(session, job, snapshot, located, view, index, shift),
        covariances_mm2=_covariances(triangulation, snapshot.mapping),
    )


def picture_of(job_id: str, fusion: Fusion, look: Look, *, moving: bool = False) -> Rendered:
    """The kept PNG of an overlay, or the GIF of its propagation."""

    def make() -> bytes:
        path = files.path_of(fusion.sha256)
        if not path.exists():
            raise Problem(409, "run_deleted", "This run was deleted; its overlay can no longer be drawn.")
        return run_in_pool(Task.DRAW_PICTURE, draw, path, fusion, look, moving)

    return rendered(job_id, fusion.asked(look, moving), "image/gif" if moving else "image/png", make)


def draw(path: FilePath, fusion: Fusion, look: Look, moving: bool) -> bytes:
    """PNG or GIF of an overlay from the run's file; called in a process of its own."""
    shown = frame_to_8bit(open_frames(path, fusion.facts)[fusion.frame], fusion.facts)
    of = (shown, fusion.camera, fusion.chamber, fusion.shift_mm, fusion.site, fusion.tip_uv)
    return draw_propagation(*of, look) if moving else encode_png(draw_overlay(*of, look))


def _covariances(triangulation: Triangulation, mapping: str) -> dict[str, Array]:
    """Of the mapping tip of each site, relative to the reference catheter where that was located."""
    tips = {located.site: located.point(mapping, 1) for located in triangulation.sites}
    return {
        site: tip.covariance_mm2 if tip.relative_covariance_mm2 is None else tip.relative_covariance_mm2
        for site, tip in tips.items()
        if tip is not None
    }


def _view_of(triangulation: Triangulation, snapshot: Snapshot, uid: str) -> tuple[LocatedSite, View]:
    for located in triangulation.sites:
        for view in VIEWS:
            if snapshot.site(located.site).run(view) == uid:
                return located, view
    raise not_found("overlay: the run is no view of a located site")


def _diastolic_frame(located: LocatedSite, view: View) -> int:
    return located.frame_a if view == "a" else located.frame_b


def _shift(
    session: Session, job: Job, snapshot: Snapshot, outcome: MapResult, located: LocatedSite, view: View, frame: int
) -> Array:
    """Where the reference catheter stood in this frame: the map hangs on it.

    As the view was followed; in the diastolic frame, and where it was not, as two views located it at diastole, moved across
    the rays to where this frame shows it, since the heart breathes between the two runs; where no reference was located,
    the mean over the sites.
    """
    if frame != _diastolic_frame(located, view):
        stage = stage_of(session, job.id, "monoplane", located.site)
        if stage is not None and stage.state == StageState.DONE:
            track = next((own.track for own in load(SiteTracks, stage).views if own.view == view), None)
            if track is not None and frame < len(track.located):
                origins = reference(track, located, snapshot.reference, None)
                if origins.same_frame[frame]:
                    followed: Array = origins.positions_mm[frame]
                    return followed
    if located.reference_mm is None:
        return np.array(outcome.reference_mm or (0.0, 0.0, 0.0))
    seen = _seen(session, job, located, view, frame, snapshot.reference)
    if seen is None:
        return located.reference_mm
    moved: Array = located.reference_mm + _displacement_mm(located, camera_of(located, view), seen)
    return moved


def _displacement_mm(located: LocatedSite, camera: Camera, seen: NamedChain) -> Array:
    """How far (3,) a view shows a catheter from where two views located it; 0 where they located none of it.

    The least displacement that explains it: what is along the rays a single view cannot tell.
    """
    pairs = [
        (point.position_mm, pixel)
        for electrode, pixel in zip(seen.electrodes, seen.pixels_uv, strict=True)
        if (point := located.point(seen.catheter, electrode)) is not None
    ]
    if not pairs:
        return np.zeros(3)
    positions, pixels = (np.array(column) for column in zip(*pairs, strict=True))
    off_px = (pixels - camera.project(positions)).mean(axis=0)
    displacement: Array = np.linalg.pinv(camera.jacobian(positions.mean(axis=0))) @ off_px
    return displacement


def _tip(
    session: Session, job: Job, snapshot: Snapshot, located: LocatedSite, view: View, frame: int, shift: Array
) -> Array | None:
    """The mapping tip as seen in this frame, else where it stands on the map at diastole."""
    seen = _seen(session, job, located, view, frame, snapshot.mapping)
    if seen is not None and 1 in seen.electrodes:
        uv: Array = seen.pixels_uv[seen.electrodes.index(1)]
        return uv
    tip = located.point(snapshot.mapping, 1)
    if tip is None:
        return None
    if tip.relative_mm is None:
        return camera_of(located, view).project(tip.position_mm)
    return camera_of(located, view).project(tip.relative_mm + shift)


def _seen(session: Session, job: Job, located: LocatedSite, view: View, frame: int, catheter: str) -> NamedChain | None:
    """A catheter's electrodes as this frame shows them."""
    matching = load(Matching, done_stage(session, job, "match"))
    matched = next((site for site in matching.sites if site.site == located.site), None)
    if matched is None:
        return None
    diastole = matched.diastole.a if view == "a" else matched.diastole.b
    track = matched.track_a if view == "a" else matched.track_b
    chains = (chain for shown in (diastole, *track) if shown.frame == frame for chain in shown.chains)
    return next((chain for chain in chains if chain.catheter == catheter), None)


@router.get(
    "/v1/jobs/{job_id}/overlays",
    summary="Pictures of the map on fluoroscopy",
    response_model=Overlays,
    responses=responses(401, 403, 404, 409),
)
def list_overlays(job_id: JobId, caller: Reader) -> Overlays:
    """One entry for each view of each located site; 409 `not_ready` before the map is made, `no_map` where there is none."""
    with reading() as session:
        return Overlays(overlays=overlays_of(session, job_of(session, job_id)))


UidPath = Annotated[str, Path(description="SOPInstanceUID of the run.")]
FrameQuery = Annotated[int | None, Query(ge=1, description="Counted from 1; by default the diastolic frame.")]
ScaleQuery = Annotated[Literal["1", "2"], Query(description="Pixels of the picture per stored pixel.")]
ColoursQuery = Annotated[
    Literal["safe", "red-early"],
    Query(description="`safe`: ordered for colour-blind readers too; `red-early`: as mapping systems show it."),
]
StepQuery = Annotated[
    Literal["5", "10"] | None, Query(description="Between isochrones, in ms; by default what suits the map.")
]
EllipsesQuery = Annotated[bool, Query(description="Draw each site's 95 % ellipse.")]


def _look(fusion: Fusion, scale: str, colours: Palette, step_ms: str | None, ellipses: bool) -> Look:
    return Look(
        scale=int(scale),
        palette=colours,
        step_ms=None if step_ms is None else float(step_ms),
        covariances_mm2=fusion.covariances_mm2 if ellipses else {},
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
    uid: UidPath,
    request: Request,
    caller: Reader,
    frame: FrameQuery = None,
    scale: ScaleQuery = "1",
    colours: ColoursQuery = "safe",
    step_ms: StepQuery = None,
    ellipses: EllipsesQuery = False,
    until_ms: Annotated[
        float | None,
        Query(ge=-10_000, le=10_000, description="Colour only what is activated by then; the front as a thick line."),
    ] = None,
) -> Response:
    """Isochrones, hull outline, sites with their times in ms, a star at the tip and a colour bar, in stored pixels."""
    with reading() as session:
        fusion = fusion_of(session, job_of(session, job_id), uid, frame)
    look = replace(_look(fusion, scale, colours, step_ms, ellipses), until_ms=until_ms)
    picture = picture_of(job_id, fusion, look)
    name = f"overlay-{plain_name(fusion.site)}-{fusion.frame + 1}.png"
    return file_response(request, picture.path, picture.sha256, "image/png", name, inline=True)


@router.get(
    "/v1/jobs/{job_id}/overlays/{uid}.gif",
    summary="The activation running over the map, on one fluoroscopy frame",
    response_class=Response,
    responses=_picture_answers("image/gif"),
)
def get_propagation(
    job_id: JobId,
    uid: UidPath,
    request: Request,
    caller: Reader,
    frame: FrameQuery = None,
    scale: ScaleQuery = "1",
    colours: ColoursQuery = "safe",
    step_ms: StepQuery = None,
    ellipses: EllipsesQuery = False,
) -> Response:
    """The overlay as a moving picture: from the earliest time to the latest the wall is coloured as far as it is activated."""
    with reading() as session:
        fusion = fusion_of(session, job_of(session, job_id), uid, frame)
    picture = picture_of(job_id, fusion, _look(fusion, scale, colours, step_ms, ellipses), moving=True)
    name = f"propagation-{plain_name(fusion.site)}-{fusion.frame + 1}.gif"
    return file_response(request, picture.path, picture.sha256, "image/gif", name, inline=True)
