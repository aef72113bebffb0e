"""The tracks of a job's sites through one view, and the views without a track."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from sqlalchemy.orm import Session

from fluoromap.contracts import LocatedSite, Track, Triangulation, View
from fluoromap.fuser.mapped_sites import map_origin
from fluoromap.monoplane.track_samples import (
    FrameOrigins,
    Sample,
    in_study,
    isocentre_origins,
    reference_origins,
    track_samples,
)
from fluoromap.reasons import Reason
from fluoromap_service.jobs.stage_results import SiteTracks, load, load_once, stages_of
from fluoromap_service.problem import not_found
from fluoromap_service.results.finished import done_stage, snapshot_of, stage_not_ready
from fluoromap_service.results.origins import Origin, origin_in
from fluoromap_service.store.models import Job, StageRow, StageState


@dataclass(frozen=True, eq=False)
class ElectrodeSamples:
    """One electrode in every frame of one view; ``solver`` is the name of the monoplane plugin."""

    site: str
    view: View
    catheter: str
    electrode: int
    solver: str
    samples: Iterator[Sample]


@dataclass(frozen=True, slots=True)
class RejectedView:
    """A view without a track; ``message`` says why in a sentence."""

    site: str
    view: View
    reasons: tuple[Reason, ...]
    message: str


Found = ElectrodeSamples | RejectedView


def tracks_of(
    session: Session,
    job: Job,
    origin: Origin,
    site: str | None = None,
    view: View | None = None,
    tip_of: str | None = None,
) -> Iterator[Found]:
    """Return the tracks of one site or of all, site by site.

    With ``tip_of``, the name of a catheter, only the tracks of its tip.

    Raises
    ------
    Problem
        404 for a site that the job does not have; 409 ``not_ready`` while the track of one of the sites is not done.
    """
    snapshot = snapshot_of(job)
    names = {entry.site for entry in snapshot.sites} | {entry.site for entry in snapshot.rejected}
    if site is not None and site not in names:
        raise not_found("site in this job")
    triangulation = load(Triangulation, done_stage(session, job, "triangulate"))
    views = [entry for entry in snapshot.views if view in (None, entry)]
    origins = _OriginOfTracks(origin_in(job, origin), snapshot.reference, map_origin(triangulation))
    for stage in stages_of(session, job.id, "monoplane"):
        if site in (None, stage.subject):
            yield from _site(job, stage, views, triangulation, origins, tip_of)
    for entry in snapshot.rejected:
        if site in (None, entry.site):
            message = " ".join(reason.sentence for reason in entry.reasons)
            yield from (RejectedView(entry.site, each, entry.reasons, message) for each in views)


@dataclass(frozen=True, slots=True)
class _OriginOfTracks:
    """The origin of the answer, the reference catheter, and its mean over the sites in mm from the isocentre."""

    origin: Origin
    catheter: str | None
    mean_mm: tuple[float, float, float] | None

    def frames(self, track: Track, site: LocatedSite) -> FrameOrigins:
        """Return the origin in each frame of a track."""
        if self.origin is Origin.ISOCENTRE:
            return isocentre_origins(len(track.located))
        mean_mm = None if self.mean_mm is None else np.array(self.mean_mm)
        return reference_origins(track, site, self.catheter, mean_mm)


def _site(
    job: Job, stage: StageRow, views: Sequence[View], triangulation: Triangulation, origin: _OriginOfTracks,
    tip_of: str | None,
) -> Iterator[Found]:  # fmt: skip
    if stage.state == StageState.FAILED:
        message = str((stage.error or {}).get("detail", Reason.PLUGIN_FAILED.sentence))
        yield from (RejectedView(stage.subject, view, (Reason.PLUGIN_FAILED,), message) for view in views)
        return
    if stage.state != StageState.DONE:
        raise stage_not_ready(job, "monoplane", stage)
    site = next((entry for entry in triangulation.sites if entry.site == stage.subject), None)
    site_reasons = next((entry.reasons for entry in triangulation.rejected if entry.site == stage.subject), ())
    for result in load_once(SiteTracks, stage).views:
        if result.view not in views:
            continue
        if result.track is None or site is None:
            reasons = (result.refused, *site_reasons) if result.refused else site_reasons
            yield RejectedView(stage.subject, result.view, tuple(dict.fromkeys(reasons)), result.message)
            continue
        camera = site.camera(result.view)
        track = in_study(result.track, camera, origin.catheter, site.variation)
        frames = origin.frames(track, site)
        for index, (catheter, electrode) in enumerate(track.labels):
            if tip_of is not None and (catheter, electrode) != (tip_of, 1):
                continue
            reference = None if origin.origin is Origin.ISOCENTRE else origin.catheter
            samples = track_samples(track, index, camera, frames, site.reasons_of(catheter, electrode, reference))
            yield ElectrodeSamples(stage.subject, result.view, catheter, electrode, stage.plugin, samples)
