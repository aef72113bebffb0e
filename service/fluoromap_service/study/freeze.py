"""Freeze a study into the input of a job."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from sqlalchemy.orm import Session

from fluoromap.registry import DEFAULTS, Kind, UnknownPlugin, plugin
from fluoromap_service.dicom.facts import InstanceFacts, Point
from fluoromap_service.problem import Problem
from fluoromap_service.store.models import Study
from fluoromap_service.study import corrections
from fluoromap_service.study.binding import BoundSite, binding_of
from fluoromap_service.study.catheters import catheters_of
from fluoromap_service.study.instances import StudyRun, runs_of
from fluoromap_service.study.snapshot import (
    CorrectedElectrode,
    PluginSnapshot,
    RejectedSiteSnapshot,
    RunSnapshot,
    SiteSnapshot,
    Snapshot,
)
from fluoromap_service.study.studies import lock
from fluoromap_service.study.table_offsets import table_offsets_mm

LAT_SD_MS = 2.0
"""Standard deviation of an activation time whose source gives none: about the difference of two readers."""


class StageRequest(BaseModel):
    """The plugin for one stage."""

    model_config = ConfigDict(extra="forbid")
    name: str | None = Field(None, description="Name as in /v1/plugins; by default the default plugin.")
    params: dict[str, Any] = Field(default_factory=dict, description="Its parameters; each has a default.")


class PipelineRequest(BaseModel):
    """The plugins of a job; every stage has a default plugin."""

    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"examples": [{"fuser": {"name": "convex-hull", "params": {}}}]}
    )
    segmenter: StageRequest = StageRequest()
    triangulator: StageRequest = StageRequest()
    monoplane: StageRequest = StageRequest()
    fuser: StageRequest = StageRequest()


# A typed member for each kind of plugin, so that clients see them; the registry knows the kinds.
assert tuple(PipelineRequest.model_fields) == tuple(DEFAULTS)


def freeze(
    session: Session, study: Study, pipeline: PipelineRequest, view: Literal["a", "b", "both"] = "both"
) -> Snapshot:
    """Freeze everything that a job reads.

    It needs a writing transaction, so that nothing changes meanwhile.

    Raises
    ------
    Problem
        422 ``unknown_plugin`` or ``invalid_parameter`` with the field; ``no_ready_site`` with the needs of each site;
        ``rows_unmatched`` when rows of the table have no runs although runs without a site are there.
    """
    plugins = _plugin_snapshots(pipeline)
    study = lock(session, study.id)
    study_runs = runs_of(session, study.id)
    binding = binding_of(session, study.id, runs=study_runs)
    unmatched = [
        site for site in binding.sites if site.view_a is None and site.view_b is None and site.lat_ms is not None
    ]
    if unmatched and binding.pairs:
        raise _rows_unmatched(unmatched, binding.pairs)
    ready = [site for site in binding.sites if site.ready]
    if not ready:
        raise _no_ready_site((*binding.sites, *binding.pairs))
    runs = {run.uid: run for run in study_runs}
    by_hand = corrections.of_study(session, study.id)
    used = sorted({uid for site in ready for uid in (site.view_a, site.view_b) if uid is not None})
    offsets = table_offsets_mm(runs[uid].facts for uid in used)
    return Snapshot(
        study=study.id,
        catheters=catheters_of(study),
        reference=study.reference,
        mapping=study.mapping,
        **plugins,
        view=view,
        runs={uid: _run_snapshot(runs[uid], by_hand.get(uid, {}), offsets.get(uid)) for uid in used},
        sites=tuple(_site_snapshot(site) for site in ready),
        rejected=tuple(
            RejectedSiteSnapshot(
                site=site.site, lat_ms=site.lat_ms, view_a=site.view_a, view_b=site.view_b, reasons=site.reasons
            )
            for site in binding.sites
            if site.site is not None and not site.ready
        ),
    )


def check_pipeline(pipeline: PipelineRequest) -> None:
    """Check that the plugins of a pipeline exist and accept their parameters.

    Raises
    ------
    Problem
        422 ``unknown_plugin`` or ``invalid_parameter``.
    """
    _plugin_snapshots(pipeline)


def _plugin_snapshots(pipeline: PipelineRequest) -> dict[Any, PluginSnapshot]:
    chosen: dict[Any, PluginSnapshot] = {}
    errors: list[tuple[str, str]] = []
    for kind, default in DEFAULTS.items():
        asked: StageRequest = getattr(pipeline, kind)
        snapshot = _plugin_snapshot(kind, asked.name or default, asked.params, errors)
        if snapshot is not None:
            chosen[kind] = snapshot
    if errors:
        raise Problem(
            422,
            "invalid_parameter",
            "Some parameters of the pipeline are wrong; /v1/plugins lists the parameters of each plugin.",
            errors,
        )
    return chosen


def _plugin_snapshot(
    kind: Kind, name: str, params: dict[str, Any], errors: list[tuple[str, str]]
) -> PluginSnapshot | None:
    try:
        found = plugin(kind, name)
    except UnknownPlugin as error:
        raise Problem(
            422, "unknown_plugin", "There is no such plugin; /v1/plugins lists all plugins.",
            [(f"pipeline.{kind}.name", str(error))],
        ) from None  # fmt: skip
    assert found.stage is not None
    assert found.version is not None
    try:
        checked: BaseModel = found.stage.Params.model_validate(params)
    except ValidationError as error:
        for item in error.errors():
            where = ".".join(["pipeline", kind, "params", *(str(part) for part in item["loc"])])
            errors.append((where, item["msg"]))
        return None
    return PluginSnapshot(name=name, version=found.version, params=checked.model_dump(mode="json"))


def _no_ready_site(bound: Sequence[BoundSite]) -> Problem:
    rows = [
        {
            "site": site.site,
            "pair": site.pair,
            "missing": list(site.missing),
            "reasons": [str(reason) for reason in site.reasons],
        }
        for site in bound
    ]
    errors = [
        (_place(site), ", ".join([*site.missing, *([site.unusable.sentence] if site.unusable else [])]))
        for site in bound
    ]
    detail = (
        "No site is ready: a site needs an activation time and two runs with known geometry, 20 degrees or more apart."
        if bound
        else "The study has no site yet; send its runs and its activation times first."
    )
    if any(item.startswith("gantry:") for site in bound for item in site.missing):
        detail += (
            " Positions in millimetres need measured spacing, distances and angles; complete them by PATCH. Until then "
            "GET .../instances/{uid}/frames/{n}/preview shows the electrodes at a scale that is found from the catheters."
        )
    return Problem(422, "no_ready_site", detail, errors, extra={"sites": rows})


def _rows_unmatched(unmatched: Sequence[BoundSite], pairs: Sequence[BoundSite]) -> Problem:
    detail = (
        f"{len(unmatched)} sites have an activation time but no run, and {len(pairs)} pairs of runs have no site. Say which "
        "runs belong to which site: add the columns view_a and view_b to the table, or set the site of each run."
    )
    errors = [(_place(site), "has an activation time and no run") for site in unmatched]
    errors += [(_place(pair), "has two runs and no site") for pair in pairs]
    return Problem(422, "rows_unmatched", detail, errors)


def _place(site: BoundSite) -> str:
    return f"pairs.{site.pair}" if site.site is None else f"sites.{site.site}"


def _run_snapshot(
    run: StudyRun, by_hand: dict[int, tuple[CorrectedElectrode, ...]], table_offset_mm: Point | None
) -> RunSnapshot:
    gantry = run.geometry
    assert gantry is not None, "a ready site's runs have their geometry"
    if table_offset_mm is not None:
        gantry = gantry.model_copy(update={"table_offset_mm": table_offset_mm})
    return RunSnapshot(sha256=run.sha256, facts=_facts_json(run.facts), gantry=gantry, corrections=by_hand)


@functools.lru_cache(maxsize=2048)
def _facts_json(facts: InstanceFacts) -> dict[str, Any]:
    """Return the facts of a run as JSON values.

    Each job of a study holds those of all its runs.
    """
    return facts.to_json()


def _site_snapshot(site: BoundSite) -> SiteSnapshot:
    assert site.site is not None
    assert site.lat_ms is not None
    assert site.bound_by is not None
    assert site.view_a is not None
    assert site.view_b is not None
    sd = LAT_SD_MS if site.lat_sd_ms is None else site.lat_sd_ms
    return SiteSnapshot(
        site=site.site,
        lat_ms=site.lat_ms,
        lat_sd_ms=sd,
        view_a=site.view_a,
        view_b=site.view_b,
        bound_by=site.bound_by,
        doubts=site.doubts,
    )
