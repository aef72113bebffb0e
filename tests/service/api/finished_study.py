"""A small study whose stages end one by one, with results written down by hand."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from fluoromap.contracts import (
    ChamberMap,
    ElectrodePoint,
    LocatedSite,
    MatchedRuns,
    MatchedSite,
    Matching,
    NamedChain,
    Observation,
    PhasePair,
    RejectedSite,
    SurfaceSite,
    Track,
    Triangulation,
)
from fluoromap.geometry import Camera, Gantry, camera_from_gantry
from fluoromap.reasons import Reason
from fluoromap_service.dicom import InstanceFacts, deterministic_uid, read_instance, write_cine
from fluoromap_service.jobs import job_life
from fluoromap_service.jobs.stage_results import MapResult, SiteTracks, ViewTrack
from fluoromap_service.store import files
from fluoromap_service.store.codec import encode
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Instance, Job, Json, StageRow, Study, StudyInstance
from fluoromap_service.study.catheters import StudyCatheter
from fluoromap_service.study.snapshot import (
    GantrySnapshot,
    PluginSnapshot,
    RejectedSiteSnapshot,
    RunSnapshot,
    SiteSnapshot,
    Snapshot,
)

SIZE = 96
FRAMES = 3
GANTRIES = {
    "a": Gantry(90.0, 0.0, 1000.0, 700.0, (1.2, 1.2), SIZE, SIZE),
    "b": Gantry(0.0, 0.0, 1000.0, 700.0, (1.2, 1.2), SIZE, SIZE),
}
REFERENCE_MM = np.array([5.0, -4.0, 3.0])
STEP_MM = np.array([1.0, 0.0, 0.0])
TIP_MM = np.array([12.0, 6.0, 9.0])
BREATH_MM = {"a": np.array([0.0, 0.0, 3.0]), "b": np.array([0.0, 0.0, -3.0])}
"""How much higher the heart lies in each run than where two views locate it."""
REFERENCE_ELECTRODES_MM = REFERENCE_MM + np.array([[0.0, 0.0, -2.0], [0.0, 0.0, 2.0]])
DIASTOLE = 1
"""Index of the diastolic frame in every run."""
TIP_PIXEL = {"a": (70.0, 20.0), "b": (25.0, 30.0)}
COVARIANCE_A = np.diag([4.0, 0.01, 0.01])
"""Of view a's track: the ray of a lateral view is the patient's left-right axis."""
RELATIVE_COVARIANCE_A = np.diag([0.49, 0.01, 0.01])
"""The same less the reference of the same frame, by solvers that state it."""


@dataclass(frozen=True)
class _Segmented:
    """The result of a segment stage that no route reads; it differs from run to run."""

    uid: str


@dataclass
class FinishedStudy:
    """``S01`` is located and followed, ``S02`` could not be located, ``S03`` was not ready when the job was made."""

    study_id: str
    job_id: str
    uids: dict[tuple[str, str], str]

    def stage(self, name: str, subject: str | None = None) -> int:
        with reading() as session:
            query = select(StageRow.id).where(StageRow.job_id == self.job_id, StageRow.name == name)
            stage_id = session.scalar(query if subject is None else query.where(StageRow.subject == subject))
        assert stage_id is not None
        return stage_id

    @contextmanager
    def claimed(self, name: str, subject: str | None = None) -> Iterator[tuple[Session, job_life.Claim]]:
        stage_id = self.stage(name, subject)
        with writing() as session:
            held = job_life.claim(session, stage_id, "tester")
            assert held is not None
            yield session, held

    def end(self, name: str, subject: str | None, result: Any, points: list[Json] | None = None) -> None:
        with self.claimed(name, subject) as (session, held):
            sha256 = files.keep_bytes(session, encode(result))
            stored = job_life.StoredResult(sha256, tuple(points or ()))
            assert job_life.finish(session, held, stored, reused=False)

    def fail(self, name: str, subject: str | None = None, code: str = "plugin_failed") -> None:
        error = {"code": code, "detail": f"The stage {name!r} failed: it broke."}
        with self.claimed(name, subject) as (session, held):
            assert job_life.fail(session, held, error)

    def segmented(self) -> None:
        for uid in self.uids.values():
            self.end("segment", uid, _Segmented(uid))

    def matched(self) -> None:
        self.segmented()
        self.end("match", None, matching())

    def triangulated(self) -> None:
        self.matched()
        self.end("triangulate", None, triangulation(), self._points())

    def mapped(self, outcome: MapResult | None = None) -> None:
        self.triangulated()
        self.end("fuse", None, outcome or map_result())

    def followed(self, relative: bool = False) -> None:
        self.end("monoplane", "S01", followed_site(relative))
        refused = ViewTrack("a", None, Reason.NO_A_PRIORI, Reason.NO_A_PRIORI.sentence)
        self.end("monoplane", "S02", SiteTracks("S02", (refused,)))

    def finish(self, outcome: MapResult | None = None) -> None:
        """End all stages."""
        self.mapped(outcome)
        self.followed()

    def _points(self) -> list[Json]:
        located = {
            "job_id": self.job_id,
            "site": "S01",
            "catheter": "mapping",
            "electrode": 1,
            "position_mm": TIP_MM.tolist(),
            "covariance_mm2": [2.0, 0.0, 0.0, 2.0, 0.0, 2.0],
            "relative_mm": (TIP_MM - REFERENCE_MM).tolist(),
            "relative_covariance_mm2": [0.1, 0.01, 0.0, 0.1, 0.0, 0.1],
            "view_a": self.uids["S01", "a"],
            "view_b": self.uids["S01", "b"],
            "frame_a": DIASTOLE + 1,
            "frame_b": DIASTOLE + 1,
            "residual_a_px": 0.25,
            "residual_b_px": 0.5,
            "ray_angle_deg": 90.0,
            "lat_ms": 41.0,
            "grade": "C",
            "relative_grade": "A",
            "reasons": ["identity_by_motion"],
        }
        rejected = {
            "job_id": self.job_id, "site": "S03", "catheter": "mapping", "electrode": 1, "lat_ms": None, "grade": "rejected",
            "relative_grade": "rejected", "reasons": ["one_view_only", "no_activation_time"],
        }  # fmt: skip
        return [located, rejected]


def make_study() -> FinishedStudy:
    """Store two sites' runs, and a job.

    The runs are DICOM files, and the job's first stages are ready.
    """
    uids = {(site, view): deterministic_uid("output", site, view) for site in ("S01", "S02") for view in ("a", "b")}
    with writing() as session:
        study = Study(
            id="0" * 32, label="rhythm", catheters=[], reference="reference", mapping="mapping",
        )  # fmt: skip
        session.add(study)
        session.flush()
        runs = {uid: _stored_run(session, uid, view) for (_, view), uid in uids.items()}
        session.flush()
        session.add_all(StudyInstance(study_id=study.id, sop_instance_uid=uid) for uid in runs)
        plugin = PluginSnapshot(name="by-hand", version="1", params={})
        snapshot = Snapshot(
            study=study.id,
            catheters=tuple(
                StudyCatheter(name=name, electrodes=2, spacing_mm=(4.0,), tip_mm=2.0, ring_mm=1.0)
                for name in ("reference", "mapping")
            ),
            reference="reference",
            mapping="mapping",
            segmenter=plugin,
            triangulator=plugin,
            monoplane=plugin,
            fuser=plugin,
            view="a",
            runs=runs,
            sites=tuple(
                SiteSnapshot(site=site, lat_ms=41.0, lat_sd_ms=2.0, view_a=uids[site, "a"], view_b=uids[site, "b"])
                for site in ("S01", "S02")
            ),
            rejected=(
                RejectedSiteSnapshot(
                    site="S03", lat_ms=None, view_a=None, view_b=None,
                    reasons=(Reason.ONE_VIEW_ONLY, Reason.NO_ACTIVATION_TIME),
                ),
            ),
        )  # fmt: skip
        job = job_life.create(session, study.id, snapshot)
        return FinishedStudy(study.id, job.id, uids)


def edit_runs(made: FinishedStudy, edit: Callable[[bytes], bytes]) -> None:
    """Replace the files of all runs, in the store and in the job."""
    with writing() as session:
        job = session.get_one(Job, made.job_id)
        snapshot = {**job.snapshot, "runs": dict(job.snapshot["runs"])}
        for instance in session.query(Instance):
            instance.sha256 = files.keep_bytes(session, edit(files.read(instance.sha256)))
            uid = instance.sop_instance_uid
            snapshot["runs"][uid] = {**snapshot["runs"][uid], "sha256": instance.sha256}
        job.snapshot = snapshot


@functools.cache
def _cine(uid: str, view: str) -> tuple[bytes, InstanceFacts]:
    ramp = np.tile(np.linspace(200, 3000, SIZE, dtype=np.uint16), (SIZE, 1))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.dcm"
        write_cine(
            path,
            [ramp + 10 * frame for frame in range(FRAMES)],
            frame_count=FRAMES,
            gantry=GANTRIES[view],
            frame_time_ms=16.7,
            acquired=datetime(2026, 3, 1, 9, 30, tzinfo=UTC),
            study_instance_uid=deterministic_uid("study"),
            series_number=1,
            sop_instance_uid=uid,
        )
        return path.read_bytes(), read_instance(path)


def _stored_run(session: Session, uid: str, view: str) -> RunSnapshot:
    gantry = GANTRIES[view]
    content, facts = _cine(uid, view)
    sha256 = files.keep_bytes(session, content)
    session.add(
        Instance(
            sop_instance_uid=uid, sha256=sha256, study_instance_uid=facts.study_instance_uid,
            series_instance_uid=facts.series_instance_uid, facts=facts.to_json(),
        )
    )  # fmt: skip
    plan = GantrySnapshot(
        primary_deg=gantry.primary_deg, secondary_deg=gantry.secondary_deg, source_detector_mm=1000.0,
        source_isocentre_mm=700.0, pixel_spacing_mm=gantry.pixel_spacing_mm, rows=SIZE, columns=SIZE,
        image_axes=gantry.image_axes,
    )  # fmt: skip
    return RunSnapshot(sha256=sha256, facts=facts.to_json(), gantry=plan, corrections={})


def camera(view: str) -> Camera:
    return camera_from_gantry(GANTRIES[view])


def _observation(view: str, frame: int) -> Observation:
    chains: tuple[NamedChain, ...] = ()
    if frame != 2:
        reference = camera(view).project(REFERENCE_ELECTRODES_MM + BREATH_MM[view])
        chains = (
            NamedChain("mapping", (1,), np.array([TIP_PIXEL[view]]), np.eye(2)[None]),
            NamedChain("reference", (1, 2), reference, np.tile(np.eye(2), (2, 1, 1))),
        )
    return Observation(frame, None, chains)


def matching() -> Matching:
    times = np.arange(FRAMES, dtype=np.float64)
    runs = MatchedRuns(
        camera_a=camera("a"),
        camera_b=camera("b"),
        diastole=PhasePair(None, _observation("a", DIASTOLE), _observation("b", DIASTOLE)),
        cycle=(),
        track_a=tuple(_observation("a", frame) for frame in range(FRAMES)),
        track_b=tuple(_observation("b", frame) for frame in range(FRAMES)),
        frame_times_a_ms=times,
        frame_times_b_ms=times,
    )
    return Matching((MatchedSite("S01", runs),), (RejectedSite("S02", (Reason.PAIRING_FAILED,)),))


def triangulation(reference_mm: Any = REFERENCE_MM) -> Triangulation:
    relative = None if reference_mm is None else TIP_MM - reference_mm
    tip = ElectrodePoint(
        "mapping", 1, TIP_MM, 0.1 * np.eye(3), relative, None if relative is None else 0.1 * np.eye(3), (0.2, 0.3), 90.0
    )  # fmt: skip
    rings = tuple(
        ElectrodePoint("reference", number, at, 0.1 * np.eye(3), at - REFERENCE_MM, 0.1 * np.eye(3), (0.2, 0.3), 90.0)
        for number, at in enumerate(REFERENCE_ELECTRODES_MM, start=1)
    )
    points = (tip,) if reference_mm is None else (tip, *rings)
    site = LocatedSite("S01", camera("a"), camera("b"), DIASTOLE, DIASTOLE, points, reference_mm, None)
    return Triangulation((site,), (RejectedSite("S02", (Reason.PAIRING_FAILED,)),))


def followed_site(relative: bool = False) -> SiteTracks:
    """Return the tracks of reference electrodes 1 and 2 and of the tip.

    The reference moves by 1 mm in frame 1. Frame 3 does not show the reference, frame 2 does not show the tip.
    """
    labels = (("reference", 1), ("reference", 2), ("mapping", 1))
    half = np.array([0.0, 0.0, 2.0])
    positions = np.zeros((FRAMES, 3, 3))
    for frame in range(FRAMES):
        moved = REFERENCE_MM + (STEP_MM if frame == 0 else 0.0)
        positions[frame] = [moved - half, moved + half, TIP_MM + 0.5 * frame * STEP_MM]
    located = np.ones((FRAMES, 3), dtype=bool)
    located[2, :2] = False
    located[1, 2] = False
    track = Track(
        labels=labels,
        located=located,
        positions_mm=positions * located[..., None],
        baseline_mm=(positions + 0.25) * located[..., None],
        covariance_mm2=np.tile(COVARIANCE_A, (FRAMES, 3, 1, 1)),
        pixels_uv=np.full((FRAMES, 3, 2), 40.0),
        reasons=((), (), (Reason.DEPTH_ASSUMED,)),
        relative_covariance_mm2=np.tile(RELATIVE_COVARIANCE_A, (FRAMES, 3, 1, 1)) if relative else None,
    )
    return SiteTracks("S01", (ViewTrack("a", track, None, ""),))


def map_result() -> MapResult:
    """Return an octahedron of 10 mm about the reference.

    One vertex has no time.
    """
    vertices = 10.0 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    covered = np.array([True, True, True, True, True, False])
    tip = TIP_MM - REFERENCE_MM
    chamber = ChamberMap(
        vertices_mm=vertices,
        faces=faces,
        lat_ms=np.array([10.0, 20.0, 30.0, 40.0, 50.0, 0.0]),
        lat_sd_ms=np.where(covered, 2.0, 0.0),
        covered=covered,
        sites=(SurfaceSite("S01", tip, tip - 0.5, 0.9, 41.0, None),),
        earliest=(("S01", 1.0),),
        total_activation_time_ms=40.0,
        leave_one_out_rms_ms=None,
        volume_ml=1.33,
        area_cm2=6.9,
        coverage=0.8,
    )
    x, y, z = REFERENCE_MM.tolist()
    return MapResult(chamber, None, "", (x, y, z))


def no_map() -> MapResult:
    return MapResult(None, Reason.TOO_FEW_SITES, Reason.TOO_FEW_SITES.sentence, None)
