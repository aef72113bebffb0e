"""The electrodes that the newest job detected in the frames of a run."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sqlalchemy import select
from sqlalchemy.orm import Session

from fluoromap.contracts import Chain, Matching, NamedChain, Segmentation
from fluoromap.matching.likely_names import likely_names
from fluoromap_service.jobs.stage_results import load, stage_of
from fluoromap_service.results.finished import job_of, snapshot_of
from fluoromap_service.store.codec import undecoded
from fluoromap_service.store.models import Job, StageRow, StageState


@dataclass(frozen=True, slots=True)
class DetectedElectrode:
    """One electrode in stored pixels; ``catheter`` is None where no catheter of the study fits."""

    catheter: str | None
    electrode: int
    u_px: float
    v_px: float
    sd_px: float


def detected_electrodes(session: Session, study_id: str, uid: str, frame: int) -> list[DetectedElectrode]:
    """Return the electrodes that the newest job with this run detected in a frame (counted from 0)."""
    stage = _newest_segmentation(session, study_id, uid)
    if stage is None:
        return []
    found = load(Segmentation, stage).frames[frame]
    return _electrodes(found.chains, _named_chains(session, stage.job_id, uid).get(frame, ()))


def detections_of_run(session: Session, study_id: str, uid: str) -> list[list[DetectedElectrode]]:
    """Return the electrodes of every frame as the newest job detected them.

    Without such a job the list is empty.
    """
    stage = _newest_segmentation(session, study_id, uid)
    if stage is None:
        return []
    named = _named_chains(session, stage.job_id, uid)
    frames = load(Segmentation, stage).frames
    return [_electrodes(found.chains, named.get(frame, ())) for frame, found in enumerate(frames)]


def _newest_segmentation(session: Session, study_id: str, uid: str) -> StageRow | None:
    return session.scalar(
        select(StageRow)
        .join(Job, Job.id == StageRow.job_id)
        .where(
            Job.study_id == study_id,
            StageRow.name == "segment",
            StageRow.subject == uid,
            StageRow.state == StageState.DONE,
        )
        .order_by(Job.created.desc(), Job.id)
        .limit(1)
    )


def _electrodes(all_chains: tuple[Chain, ...], named: tuple[NamedChain, ...]) -> list[DetectedElectrode]:
    # A person may have deleted the correction after the job: a chain set by hand is no detection.
    chains = tuple(chain for chain in all_chains if not chain.manual)
    of_track = {chain.track: chain for chain in named if chain.track >= 0}
    matched = [of_track.get(chain.track) for chain in chains]
    names = [None if one is None else one.catheter for one in matched]
    found: list[DetectedElectrode] = []
    for chain, one, name in zip(chains, matched, likely_names(chains, names), strict=True):
        # Matching may have found the tip at the other end.
        shown = chain if one is None else one
        for electrode, (u, v), covariance in zip(shown.electrodes, shown.pixels_uv, shown.covariance_px2, strict=True):
            sd = math.sqrt(max(float(covariance.trace()) / 2, 0.0))
            found.append(DetectedElectrode(name, electrode, float(u), float(v), sd))
    return found


def _named_chains(session: Session, job_id: str, uid: str) -> dict[int, tuple[NamedChain, ...]]:
    """Return the named catheters of each frame (counted from 0) of a run."""
    stage = stage_of(session, job_id, "match")
    if stage is None or stage.state != StageState.DONE:
        return {}
    snapshot = snapshot_of(job_of(session, job_id))
    views = {
        site.site: "a" if site.view_a == uid else "b" for site in snapshot.sites if uid in (site.view_a, site.view_b)
    }
    for site in load(Matching, stage).sites:
        if site.site in views:
            # The service remembers the runs, so it would keep the decoded tracks.
            shown = undecoded(site.runs)
            track = shown.track_a if views[site.site] == "a" else shown.track_b
            return {frame: observation.chains for frame, observation in enumerate(track)}
    return {}
