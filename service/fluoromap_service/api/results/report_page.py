"""The report of a job: one self-contained page with pictures, a 3D view, tables, plugins and parameters."""

from __future__ import annotations

import base64
import functools
import hashlib
import itertools
import json
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any, get_args

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from sqlalchemy.orm import Session

from fluoromap.contracts import ChamberMap, Triangulation
from fluoromap.drawing.annotations import purpose_text
from fluoromap.drawing.overlay import Look
from fluoromap.registry import Kind
from fluoromap_service.api.http.file_pool import PROCESSES
from fluoromap_service.api.jobs.job_answers import read_job
from fluoromap_service.api.results.maps import activation_map, map_picture_of
from fluoromap_service.api.results.overlays import jpeg_of
from fluoromap_service.api.results.points import Point, points_of
from fluoromap_service.api.results.report_modules import modules_sha256, packed_modules
from fluoromap_service.api.results.report_tables import (
    budget_rows,
    calibration_line,
    electrodes,
    glossary,
    tips,
    tracks,
)
from fluoromap_service.api.results.tracks import read_entries
from fluoromap_service.jobs.stage_results import load, stage_of, stages_of
from fluoromap_service.problem import Problem
from fluoromap_service.results.dependencies import report_dependencies
from fluoromap_service.results.finished import ended_job_of, job_of, snapshot_of
from fluoromap_service.results.fusion import fusion_of
from fluoromap_service.results.maps import FinishedMap, map_of
from fluoromap_service.results.origins import Origin
from fluoromap_service.results.placement import LocatedView, located_views
from fluoromap_service.results.row_order import sites_by_row_order
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Study
from fluoromap_service.store.renderings import KeptFile, kept_file
from fluoromap_service.study.snapshot import SiteSnapshot

WEB = Path(__file__).parents[2] / "web"
TEMPLATE = "report.html.j2"
BINDINGS = {
    "explicit": "set by hand",
    "csv": "named in the table of activation times",
    "upload": "named at the upload",
    "order": "row order: a guess until somebody confirms it",
    "confirmed": "row order, confirmed by a person after the job",
}
"""Rule that bound a site's runs -> its words in the report."""


def report_of(job_id: str) -> KeptFile:
    """Return the kept report of an ended job; make it when there is none.

    Raises
    ------
    Problem
        404 when there is no such job; 409 ``not_ready`` while the job runs.
    """
    with reading() as session:
        job = ended_job_of(session, job_id, "report")
        study = session.get(Study, job.study_id)
        guessed = sites_by_row_order(session, job)
        label = study.label if study else None
        depends_on = report_dependencies(template_sha256(), job_id, job.version, label, guessed)
    return kept_file(job_id, depends_on, lambda file: write_report_page(job_id, file))


def write_report_page(job_id: str, page: IO[bytes]) -> None:
    """Write the page of an ended job into an open file.

    It shows all results that the job has.
    """
    with ThreadPoolExecutor(PROCESSES) as threads:
        # The pool draws while this thread makes the tables.
        pictures = _start_pictures(job_id, threads)
        values = _values(job_id)
        chamber, scene = values.pop("map"), values.pop("scene")
        values |= {"chamber": None, "overlays": [], "map_png": None, "scene": None, "scripts": None, "title": None}
        if chamber is not None and pictures is not None:
            values |= {
                "chamber": _figures(chamber),
                "map_png": _inline(pictures.map.result().path.read_bytes(), "image/png"),
                "overlays": pictures.shown(),
                "scene": scene,
                "scripts": _json(packed_modules()),
                "title": _json(f"{values['label']}: {purpose_text(simulated=values['simulated'])}"),
            }
        # Piece by piece: the page of a large study has tens of MB.
        for piece in _environment().get_template(TEMPLATE).generate(values):
            page.write(piece.encode())


def prepare() -> None:
    """Compile the template and pack the scripts, so that the first report need not wait."""
    _environment().get_template(TEMPLATE)
    packed_modules()


def _values(job_id: str) -> dict[str, Any]:
    with reading() as session:
        job = job_of(session, job_id)
        snapshot = snapshot_of(job)
        finished, no_map = None, ""
        try:
            finished = map_of(session, job)
        except Problem as problem:
            no_map = str(problem.detail)
        triangulated = stage_of(session, job_id, "triangulate")
        triangulation = load(Triangulation, triangulated) if triangulated and triangulated.result else None
        points = points_of(session, job, Origin.REFERENCE) if triangulation else []
        catheters = [catheter.name for catheter in snapshot.catheters]
        chamber = finished.chamber if finished else None
        tracked = triangulation is not None and _all_tracked(session, job_id)
        study = session.get(Study, job.study_id)
        guessed = sites_by_row_order(session, job)
        rows = tips(points, snapshot.mapping, chamber)
        electrode_rows = electrodes(points)
        followed = read_entries(session, job, Origin.REFERENCE, tip_of=snapshot.mapping) if tracked else ()
        track_rows = tracks(followed)
        return {
            "job": read_job(session, job),
            "label": study.label if study else "Mapping study",
            "version": version("fluoromap"),
            "reference": snapshot.reference,
            "map": chamber,
            "scene": _json(_scene(finished, points, catheters)) if finished else None,
            "no_map": no_map,
            "simulated": finished is not None and finished.simulated,
            "tips": rows,
            "located": sum(row["grade"] != "rejected" for row in rows),
            "grades": [(grade, sum(row["grade"] == grade for row in rows)) for grade in ("A", "B", "C", "rejected")],
            "reasons": glossary([*rows, *electrode_rows, *track_rows]),
            "points": electrode_rows,
            "tracks": track_rows,
            "budget": budget_rows(triangulation.budget) if triangulation else [],
            "calibration": calibration_line(triangulation.calibration) if triangulation else None,
            "notes": triangulation.notes if triangulation else (),
            "bindings": [(site.site, BINDINGS[_rule(site, guessed)]) for site in snapshot.sites],
            "guessed": guessed,
            "plugins": [(kind, getattr(snapshot, kind)) for kind in get_args(Kind)],
            "catheters": snapshot.catheters,
            "runs": sorted(snapshot.runs.items()),
        }


def _rule(site: SiteSnapshot, guessed: tuple[str, ...]) -> str:
    return "confirmed" if site.bound_by == "order" and site.site not in guessed else site.bound_by


def _all_tracked(session: Session, job_id: str) -> bool:
    return all(stage.result or stage.error for stage in stages_of(session, job_id, "monoplane"))


def _figures(chamber: ChamberMap) -> dict[str, Any]:
    return {
        "earliest": chamber.earliest[0][0] if chamber.earliest else "–",
        "all_earliest": [entry for entry in chamber.earliest if entry[1] >= 0.005],
        **{
            name: getattr(chamber, name)
            for name in (
                "total_activation_time_ms", "leave_one_out_rms_ms", "conduction_velocity", "volume_ml", "area_cm2",
                "coverage", "warnings",
            )
        },
    }  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Pictures:
    """The pictures of a report while the pool draws them."""

    map: Future[KeptFile]
    overlays: deque[tuple[LocatedView, Future[bytes]]]

    def shown(self) -> Iterable[dict[str, Any]]:
        """Return the pictures one after the other.

        Each is forgotten when the page has it. Without pictures the list is empty.
        """
        pictures = self._drawn()
        first = next(pictures, None)
        return [] if first is None else itertools.chain([first], pictures)

    def _drawn(self) -> Iterator[dict[str, Any]]:
        while self.overlays:
            view, drawn = self.overlays.popleft()
            try:
                source = _inline(drawn.result(), "image/jpeg")
            except Problem:
                # Somebody deleted the run meanwhile: its numbers are still in the tables.
                continue
            yield {"site": view.site, "view": view.view, "frame": view.frame + 1, "src": source}


def _start_pictures(job_id: str, threads: ThreadPoolExecutor) -> _Pictures | None:
    """Let the pool draw the pictures; None without a map."""
    overlays: deque[tuple[LocatedView, Future[bytes]]] = deque()
    try:
        with reading() as session:
            job = job_of(session, job_id)
            map_picture = threads.submit(map_picture_of, job_id, map_of(session, job))
            # The pool draws the first pictures while this thread finds the parts of the others.
            for view in located_views(session, job):
                fusion = fusion_of(session, job, view.uid, None)
                look = Look(covariances_mm2=fusion.covariances_mm2)
                overlays.append((view, threads.submit(jpeg_of, fusion, look)))
    except Problem:
        return None
    return _Pictures(map_picture, overlays)


def _scene(finished: FinishedMap, points: Sequence[Point], catheters: list[str]) -> dict[str, Any]:
    """Return map, electrodes and names of catheters for the 3D view.

    Coordinates have two decimals.
    """
    chamber = activation_map(finished, Origin.REFERENCE).model_dump(mode="json")
    for name in ("vertices_mm", "lat_ms", "lat_sd_ms"):
        chamber[name] = _rounded(chamber[name])
    places = [
        {"site": point.site, "catheter": point.catheter, "electrode": point.electrode}
        | {name: _rounded(getattr(point, name)) for name in ("x_mm", "y_mm", "z_mm")}
        for point in points
    ]
    return {"map": chamber, "points": places, "catheters": catheters}


def _rounded(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_rounded(item) for item in value]
    return None if value is None else round(value, 2)


def _inline(content: bytes, media_type: str) -> Markup:
    """Return a picture as the address of an image; nothing in it needs escaping."""
    return Markup(f"data:{media_type};base64,{base64.b64encode(content).decode()}")


def _json(value: Any) -> Markup:
    """Return JSON for a script element.

    The element would end at the first "</" even inside a text.
    """
    return Markup(json.dumps(value, separators=(",", ":")).replace("<", "\\u003c"))


@functools.cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(WEB), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    environment.filters["number"] = _number
    return environment


@functools.cache
def template_sha256() -> str:
    """Return the hash of the page's template and modules."""
    return hashlib.sha256((WEB / TEMPLATE).read_bytes() + modules_sha256().encode()).hexdigest()


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"
