"""Give stored inputs to a stage, which itself reads no store.

There is one function for each row of the pipeline. A result is stored under the hash of plugin, version, parameters and
exactly the inputs that the stage reads, so that a correction repeats only the work that depends on it.
"""

from __future__ import annotations

import functools
import hashlib
import json
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
from sqlalchemy.orm import Session

from fluoromap.catheters import Catalogue
from fluoromap.contracts import (
    APriori,
    Chain,
    ChamberMap,
    Context,
    FrameChains,
    LocatedSite,
    MappedSite,
    Matching,
    Refusal,
    RejectedSite,
    Run,
    Segmentation,
    Track,
    Triangulation,
    View,
)
from fluoromap.fuser.mapped_sites import map_origin, mapped_sites
from fluoromap.geometry import Camera
from fluoromap.matching import SiteRuns, match_study
from fluoromap.reasons import Reason
from fluoromap.registry import build_fuser, build_monoplane, build_segmenter, build_triangulator
from fluoromap_service.dicom import InstanceFacts, open_frames
from fluoromap_service.jobs.job_life import Claim
from fluoromap_service.jobs.pipeline import STAGES, Stage, StageName, installed_version, plugin_of
from fluoromap_service.jobs.stage_results import MapResult, SiteTracks, ViewTrack, load, load_later, stage_of, stages_of
from fluoromap_service.store.codec import form_of, plain_form
from fluoromap_service.store.models import Json, StageRow
from fluoromap_service.study.run_files import checked_run
from fluoromap_service.study.snapshot import CorrectedElectrode, GantrySnapshot, PluginSnapshot, RunSnapshot, Snapshot
from fluoromap_workers.point_rows import point_rows
from fluoromap_workers.tracked_views import TrackedView

Result = TypeVar("Result")


class PluginChanged(Exception):
    """The worker has another version of a plugin than the job was frozen with; a result would carry the wrong version."""


@dataclass(frozen=True, slots=True)
class Work:
    """A stage ready to run.

    Parameters
    ----------
    key : str
        Hash of everything that the result depends on.
    kind : type
        The dataclass of the result.
    compute : callable
        Computes the result.
    refused : callable
        Makes the result that says why the plugin refused.
    points : callable, optional
        Makes the columns of the points that belong to a result.
    plugin : callable
        Returns the hash of the plugin with its version and parameters. All partial results depend on these.
    """

    key: str
    kind: type[Any]
    compute: Callable[[Context], Any]
    refused: Callable[[Refusal], Any]
    points: Callable[[Any], Iterable[Json]] | None = None
    plugin: Callable[[], str] = str


@dataclass(frozen=True, slots=True)
class StoredJob:
    """A job as its stages read it, inside one transaction."""

    session: Session
    job_id: str
    snapshot: Snapshot
    rows: dict[StageName, StageRow] = field(default_factory=dict)
    """Rows that were read. The stages of all sites need the same ones."""

    @property
    def catalogue(self) -> Catalogue:
        return self.snapshot.catalogue

    def stage(self, name: StageName) -> StageRow:
        """Return the job's one stage of that name."""
        if name not in self.rows:
            row = stage_of(self.session, self.job_id, name)
            assert row is not None, "every job has one"
            self.rows[name] = row
        return self.rows[name]


def prepare(job: StoredJob, claim: Claim) -> Work:
    """Gather the inputs of a stage that may begin.

    The stage compares the plugin's version before it computes. A stored result needs no plugin.
    """
    stage, snapshot = STAGES[claim.name], job.snapshot
    work = _PREPARE[stage.name](job, claim.subject)

    def compute(context: Context) -> Any:
        _require_version(stage, snapshot)
        return work.compute(context)

    return replace(work, compute=compute, plugin=partial(_key, snapshot, stage.name))


def _require_version(stage: Stage, snapshot: Snapshot) -> None:
    frozen = plugin_of(stage, snapshot)
    installed = installed_version(stage, frozen.name)
    if installed != frozen.version:
        raise PluginChanged(
            f"The job was made with version {frozen.version} of {frozen.name!r}, and this worker has version {installed}. "
            "Start a new job, or install the same version on every machine."
        )


def _returned(result: Any, expected: type[Result], name: str) -> Result:
    """Return a plugin's result, checked before anything is stored.

    Raises
    ------
    TypeError
        When it is of another type.
    """
    if not isinstance(result, expected):
        raise TypeError(f"{name} returned {type(result).__name__}, expected {expected.__name__}")
    return result


def _segment(job: StoredJob, uid: str) -> Work:
    run, catalogue = job.snapshot.runs[uid], job.catalogue
    px_per_mm = run.gantry.px_per_mm
    marks = {frame - 1: _chains(electrodes) for frame, electrodes in run.corrections.items()}
    plugin = job.snapshot.segmenter

    def compute(context: Context) -> Segmentation:
        facts = InstanceFacts.from_json(run.facts)
        with checked_run(run.sha256, facts) as path:
            shown = Run(
                open_frames(path, facts), np.array(facts.frame_times_ms), px_per_mm, facts.pixels, facts.r_wave_frames,
                run.sha256,
            )  # fmt: skip
            found = build_segmenter(plugin.name, plugin.params).segment(shown, catalogue, marks, context)
        found = _returned(found, Segmentation, plugin.name)
        if len(found.frames) != facts.frames:
            raise ValueError(f"{plugin.name} returned {len(found.frames)} frames, expected {facts.frames}")
        return found

    def refused(refusal: Refusal) -> Segmentation:
        facts = InstanceFacts.from_json(run.facts)
        frames = tuple(FrameChains(frame, (), refusal.reason) for frame in range(facts.frames))
        motion, times_ms = np.zeros(facts.frames), np.array(facts.frame_times_ms)
        return Segmentation(frames, None, (), motion, times_ms, facts.r_wave_frames)

    return Work(_segment_keys.of(job.snapshot, run, catalogue), Segmentation, compute, refused)


class _SegmentKeys:
    """The keys of the stage ``segment`` of the runs that this process compared last, by the hashes of their files.

    After a correction the keys of all runs are compared, and hardly any has changed.
    """

    _REMEMBERED = 1024

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._remembered: OrderedDict[str, tuple[tuple[PluginSnapshot, RunSnapshot, Catalogue], str]] = OrderedDict()

    def of(self, snapshot: Snapshot, run: RunSnapshot, catalogue: Catalogue) -> str:
        """Return the key of a run."""
        inputs = snapshot.segmenter, run, catalogue
        with self._lock:
            known, key = self._remembered.get(run.sha256, (None, ""))
        if known != inputs:
            # The facts count as they are stored, without being decoded.
            shown = [run.facts[name] for name in ("frame_times_ms", "pixels", "r_wave_frames")]
            marked = run.model_dump(include={"corrections"})
            scale = run.gantry.px_per_mm
            key = _key(snapshot, "segment", run.sha256, *shown, scale, _as_json(catalogue), marked)
        with self._lock:
            self._remembered[run.sha256] = inputs, key
            self._remembered.move_to_end(run.sha256)
            while len(self._remembered) > self._REMEMBERED:
                self._remembered.popitem(last=False)
        return key


_segment_keys = _SegmentKeys()


def _chains(electrodes: tuple[CorrectedElectrode, ...]) -> tuple[Chain, ...]:
    """Return the chains that a person set in one frame, one for each catheter."""
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


def _match(job: StoredJob, study: str) -> Work:
    snapshot, catalogue = job.snapshot, job.catalogue
    segments = {row.subject: row for row in stages_of(job.session, job.job_id, "segment")}
    cameras = {uid: _camera(snapshot.runs[uid].gantry) for uid in segments}
    views = [(site.site, uid) for site in snapshot.sites for uid in (site.view_a, site.view_b)]

    def compute(context: Context) -> Matching:
        # Only sites whose comparison is not stored read their segmentations.
        found = {uid: load_later(Segmentation, row) if row.result else None for uid, row in segments.items()}
        sites = tuple(
            SiteRuns(
                site.site, cameras[site.view_a][0], cameras[site.view_b][0], found[site.view_a], found[site.view_b],
            )
            for site in snapshot.sites
        )  # fmt: skip
        return match_study(sites, catalogue, context)

    def refused(refusal: Refusal) -> Matching:
        return Matching((), tuple(RejectedSite(site.site, (refusal.reason,)) for site in snapshot.sites))

    # A result's hash says whether it changed: the result itself is not read for the key.
    results = ((site, cameras[uid][1], segments[uid].result) for site, uid in views)
    key = _key(snapshot, "match", _as_json(catalogue), *(part for view in results for part in view))
    return Work(key, Matching, compute, refused)


@functools.lru_cache(maxsize=2048)
def _camera(gantry: GantrySnapshot) -> tuple[Camera, bytes]:
    """Return the camera of a run, and its part of a key."""
    camera = gantry.camera()
    return camera, plain_form(camera)


def _triangulate(job: StoredJob, study: str) -> Work:
    match, catalogue, plugin = job.stage("match"), job.catalogue, job.snapshot.triangulator
    doubts = {site.site: site.doubts for site in job.snapshot.sites if site.doubts}

    def compute(context: Context) -> Triangulation:
        matching = load(Matching, match)
        located = build_triangulator(plugin.name, plugin.params).triangulate(matching.sites, catalogue, context)
        located = _returned(located, Triangulation, plugin.name)
        sites = tuple(_with_doubts(site, doubts.get(site.site, ())) for site in located.sites)
        return replace(located, sites=sites, rejected=(*matching.rejected, *located.rejected))

    def refused(refusal: Refusal) -> Triangulation:
        matching = load(Matching, match)
        sites = tuple(RejectedSite(site.site, (refusal.reason,)) for site in matching.sites)
        return Triangulation((), (*matching.rejected, *sites), (str(refusal),))

    def points(located: Triangulation) -> Iterable[Json]:
        return point_rows(job.job_id, job.snapshot, load(Matching, match), located)

    key = _key(job.snapshot, "triangulate", _as_json(catalogue), match.result, doubts)
    return Work(key, Triangulation, compute, refused, points)


def _with_doubts(site: LocatedSite, doubts: tuple[Reason, ...]) -> LocatedSite:
    """Return the site with more reasons for doubt.

    A site without new ones is returned unchanged.
    """
    reasons = tuple(dict.fromkeys((*site.reasons, *doubts)))
    return site if reasons == site.reasons else replace(site, reasons=reasons)


@dataclass(frozen=True, slots=True)
class _MappedSites:
    """The sites of a map; one form of all of them is made faster than a form of each."""

    sites: tuple[MappedSite, ...]


def _fuse(job: StoredJob, study: str) -> Work:
    triangulation, plugin = load(Triangulation, job.stage("triangulate")), job.snapshot.fuser
    times = {site.site: (site.lat_ms, site.lat_sd_ms) for site in job.snapshot.sites}
    sites = mapped_sites(triangulation, job.catalogue, times)
    origin = map_origin(triangulation)

    def compute(context: Context) -> MapResult:
        chamber = build_fuser(plugin.name, plugin.params).fuse(sites, context)
        return MapResult(_returned(chamber, ChamberMap, plugin.name), None, "", origin)

    def refused(refusal: Refusal) -> MapResult:
        return MapResult(None, refusal.reason, str(refusal), origin)

    key = _key(job.snapshot, "fuse", list(origin or ()), plain_form(_MappedSites(sites)))
    return Work(key, MapResult, compute, refused)


def _monoplane(job: StoredJob, name: str) -> Work:
    matching, triangulation = load(Matching, job.stage("match")), load(Triangulation, job.stage("triangulate"))
    plugin = job.snapshot.monoplane
    matched = next((site for site in matching.sites if site.site == name), None)
    located = next((site for site in triangulation.sites if site.site == name), None)
    views: list[TrackedView] = []
    if matched is not None and located is not None:
        others = () if located.cycle else tuple(site.cycle for site in triangulation.sites if site.cycle)
        a_priori = APriori(located.points) if located.a_priori is None else located.a_priori
        views = [
            TrackedView(
                matched=matched, view=view, camera=located.camera(view), catalogue=job.catalogue, a_priori=a_priori,
                a_priori_frame=located.diastolic_frame(view), cycle=located.cycle, others=others,
            )
            for view in job.snapshot.views
        ]  # fmt: skip
    rejected = [] if views else [_rejected_view(view, name, triangulation) for view in job.snapshot.views]

    def compute(context: Context) -> SiteTracks:
        tracks = list(rejected)
        for view in views:
            solver = build_monoplane(plugin.name, plugin.params)
            # One view may support a track where the other does not.
            try:
                track = _returned(solver.track(view.decoded(), context), Track, plugin.name)
                tracks.append(ViewTrack(view.view, track, None, ""))
            except Refusal as refusal:
                tracks.append(ViewTrack(view.view, None, refusal.reason, str(refusal)))
        return SiteTracks(name, tuple(tracks))

    def refused(refusal: Refusal) -> SiteTracks:
        return SiteTracks(name, tuple(ViewTrack(view.view, None, refusal.reason, str(refusal)) for view in views))

    key = _key(
        job.snapshot, "monoplane", name, *(plain_form(view) for view in rejected), *(view.content() for view in views)
    )
    return Work(key, SiteTracks, compute, refused)


def _rejected_view(view: View, name: str, triangulation: Triangulation) -> ViewTrack:
    reasons = next((site.reasons for site in triangulation.rejected if site.site == name), ())
    sentences = " ".join(reason.sentence for reason in reasons)
    return ViewTrack(view, None, Reason.NO_A_PRIORI, f"{Reason.NO_A_PRIORI.sentence} {sentences}".strip())


_PREPARE: Mapping[StageName, Callable[[StoredJob, str], Work]] = {
    "segment": _segment,
    "match": _match,
    "triangulate": _triangulate,
    "fuse": _fuse,
    "monoplane": _monoplane,
}


_sorted_json = json.JSONEncoder(sort_keys=True, allow_nan=False).encode


@functools.lru_cache(maxsize=8)
def _as_json(catalogue: Catalogue) -> bytes:
    """Return a catalogue as JSON; the keys of hundreds of runs contain the same one."""
    return _sorted_json(asdict(catalogue)).encode()


def _key(snapshot: Snapshot, name: StageName, *inputs: Any) -> str:
    """Return the hash of a stage's plugin, the form of its result, and its inputs."""
    stage = STAGES[name]
    plugin = plugin_of(stage, snapshot)
    digest = hashlib.sha256()
    for item in (name, plugin.name, plugin.version, plugin.params, form_of(stage.result), *inputs):
        content = item if isinstance(item, bytes) else _sorted_json(item).encode()
        digest.update(len(content).to_bytes(8, "big"))
        digest.update(content)
    return digest.hexdigest()
