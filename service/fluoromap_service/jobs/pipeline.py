"""The one table of stages. Everything that names a stage reads it here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

from fluoromap import matching
from fluoromap.contracts import Matching, Segmentation, Triangulation
from fluoromap.registry import Kind, plugin
from fluoromap_service.jobs.stage_results import MapResult, SiteTracks
from fluoromap_service.study.snapshot import PluginSnapshot, Snapshot

StageName = Literal["segment", "match", "triangulate", "fuse", "monoplane"]
Subject = Literal["run", "study", "site"]


@dataclass(frozen=True, slots=True)
class Stage:
    """One row of the pipeline.

    Parameters
    ----------
    name : str
        Name in the API and in the database.
    kind : str or None
        Kind of plugin that computes it; None for the project's own matching.
    subject : "run", "study" or "site"
        A job has one such stage for each subject of this kind.
    depends_on : tuple of str
        Stages that must have ended before this one may begin.
    result : type
        The dataclass that the stage stores.
    title : str
        What a progress bar calls it.
    fails : "job" or "subject"
        Whether its failure fails the whole job, or only the run or site that it is about. When all stages of a row fail
        that others depend on, the job fails too.
    """

    name: StageName
    kind: Kind | None
    subject: Subject
    depends_on: tuple[StageName, ...]
    result: type[Any]
    title: str
    fails: Literal["job", "subject"]


PIPELINE = (
    Stage("segment", "segmenter", "run", (), Segmentation, "find electrodes", "subject"),
    Stage("match", None, "study", ("segment",), Matching, "name catheters", "job"),
    Stage("triangulate", "triangulator", "study", ("match",), Triangulation, "locate in 3D", "job"),
    Stage("fuse", "fuser", "study", ("triangulate",), MapResult, "make the map", "job"),
    Stage("monoplane", "monoplane", "site", ("triangulate",), SiteTracks, "track one view", "subject"),
)
"""All stages. A stage comes after those it depends on; the map comes before the tracks, because people wait for it."""

STAGES: dict[str, Stage] = {stage.name: stage for stage in PIPELINE}
assert set(STAGES) == set(get_args(StageName))


def plugin_of(stage: Stage, snapshot: Snapshot) -> PluginSnapshot:
    """Return the plugin that computes a stage of a job, with its version and parameters."""
    if stage.kind is None:
        return PluginSnapshot(name="fluoromap", version=matching.VERSION, params={})
    frozen: PluginSnapshot = getattr(snapshot, stage.kind)
    return frozen


def installed_version(stage: Stage, name: str) -> str | None:
    """Return the version of a stage's plugin that this process would run.

    Raises
    ------
    UnknownPlugin
        When it is not installed, or does not load.
    """
    return matching.VERSION if stage.kind is None else plugin(stage.kind, name).version


def subjects_of(stage: Stage, snapshot: Snapshot) -> list[str]:
    """Return the subjects of a stage, one for each of its rows.

    A subject is a run, a site or the study. They come in the order in which their stages begin. Runs with corrections
    come first: after a correction only they are computed again, and everything waits for them.
    """
    if stage.subject == "run":
        used = {uid for site in snapshot.sites for uid in (site.view_a, site.view_b)}
        return sorted(used, key=lambda uid: (not snapshot.runs[uid].corrections, uid))
    if stage.subject == "site":
        return [site.site for site in snapshot.sites]
    return [snapshot.study]


def after(name: StageName) -> frozenset[StageName]:
    """Return the stages that depend on a stage, directly or through others."""
    found: set[StageName] = set()
    for stage in PIPELINE:
        if name in stage.depends_on or found & set(stage.depends_on):
            found.add(stage.name)
    return frozenset(found)
