"""The parts of an overlay: one fluoroscopy frame, its camera, the map, and the place of the map on the frame."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from sqlalchemy.orm import Session

from fluoromap.contracts import Array, ChamberMap, LocatedSite, Matching, NamedChain, Triangulation, View
from fluoromap.drawing.animation import draw_propagation
from fluoromap.drawing.map_placement import map_shift_mm, tip_pixel
from fluoromap.drawing.overlay import Look, draw_overlay
from fluoromap.drawing.png import encode_png
from fluoromap.geometry import Camera
from fluoromap.monoplane.track_samples import reference_origins
from fluoromap_service.dicom import InstanceFacts, frame_to_8bit, open_frames
from fluoromap_service.jobs.stage_results import SiteTracks, load, stage_of
from fluoromap_service.problem import Problem, not_found
from fluoromap_service.results.finished import done_stage, snapshot_of
from fluoromap_service.results.maps import map_of
from fluoromap_service.store.models import Job, StageState
from fluoromap_service.study.snapshot import Snapshot

VIEWS: tuple[View, ...] = ("a", "b")


@dataclass(frozen=True, eq=False)
class Fusion:
    """All parts of one overlay.

    uid, sha256, facts : of the run. frame : counted from 0. map_sha256 : hash of the stored result that holds ``chamber``.
    shift_mm : (3,) world = map + shift. tip_uv : (2,) pixel of the mapping tip. covariances_mm2 : (3, 3) of each site.
    """

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


@dataclass(frozen=True, slots=True)
class LocatedView:
    """One view of a located site; ``frame`` is the diastolic frame, counted from 0."""

    site: str
    view: View
    uid: str
    frame: int


def located_views(session: Session, job: Job) -> list[LocatedView]:
    """Return both views of each located site.

    Raises
    ------
    Problem
        409 while there is no map.
    """
    map_of(session, job)
    return _located_views(load(Triangulation, done_stage(session, job, "triangulate")), snapshot_of(job))


def fusion_of(session: Session, job: Job, uid: str, frame: int | None) -> Fusion:
    """Return the parts of the overlay of one run.

    Parameters
    ----------
    session : Session
    job : Job
    uid : str
        SOP Instance UID of the run.
    frame : int or None
        Counted from 1; None takes the diastolic frame.

    Raises
    ------
    Problem
        404 for a run that is not a view of a located site, 422 for a frame that the run does not have, 409 without a map.
    """
    finished = map_of(session, job)
    snapshot = snapshot_of(job)
    triangulation = load(Triangulation, done_stage(session, job, "triangulate"))
    entry = next((each for each in _located_views(triangulation, snapshot) if each.uid == uid), None)
    if entry is None:
        raise not_found("overlay: the run is no view of a located site")
    run = snapshot.runs[uid]
    facts = InstanceFacts.from_json(run.facts)
    index = entry.frame if frame is None else frame - 1
    if not 0 <= index < facts.frames:
        detail = f"This run has the frames 1 to {facts.frames}; choose one of them."
        raise Problem(422, "no_such_frame", detail, [("frame", "out of range")])
    site = next(each for each in triangulation.sites if each.site == entry.site)
    camera = site.camera(entry.view)
    chains = _chains(session, job, entry, index)
    tracked_mm = (
        None if index == entry.frame else _tracked_reference_mm(session, job, snapshot, site, entry.view, index)
    )
    mean_mm = np.zeros(3) if finished.reference_mm is None else finished.reference_mm
    shift_mm = map_shift_mm(site, camera, chains.get(snapshot.reference), tracked_mm, mean_mm)
    return Fusion(
        uid=uid,
        sha256=run.sha256,
        facts=facts,
        frame=index,
        camera=camera,
        map_sha256=finished.sha256,
        chamber=finished.chamber,
        shift_mm=shift_mm,
        site=entry.site,
        tip_uv=tip_pixel(site, camera, snapshot.mapping, chains.get(snapshot.mapping), shift_mm),
        covariances_mm2=_covariances(triangulation, snapshot.mapping),
    )


JPEG_QUALITY = 88
"""Fluoroscopy is noise: with JPEG a page of 40 overlays has a few MB."""


def draw_fusion(path: Path, fusion: Fusion, look: Look, moving: bool) -> bytes:
    """Return an overlay as PNG, or its propagation as GIF, from the run's file."""
    parts = _parts(path, fusion)
    return draw_propagation(*parts, look) if moving else encode_png(draw_overlay(*parts, look))


def draw_fusion_jpeg(path: Path, fusion: Fusion, look: Look) -> bytes:
    """Return an overlay as JPEG, from the run's file.

    It is smaller than a PNG, and not exact.
    """
    stream = io.BytesIO()
    Image.fromarray(draw_overlay(*_parts(path, fusion), look)).save(stream, format="JPEG", quality=JPEG_QUALITY)
    return stream.getvalue()


def _parts(path: Path, fusion: Fusion) -> tuple[NDArray[np.uint8], Camera, ChamberMap, Array, str, Array | None]:
    frame = frame_to_8bit(open_frames(path, fusion.facts)[fusion.frame], fusion.facts)
    return frame, fusion.camera, fusion.chamber, fusion.shift_mm, fusion.site, fusion.tip_uv


def _located_views(triangulation: Triangulation, snapshot: Snapshot) -> list[LocatedView]:
    return [
        LocatedView(site.site, view, snapshot.site(site.site).run(view), site.diastolic_frame(view))
        for site in triangulation.sites
        for view in VIEWS
    ]


def _covariances(triangulation: Triangulation, mapping: str) -> dict[str, Array]:
    """Return the covariance of each site's mapping tip.

    It is relative to the reference catheter where that is located.
    """
    tips = {site.site: site.point(mapping, 1) for site in triangulation.sites}
    return {
        site: tip.covariance_mm2 if tip.relative_covariance_mm2 is None else tip.relative_covariance_mm2
        for site, tip in tips.items()
        if tip is not None
    }


def _tracked_reference_mm(
    session: Session, job: Job, snapshot: Snapshot, site: LocatedSite, view: View, frame: int
) -> Array | None:
    """Return the reference catheter's position (3,) by the view's track.

    None in frames that do not show it.
    """
    stage = stage_of(session, job.id, "monoplane", site.site)
    if stage is None or stage.state != StageState.DONE:
        return None
    track = next((each.track for each in load(SiteTracks, stage).views if each.view == view), None)
    if track is None or frame >= len(track.located):
        return None
    origins = reference_origins(track, site, snapshot.reference, None)
    if not origins.same_frame[frame]:
        return None
    position: Array = origins.positions_mm[frame]
    return position


def _chains(session: Session, job: Job, entry: LocatedView, frame: int) -> dict[str, NamedChain]:
    """Return the catheters that one frame shows, by name."""
    matching = load(Matching, done_stage(session, job, "match"))
    site = next((each for each in matching.sites if each.site == entry.site), None)
    if site is None:
        return {}
    diastole = site.diastole.a if entry.view == "a" else site.diastole.b
    track = site.track_a if entry.view == "a" else site.track_b
    chains: dict[str, NamedChain] = {}
    for observation in (diastole, *track):
        if observation.frame == frame:
            for chain in observation.chains:
                chains.setdefault(chain.catheter, chain)
    return chains
