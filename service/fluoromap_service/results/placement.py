"""The place of the map in the frames of one run: the run's camera, and the shift of the map in each frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from sqlalchemy.orm import Session

from fluoromap.contracts import (
    Array,
    LocatedSite,
    MatchedRuns,
    Matching,
    NamedChain,
    Observation,
    Triangulation,
    View,
)
from fluoromap.drawing.map_placement import map_shift_mm, tip_pixel
from fluoromap.geometry import Camera
from fluoromap.monoplane.track_samples import FrameOrigins, reference_origins
from fluoromap_service.jobs.stage_results import SiteTracks, load, load_file, stage_of
from fluoromap_service.problem import not_found
from fluoromap_service.results.finished import done_stage, snapshot_of
from fluoromap_service.results.maps import FinishedMap, map_of
from fluoromap_service.store.codec import undecoded
from fluoromap_service.store.models import Job, StageState
from fluoromap_service.study.snapshot import Snapshot

VIEWS: tuple[View, ...] = ("a", "b")

_REMEMBERED_VIEWS = 8
"""A person looks at many frames of few runs. The electrodes in all frames of a study take 100 MB."""


@dataclass(frozen=True, slots=True)
class LocatedView:
    """One view of a located site; ``frame`` is the diastolic frame, counted from 0."""

    site: str
    view: View
    uid: str
    frame: int


@dataclass(frozen=True, eq=False)
class MapPlacement:
    """The map in one view of a located site.

    site : of the view, in 3D. matched : its runs with named catheters; None where it has none. tracks_sha256 : hash of the stored
    tracks of the site; None where it has none.
    """

    view: LocatedView
    finished: FinishedMap
    triangulation: Triangulation
    snapshot: Snapshot
    site: LocatedSite
    matched: MatchedRuns | None
    tracks_sha256: str | None

    @property
    def camera(self) -> Camera:
        """Camera of the view, for stored pixels."""
        return self.site.camera(self.view.view)

    def shown(self, frame: int) -> Mapping[str, NamedChain]:
        """Return the electrodes that a frame shows, by their catheter.

        The frame counts from 0. At diastole those of the pair that located the site count.
        """
        if self.matched is None:
            return {}
        diastole = _diastole(self.matched, self.view.view)
        # The track is long, and most overlays show diastole. The pair has each catheter of the track.
        if frame == diastole.frame:
            return {chain.catheter: chain for chain in diastole.chains}
        return _chains(self.matched, self.view.view).get(frame, {})

    def shift_mm(self, frame: int) -> Array:
        """Return the shift (3,) of the map in a frame.

        World = map + shift. The frame counts from 0.
        """
        mean_mm = np.zeros(3) if self.finished.reference_mm is None else self.finished.reference_mm
        reference = self.snapshot.reference
        shown = None if reference is None else self.shown(frame).get(reference)
        return map_shift_mm(self.site, self.camera, shown, self._tracked_mm(frame), mean_mm)

    def tip_uv(self, frame: int) -> Array | None:
        """Return the pixel (2,) of the mapping tip in a frame from 0 on."""
        mapping = self.snapshot.mapping
        shown = self.shown(frame).get(mapping)
        return tip_pixel(self.site, self.camera, mapping, shown, self.shift_mm(frame))

    def electrodes_uv(self, frame: int) -> dict[str, Array]:
        """Return the pixels (k, 2) of each catheter's electrodes.

        They begin at the tip. The frame counts from 0. A catheter that it does not show has none.
        """
        shown = self.shown(frame)
        return {
            catheter.name: shown[catheter.name].pixels_uv[np.argsort(shown[catheter.name].electrodes)]
            if catheter.name in shown
            else np.zeros((0, 2))
            for catheter in self.snapshot.catheters
        }

    def _tracked_mm(self, frame: int) -> Array | None:
        """Return the reference catheter's position (3,) by the track.

        None at diastole, which located the site, and in frames that do not show the catheter.
        """
        # The tracks of a site are long, and most overlays show diastole.
        if frame == self.view.frame:
            return None
        origins = self._origins
        if origins is None or frame >= len(origins.same_frame) or not origins.same_frame[frame]:
            return None
        position: Array = origins.positions_mm[frame]
        return position

    @cached_property
    def _origins(self) -> FrameOrigins | None:
        """Origins by the reference catheter in each frame of this view's track; None without a track."""
        if self.tracks_sha256 is None:
            return None
        views = load_file(SiteTracks, self.tracks_sha256).views
        track = next((each.track for each in views if each.view == self.view.view), None)
        return None if track is None else reference_origins(track, self.site, self.snapshot.reference, None)


def located_views(session: Session, job: Job) -> list[LocatedView]:
    """Return both views of each located site.

    Raises
    ------
    Problem
        409 while there is no map.
    """
    map_of(session, job)
    return _views(load(Triangulation, done_stage(session, job, "triangulate")), snapshot_of(job))


def placement_of(session: Session, job: Job, uid: str) -> MapPlacement:
    """Return the place of the map in the frames of a run.

    Raises
    ------
    Problem
        404 for a run that is not a view of a located site, 409 without a map.
    """
    finished = map_of(session, job)
    snapshot = snapshot_of(job)
    triangulation = load(Triangulation, done_stage(session, job, "triangulate"))
    view = next((each for each in _views(triangulation, snapshot) if each.uid == uid), None)
    if view is None:
        raise not_found("overlay: the run is no view of a located site")
    site = next(each for each in triangulation.sites if each.site == view.site)
    matching = load(Matching, done_stage(session, job, "match"))
    matched = next((each.runs for each in matching.sites if each.site == view.site), None)
    return MapPlacement(
        view=view,
        finished=finished,
        triangulation=triangulation,
        snapshot=snapshot,
        site=site,
        matched=matched,
        tracks_sha256=_tracks_sha256(session, job, site.site),
    )


def _views(triangulation: Triangulation, snapshot: Snapshot) -> list[LocatedView]:
    return [
        LocatedView(site.site, view, snapshot.site(site.site).run(view), site.diastolic_frame(view))
        for site in triangulation.sites
        for view in VIEWS
    ]


@lru_cache(maxsize=_REMEMBERED_VIEWS)
def _diastole(runs: MatchedRuns, view: View) -> Observation:
    """Return the diastolic frame of the pair that located the site."""
    # The service remembers the runs, so it would keep the arrays of all sites.
    pair = undecoded(runs).diastole
    return pair.a if view == "a" else pair.b


@lru_cache(maxsize=_REMEMBERED_VIEWS)
def _chains(runs: MatchedRuns, view: View) -> Mapping[int, Mapping[str, NamedChain]]:
    """Return the catheters that each frame of the track shows, by name."""
    # The service remembers the runs, so it would keep the decoded tracks of all sites.
    runs = undecoded(runs)
    track = runs.track_a if view == "a" else runs.track_b
    return {each.frame: {chain.catheter: chain for chain in each.chains} for each in track}


def _tracks_sha256(session: Session, job: Job, site: str) -> str | None:
    stage = stage_of(session, job.id, "monoplane", site)
    return stage.result if stage is not None and stage.state == StageState.DONE else None
