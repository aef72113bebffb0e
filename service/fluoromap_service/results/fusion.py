"""The parts of an overlay: one fluoroscopy frame, its camera, the map, and the place of the map on the frame."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from sqlalchemy.orm import Session

from fluoromap.contracts import Array, ChamberMap, Triangulation
from fluoromap.drawing.animation import draw_propagation
from fluoromap.drawing.overlay import Look, draw_overlay
from fluoromap.drawing.png import encode_png
from fluoromap.geometry import Camera
from fluoromap_service.dicom import InstanceFacts, frame_to_8bit, open_frames
from fluoromap_service.problem import Problem
from fluoromap_service.results.placement import placement_of
from fluoromap_service.store.models import Job


@dataclass(frozen=True, eq=False)
class Fusion:
    """All parts of one overlay.

    uid, sha256, facts : of the run. frame : counted from 0. map_sha256 : hash of the stored result that holds ``chamber``.
    shift_mm : (3,) world = map + shift. tip_uv : (2,) pixel of the mapping tip. covariances_mm2 : (3, 3) of each site.
    electrodes_uv : (k, 2) pixels of each catheter's electrodes in the frame.
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
    electrodes_uv: dict[str, Array]


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
    placement = placement_of(session, job, uid)
    snapshot = placement.snapshot
    run = snapshot.runs[uid]
    facts = InstanceFacts.from_json(run.facts)
    index = placement.view.frame if frame is None else frame - 1
    if not 0 <= index < facts.frames:
        detail = f"This run has the frames 1 to {facts.frames}; choose one of them."
        raise Problem(422, "no_such_frame", detail, [("frame", "out of range")])
    return Fusion(
        uid=uid,
        sha256=run.sha256,
        facts=facts,
        frame=index,
        camera=placement.camera,
        map_sha256=placement.finished.sha256,
        chamber=placement.finished.chamber,
        shift_mm=placement.shift_mm(index),
        site=placement.view.site,
        tip_uv=placement.tip_uv(index),
        covariances_mm2=_covariances(placement.triangulation, snapshot.mapping),
        electrodes_uv=placement.electrodes_uv(index),
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
