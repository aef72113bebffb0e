"""Hands stored inputs to a stage, which itself reads no store.

A result is kept under the hash of plugin, version, parameters and exactly what the stage reads, so that a correction
redoes only what hangs on it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from fluoromap import matching as study_matching
from fluoromap.catheters import Catalogue
from fluoromap.contracts import (
    Chain,
    Context,
    ElectrodePoint,
    LocatedSite,
    MatchedSite,
    Matching,
    MonoplaneView,
    Refusal,
    Run,
    Segmentation,
    Triangulation,
    View,
)
from fluoromap.fuser.mapped_sites import map_origin, mapped_sites
from fluoromap.matching import SiteRuns, match_study
from fluoromap.reasons import Reason
from fluoromap.registry import build_fuser, build_monoplane, build_segmenter, build_triangulator
from fluoromap_service.dicom import InstanceFacts, open_frames
from fluoromap_service.jobs.job_life import Claim
from fluoromap_service.jobs.stage_results import MapResult, SiteTracks, ViewTrack, load, stage_of, stages_of
from fluoromap_service.store import files
from fluoromap_service.store.codec import encode
from fluoromap_service.store.models import Base, StageRow
from fluoromap_service.study.snapshot import CorrectedElectrode, PluginSnapshot, Snapshot
from fluoromap_workers.point_rows import point_rows

NAME_DOUBTS = frozenset({Reason.IDENTITY_BY_MOTION, Reason.IDENTITY_UNCERTAIN})


@dataclass(frozen=True, slots=True)
class Work:
    """A stage ready to run: the key of its result and its kind, how to compute it, and the rows that belong to it."""

    key: str
    kind: type[Any]
    compute: Callable[[Context], Any]
    rows: Callable[[Any], Iterable[Base]] | None = None


def prepare(session: Session, held: Claim, snapshot: Snapshot) -> Work:
    """Gather the inputs of a claimed stage."""
    if held.name == "segment":
        return _segment(snapshot, held.subject)
    if held.name == "match":
        return _match(snapshot, {row.subject: row for row in stages_of(session, held.job_id, "segment")})
    match = stage_of(session, held.job_id, "match")
    assert match is not None, "every job has one"
    if held.name == "triangulate":
        return _triangulate(held.job_id, snapshot, match)
    triangulate = stage_of(session, held.job_id, "triangulate")
    assert triangulate is not None, "every job has one"
    triangulation = load(Triangulation, triangulate)
    if held.name == "fuse":
        return _fuse(snapshot, triangulation)
    return _monoplane(snapshot, held.subject, load(Matching, match), triangulation)


def _segment(snapshot: Snapshot, uid: str) -> Work:
    plan, catalogue = snapshot.runs[uid], snapshot.catalogue()
    facts = InstanceFacts.from_json(plan.facts)
    px_per_mm = plan.gantry.camera().px_per_mm
    corrections = {frame - 1: _chains(electrodes) for frame, electrodes in plan.corrections.items()}
    key = _key(
        "segment", snapshot.segmenter, plan.sha256, facts.frame_times_ms, asdict(facts.pixels), facts.r_wave_frames,
        px_per_mm, asdict(catalogue), plan.model_dump(include={"corrections"}),
    )  # fmt: skip

    def compute(context: Context) -> Segmentation:
        frames = open_frames(files.path_of(plan.sha256), facts)
        run = Run(frames, np.array(facts.frame_times_ms), px_per_mm, facts.pixels, facts.r_wave_frames)
        segmenter = build_segmenter(snapshot.segmenter.name, snapshot.segmenter.params)
        return segmenter.segment(run, catalogue, corrections, context)

    return Work(key, Segmentation, compute)


def _chains(electrodes: tuple[CorrectedElectrode, ...]) -> tuple[Chain, ...]:
    """Return the chains that a person set in one frame, one a catheter."""
    chains = []
    for catheter in sorted({electrode.catheter for electrode in electrodes}):
        own = sorted((each for each in electrodes if each.catheter == catheter), key=lambda each: each.electrode)
        chains.append(
            Chain(
                electrodes=tuple(each.electrode for each in own),
                pixels_uv=np.array([[each.u_px, each.v_px] for each in own]),
                covariance_px2=np.array([np.eye(2) * each.sd_px**2 for each in own]),
                scores=np.zeros(len(own)),
                kinds=((catheter, 1.0),),
                manual=True,
            )
        )
    return tuple(chains)


def _match(snapshot: Snapshot, segments: Mapping[str, StageRow]) -> Work:
    catalogue = snapshot.catalogue()
    cameras = {uid: snapshot.runs[uid].gantry.camera() for uid in segments}
    own = PluginSnapshot(name="fluoromap", version=study_matching.VERSION, params={})
    views = [(site.site, uid) for site in snapshot.sites for uid in (site.view_a, site.view_b)]
    # A stored result is named by its hash: what it says need not be read to tell whether it changed.
    key = _key(
        "match", own, asdict(catalogue), *([s, encode(cameras[uid]).decode(), segments[uid].result] for s, uid in views)
    )

    def compute(context: Context) -> Matching:
        seen = {uid: load(Segmentation, row) if row.result else None for uid, row in segments.items()}
        sites = tuple(
            SiteRuns(site.site, cameras[site.view_a], cameras[site.view_b], seen[site.view_a], seen[site.view_b])
            for site in snapshot.sites
        )
        return match_study(sites, catalogue, context)

    return Work(key, Matching, compute)


def _triangulate(job_id: str, snapshot: Snapshot, match: StageRow) -> Work:
    catalogue = snapshot.catalogue()

    def compute(context: Context) -> Triangulation:
        matching = load(Matching, match)
        triangulator = build_triangulator(snapshot.triangulator.name, snapshot.triangulator.params)
        located = triangulator.triangulate(matching.sites, catalogue, context)
        return replace(located, rejected=(*matching.rejected, *located.rejected))

    def rows(located: Triangulation) -> Iterable[Base]:
        return point_rows(job_id, snapshot, load(Matching, match), located)

    return Work(
        _key("triangulate", snapshot.triangulator, asdict(catalogue), match.result), Triangulation, compute, rows
    )


def _fuse(snapshot: Snapshot, triangulation: Triangulation) -> Work:
    catalogue = snapshot.catalogue()
    times = {site.site: (site.lat_ms, site.lat_sd_ms) for site in snapshot.sites}
    sites = mapped_sites(triangulation, catalogue, times)
    origin = map_origin(triangulation)

    def compute(context: Context) -> MapResult:
        fuser = build_fuser(snapshot.fuser.name, snapshot.fuser.params)
        try:
            return MapResult(fuser.fuse(sites, context), None, "", origin)
        except Refusal as refusal:
            return MapResult(None, refusal.reason, str(refusal), origin)

    key = _key("fuse", snapshot.fuser, list(origin or ()), *(encode(site) for site in sites))
    return Work(key, MapResult, compute)


def _monoplane(snapshot: Snapshot, name: str, matching: Matching, triangulation: Triangulation) -> Work:
    catalogue = snapshot.catalogue()
    matched = next((site for site in matching.sites if site.site == name), None)
    located = next((site for site in triangulation.sites if site.site == name), None)
    views: list[tuple[View, MonoplaneView]] = []
    if matched is not None and located is not None:
        others = () if located.cycle else tuple(site.cycle for site in triangulation.sites if site.cycle)
        views = [(view, _monoplane_view(view, matched, located, catalogue, others)) for view in snapshot.views]
    refused = [] if views else [_rejected_view(view, name, triangulation) for view in snapshot.views]
    key = _key("monoplane", snapshot.monoplane, name, encode(refused), *(encode(view) for _, view in views))

    def compute(context: Context) -> SiteTracks:
        followed = list(refused)
        for view, seen in views:
            solver = build_monoplane(snapshot.monoplane.name, snapshot.monoplane.params)
            try:
                followed.append(ViewTrack(view, solver.track(seen, context), None, ""))
            except Refusal as refusal:
                followed.append(ViewTrack(view, None, refusal.reason, str(refusal)))
        return SiteTracks(name, tuple(followed))

    return Work(key, SiteTracks, compute)


def _monoplane_view(
    view: View, matched: MatchedSite, located: LocatedSite, catalogue: Catalogue, others: tuple[Any, ...]
) -> MonoplaneView:
    first = view == "a"
    return MonoplaneView(
        site=matched.site,
        view=view,
        camera=located.camera_a if first else located.camera_b,
        catalogue=catalogue,
        frame_times_ms=matched.frame_times_a_ms if first else matched.frame_times_b_ms,
        observations=matched.track_a if first else matched.track_b,
        a_priori=tuple(_without_name_doubts(point) for point in located.points),
        a_priori_frame=located.frame_a if first else located.frame_b,
        cycle=located.cycle,
        others=others,
    )


def _without_name_doubts(point: ElectrodePoint) -> ElectrodePoint:
    """How sure a name is does not move an electrode: naming a catheter at one site must not redo the others."""
    return replace(point, reasons=tuple(reason for reason in point.reasons if reason not in NAME_DOUBTS))


def _rejected_view(view: View, name: str, triangulation: Triangulation) -> ViewTrack:
    reasons = next((site.reasons for site in triangulation.rejected if site.site == name), ())
    sentences = " ".join(reason.sentence for reason in reasons)
    return ViewTrack(view, None, Reason.NO_A_PRIORI, f"{Reason.NO_A_PRIORI.sentence} {sentences}".strip())


def _key(stage: str, plan: PluginSnapshot, *inputs: Any) -> str:
    digest = hashlib.sha256()
    for item in (stage, plan.name, plan.version, plan.params, *inputs):
        content = item if isinstance(item, bytes) else json.dumps(item, sort_keys=True, allow_nan=False).encode()
        digest.update(len(content).to_bytes(8, "big"))
        digest.update(content)
    return digest.hexdigest()
