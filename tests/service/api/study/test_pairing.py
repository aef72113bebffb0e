"""Which runs belong to which site, by every rule; and when a site is ready for a job."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from small_runs import edited, run_uid, small_run

from fluoromap.geometry import camera_from_gantry
from fluoromap.reasons import Reason
from fluoromap_service.problem import Problem
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.study import studies
from fluoromap_service.study.binding import site_of
from fluoromap_service.study.freeze import PipelineRequest, freeze
from fluoromap_service.study.snapshot import Snapshot

Upload = Callable[..., Any]
LAT, PA = -90.0, 0.0


@pytest.fixture
def site_list(service: TestClient, study_path: str) -> Callable[[], dict[str, Any]]:
    def ask() -> dict[str, Any]:
        answer = service.get(f"{study_path}/sites")
        assert answer.status_code == 200
        return {site["site"] or f"pair {site['pair']}": site for site in answer.json()["items"]}

    return ask


def _views(site: dict[str, Any]) -> tuple[Any, Any, Any]:
    return site["view_a"], site["view_b"], site["bound_by"]


def _csv(service: TestClient, study_path: str, text: str) -> Any:
    return service.put(f"{study_path}/activation-times", content=text, headers={"Content-Type": "text/csv"})


def test_neighbours_in_time_are_pairs_without_a_name(
    service: TestClient, study_path: str, upload: Upload, site_list: Any
) -> None:
    upload((4, PA), (2, PA), (1, LAT), (3, LAT))
    assert {name: _views(site) for name, site in site_list().items()} == {
        "pair 1": (run_uid(1), run_uid(2), "time"),
        "pair 2": (run_uid(3), run_uid(4), "time"),
    }
    assert {(site["site"], *site["missing"]) for site in site_list().values()} == {(None, "site", "lat_ms")}
    upload((0, LAT), (5, LAT))
    assert _views(site_list()["pair 1"]) == (run_uid(1), run_uid(2), "time")
    assert len(site_list()) == 2
    late = service.get(f"{study_path}/instances/{run_uid(5)}").json()
    assert late["site"] is late["view"] is None
    assert "unbound" in late["warnings"]


def test_runs_that_arrive_one_by_one_in_any_order_pair_by_acquisition(upload: Upload, site_list: Any) -> None:
    for number, angle in ((1, LAT), (4, PA), (3, LAT), (2, PA)):
        upload((number, angle))
    found = site_list()
    assert {_views(site)[:2] for site in found.values()} == {(run_uid(1), run_uid(2)), (run_uid(3), run_uid(4))}
    assert set(found) == {"pair 1", "pair 2"}


def _times(tmp_path: Path, number: int, angle: float, **times: str | None) -> bytes:
    """Return a run without any time but these."""
    stated = dict.fromkeys(
        (
            "AcquisitionDateTime",
            "AcquisitionDate",
            "AcquisitionTime",
            "ContentDate",
            "ContentTime",
            "SeriesDate",
            "SeriesTime",
        )
    )
    return edited(small_run(tmp_path, number, angle), TimezoneOffsetFromUTC=None, **stated | times)


def test_a_date_alone_does_not_count_as_midnight(
    service: TestClient, study_path: str, tmp_path: Path, site_list: Any
) -> None:
    for number, angle, time in ((1, 90.0, "100000"), (4, 0.0, "101100"), (3, 90.0, "101000"), (2, 0.0, "100100")):
        content = _times(
            tmp_path, number, angle, AcquisitionDateTime="20240105", AcquisitionDate="20240105", AcquisitionTime=time
        )
        answer = service.post(f"{study_path}/instances", content=content, headers={"Content-Type": "application/dicom"})
        assert answer.status_code == 201
    found = site_list().values()
    assert [_views(site)[:2] for site in found] == [(run_uid(1), run_uid(2)), (run_uid(3), run_uid(4))]
    assert [site["warnings"] for site in found] == [[], []]


def test_the_list_tells_that_the_order_is_unknown(
    service: TestClient, study_path: str, tmp_path: Path, site_list: Any
) -> None:
    for number, angle in ((1, 90.0), (2, 0.0), (3, 90.0), (4, 0.0)):
        content = _times(
            tmp_path, number, angle, AcquisitionDate="20240105", SeriesDate="20240105", SeriesTime="101112"
        )
        service.post(f"{study_path}/instances", content=content, headers={"Content-Type": "application/dicom"})
    assert {name: site["warnings"] for name, site in site_list().items()} == {
        "pair 1": ["order_unknown"],
        "pair 2": ["order_unknown"],
    }
    assert service.get(f"{study_path}/instances/{run_uid(1)}").json()["warnings"] == ["order_unknown"]
    service.put(f"{study_path}/sites/A", json={"view_a": run_uid(1), "view_b": run_uid(2)})
    assert [site["warnings"] for site in site_list().values()] == [[], []]


def test_view_a_is_nearer_to_lateral(upload: Upload, site_list: Any) -> None:
    upload((1, 10.0), (2, 70.0))
    assert _views(site_list()["pair 1"])[:2] == (run_uid(2), run_uid(1))


def test_a_third_run_stays_unbound_and_the_shorter_gap_wins(
    service: TestClient, study_path: str, tmp_path: Path, site_list: Any
) -> None:
    for number, angle, seconds in ((1, LAT, 0), (2, PA, 20), (3, PA, 40), (4, LAT, 300), (5, PA, 320)):
        content = small_run(tmp_path, number, angle, seconds=seconds)
        service.post(f"{study_path}/instances", content=content, headers={"Content-Type": "application/dicom"})
    assert [_views(site)[:2] for site in site_list().values()] == [(run_uid(1), run_uid(2)), (run_uid(4), run_uid(5))]


def test_views_less_than_30_degrees_apart_are_not_paired_by_time(upload: Upload, site_list: Any) -> None:
    upload((1, 0.0), (2, 25.0), (3, 178.0))
    assert site_list() == {}


def test_the_site_given_at_upload_binds(upload: Upload, site_list: Any) -> None:
    upload((1, LAT), (4, PA), site="apex")
    upload((2, PA), (3, LAT))
    assert _views(site_list()["apex"]) == (run_uid(1), run_uid(4), "upload")
    assert _views(site_list()["pair 1"]) == (run_uid(3), run_uid(2), "time")


def test_the_table_binds_by_uid_series_number_and_file_name(
    service: TestClient, study_path: str, upload: Upload, site_list: Any
) -> None:
    table = f"site,lat_ms,view_a,view_b\nA,1,{run_uid(4)},2\nB,2,run1.dcm,run3.dcm\nC,3,nowhere.dcm,\n"
    assert _csv(service, study_path, table).json() == {"sites": 3, "unmatched": ["A", "B", "C"]}
    upload((1, LAT), (2, PA), (3, PA), (4, LAT), site="elsewhere")
    found = site_list()
    assert _views(found["A"]) == (run_uid(4), run_uid(2), "csv")
    assert _views(found["B"]) == (run_uid(1), run_uid(3), "csv")
    assert _csv(service, study_path, table).json()["unmatched"] == ["C"]


@pytest.mark.parametrize("table_first", [True, False])
def test_row_order_binds_when_the_counts_agree(
    service: TestClient, study_path: str, upload: Upload, site_list: Any, table_first: bool
) -> None:
    table = "site,lat_ms\nzeta,10\nalpha,20\n"
    if table_first:
        assert _csv(service, study_path, table).json() == {"sites": 2, "unmatched": ["zeta", "alpha"]}
    upload((3, LAT), (4, PA), (1, LAT), (2, PA))
    if not table_first:
        assert len(site_list()) == 2
        assert _csv(service, study_path, table).json() == {"sites": 2, "unmatched": []}
    found = site_list()
    assert list(found) == ["zeta", "alpha"]
    assert _views(found["zeta"]) == (run_uid(1), run_uid(2), "order")
    assert _views(found["alpha"]) == (run_uid(3), run_uid(4), "order")
    assert found["zeta"]["missing"] == []
    answer = _csv(service, study_path, table + "third,30\n")
    assert answer.json()["unmatched"] == ["zeta", "alpha", "third"]


@pytest.mark.parametrize("table_first", [True, False])
def test_a_name_that_looks_invented_matches_no_row(
    service: TestClient, study_path: str, upload: Upload, site_list: Any, table_first: bool
) -> None:
    """Files that arrive in another order than they were acquired, then a table with names like S01."""
    table = "site,lat_ms\nS01,10\nS02,20\nS03,30\n"
    if table_first:
        _csv(service, study_path, table)
    for number, angle in ((6, PA), (3, LAT), (1, LAT), (4, PA), (5, LAT), (2, PA)):
        upload((number, angle))
    if not table_first:
        assert {site["site"] for site in site_list().values()} == {None}
        _csv(service, study_path, table)
    found = site_list()
    for row, name in enumerate(("S01", "S02", "S03")):
        assert _views(found[name]) == (run_uid(2 * row + 1), run_uid(2 * row + 2), "order")
        assert found[name]["warnings"] == ["paired_by_order"]


def test_put_confirms_a_guess_and_leaves_the_others_as_they_are(
    service: TestClient, study_path: str, upload: Upload, site_list: Any
) -> None:
    upload((1, LAT), (2, PA), (3, LAT), (4, PA))
    _csv(service, study_path, "site,lat_ms\nalpha,10\nbeta,20\n")
    job = service.post(f"{study_path}/jobs", json={}).json()
    assert job["warnings"] == ["paired_by_order"]
    confirmed = service.put(f"{study_path}/sites/alpha", json={}).json()
    assert (*_views(confirmed), confirmed["warnings"]) == (run_uid(1), run_uid(2), "explicit", [])
    assert _views(site_list()["beta"]) == (run_uid(3), run_uid(4), "order")
    assert service.get(f"/v1/jobs/{job['id']}").json()["warnings"] == ["paired_by_order"]
    views = {"view_a": run_uid(3), "view_b": run_uid(4)}
    assert service.put(f"{study_path}/sites/beta", json=views).json()["bound_by"] == "explicit"
    assert service.get(f"/v1/jobs/{job['id']}").json()["warnings"] == []


def test_other_runs_in_a_put_end_the_guess(
    service: TestClient, study_path: str, upload: Upload, site_list: Any
) -> None:
    upload((1, LAT), (2, PA), (3, LAT), (4, PA))
    _csv(service, study_path, "site,lat_ms\nalpha,10\nbeta,20\n")
    service.put(f"{study_path}/sites/alpha", json={"view_a": run_uid(3), "view_b": run_uid(4)})
    found = site_list()
    assert _views(found["alpha"]) == (run_uid(3), run_uid(4), "explicit")
    assert _views(found["beta"]) == (None, None, None)
    answer = service.post(f"{study_path}/jobs", json={})
    assert (answer.status_code, answer.json()["code"]) == (422, "rows_unmatched")
    assert [place["where"] for place in answer.json()["errors"]] == ["sites.beta", "pairs.1"]


def test_put_comes_before_every_other_rule(
    service: TestClient, study_path: str, upload: Upload, site_list: Any
) -> None:
    upload((1, LAT), (2, PA), site="upload")
    upload((3, LAT), (4, PA))
    put = {"lat_ms": 12.5, "view_a": run_uid(4), "view_b": run_uid(1)}
    answer = service.put(f"{study_path}/sites/mine", json=put)
    assert answer.status_code == 200
    assert (answer.json()["lat_ms"], *_views(answer.json())) == (12.5, run_uid(4), run_uid(1), "explicit")
    assert _views(site_list()["upload"]) == (None, run_uid(2), "upload")
    moved = service.put(f"{study_path}/sites/second", json={"view_b": run_uid(1)}).json()
    assert (moved["view_b"], moved["missing"]) == (run_uid(1), ["lat_ms", "view_a"])
    assert site_list()["mine"]["missing"] == ["view_b"]


def test_patch_moves_a_run_and_takes_it_out_again(
    service: TestClient, study_path: str, upload: Upload, site_list: Any
) -> None:
    upload((1, LAT), (2, PA))
    path = f"{study_path}/instances/{run_uid(1)}"
    moved = service.patch(path, json={"site": "moved"}).json()
    assert (moved["site"], moved["view"]) == ("moved", "a")
    assert _views(site_list()["moved"]) == (run_uid(1), None, "explicit")
    service.patch(path, json={"site": None})
    assert [_views(site) for site in site_list().values()] == [(run_uid(1), run_uid(2), "time")]


@pytest.mark.parametrize(
    "body", [{"view_a": "1.2.3"}, {"view_a": "SAME", "view_b": "SAME"}, {"lat": 3}, {"lat_ms": "x"}]
)
def test_a_binding_that_cannot_be(service: TestClient, study_path: str, upload: Upload, body: dict[str, Any]) -> None:
    upload((1, LAT))
    body = {key: run_uid(1) if value == "SAME" else value for key, value in body.items()}
    answer = service.put(f"{study_path}/sites/X", json=body)
    assert answer.status_code == 422
    assert answer.json()["errors"]
    assert service.get(f"{study_path}/sites/X").status_code == 404


def _reasons(study_path: str, site: str) -> tuple[Reason, ...]:
    with reading() as session:
        return site_of(session, studies.get(session, study_path.rsplit("/", 1)[1]), site).reasons


def test_what_makes_a_site_unusable(service: TestClient, study_path: str, upload: Upload, tmp_path: Path) -> None:
    upload((1, LAT), (2, PA), (3, 10.0), (4, 25.0))
    incomplete = edited(
        small_run(tmp_path, 5, LAT), DistanceSourceToPatient=None, EstimatedRadiographicMagnificationFactor=None
    )
    service.post(f"{study_path}/instances", content=incomplete, headers={"Content-Type": "application/dicom"})

    def put(site: str, **body: Any) -> Any:
        return service.put(f"{study_path}/sites/{site}", json=body).json()

    assert put("good", lat_ms=1, view_a=run_uid(1), view_b=run_uid(2))["missing"] == []
    assert put("parallel", lat_ms=1, view_a=run_uid(3), view_b=run_uid(4))["warnings"] == ["views_parallel"]
    assert put("blind", lat_ms=1, view_a=run_uid(5))["missing"] == ["view_b", "gantry:view_a"]
    assert put("timeless")["missing"] == ["lat_ms", "view_a", "view_b"]
    assert _reasons(study_path, "good") == ()
    assert _reasons(study_path, "parallel") == (Reason.VIEWS_PARALLEL,)
    assert _reasons(study_path, "blind") == (Reason.ONE_VIEW_ONLY, Reason.NO_GEOMETRY)
    patched = service.patch(f"{study_path}/instances/{run_uid(5)}", json={"gantry": {"source_isocentre_mm": 750}})
    assert patched.json()["missing"] == []
    assert _reasons(study_path, "blind") == (Reason.ONE_VIEW_ONLY,)

    with writing() as session:
        study = studies.get(session, study_path.rsplit("/", 1)[1])
        snapshot = freeze(session, study, PipelineRequest())
    assert [site.site for site in snapshot.sites] == ["good"]
    assert set(snapshot.runs) == {run_uid(1), run_uid(2)}
    assert {site.site: site.reasons for site in snapshot.rejected} == {
        "parallel": (Reason.VIEWS_PARALLEL,),
        "blind": (Reason.ONE_VIEW_ONLY,),
    }
    assert snapshot.runs[run_uid(1)].gantry.camera().rows == 48


def test_runs_that_moved_are_not_taken_as_still(
    service: TestClient, study_path: str, upload: Upload, tmp_path: Path
) -> None:
    upload((1, LAT), (2, PA))
    turned = edited(
        small_run(tmp_path, 3, LAT), PositionerMotion="DYNAMIC", PositionerPrimaryAngleIncrement=["0", "2", "4"]
    )
    panned = edited(small_run(tmp_path, 4, PA), TableMotion="DYNAMIC", TableLateralIncrement=["0", "3", "6"])
    for file in (turned, panned):
        service.post(f"{study_path}/instances", content=file, headers={"Content-Type": "application/dicom"})
    for site, view_a, view_b in (("turned", 3, 2), ("panned", 1, 4)):
        body = {"lat_ms": 1, "view_a": run_uid(view_a), "view_b": run_uid(view_b)}
        assert service.put(f"{study_path}/sites/{site}", json=body).status_code in (200, 201)
    sites = {site["site"]: site for site in service.get(f"{study_path}/sites").json()["items"]}
    assert (sites["turned"]["ready"], sites["turned"]["warnings"]) == (False, ["gantry_turned"])
    assert (sites["panned"]["ready"], sites["panned"]["warnings"]) == (True, ["table_moved"])
    assert _reasons(study_path, "turned") == (Reason.GANTRY_TURNED,)
    with writing() as session:
        snapshot = freeze(session, studies.get(session, study_path.rsplit("/", 1)[1]), PipelineRequest())
    assert {site.site: site.reasons for site in snapshot.rejected} == {"turned": (Reason.GANTRY_TURNED,)}
    assert {site.site: site.doubts for site in snapshot.sites} == {"panned": (Reason.TABLE_MOVED,)}


def test_a_pair_between_20_and_30_degrees_is_computed(service: TestClient, study_path: str, upload: Upload) -> None:
    upload((1, 0.0), (2, 25.0))
    body = {"lat_ms": 1, "view_a": run_uid(1), "view_b": run_uid(2)}
    assert service.put(f"{study_path}/sites/X", json=body).json()["warnings"] == []
    assert _reasons(study_path, "X") == ()


def _table(lateral: float, longitudinal: float, vertical: float) -> dict[str, float]:
    return {
        "TableTopLateralPosition": lateral,
        "TableTopLongitudinalPosition": longitudinal,
        "TableTopVerticalPosition": vertical,
    }


def _frozen(study_path: str) -> Snapshot:
    with writing() as session:
        return freeze(session, studies.get(session, study_path.rsplit("/", 1)[1]), PipelineRequest())


def _send(service: TestClient, study_path: str, *contents: bytes) -> None:
    for content in contents:
        answer = service.post(f"{study_path}/instances", content=content, headers={"Content-Type": "application/dicom"})
        assert answer.status_code == 201, answer.text


def test_runs_with_a_moved_table_are_paired_in_the_frame_of_the_first_run(
    service: TestClient, study_path: str, tmp_path: Path, site_list: Any
) -> None:
    still = edited(small_run(tmp_path, 1, LAT), **_table(1, 2, 3))
    moved = edited(small_run(tmp_path, 2, PA), **_table(31, 12, -2))
    _send(service, study_path, moved, still)
    assert _views(site_list()["pair 1"]) == (run_uid(1), run_uid(2), "time")
    put = service.put(f"{study_path}/sites/X", json={"lat_ms": 1, "view_a": run_uid(1), "view_b": run_uid(2)}).json()
    assert put["warnings"] == []
    runs = _frozen(study_path).runs
    first, second = (runs[run_uid(number)].gantry for number in (1, 2))
    assert (first.table_offset_mm, second.table_offset_mm) == ((0, 0, 0), (10, -5, 30))
    # A point of the patient that the table carried along.
    point = np.array([4.0, -7.0, 11.0])
    np.testing.assert_allclose(first.camera().project(point), camera_from_gantry(first.position()).project(point))
    np.testing.assert_allclose(
        second.camera().project(point), camera_from_gantry(second.position()).project(point + np.array([10, -5, 30]))
    )
    assert second.px_per_mm == camera_from_gantry(second.position()).px_per_mm


def test_a_table_position_that_only_one_run_states_is_a_doubt(
    service: TestClient, study_path: str, tmp_path: Path
) -> None:
    _send(service, study_path, edited(small_run(tmp_path, 1, LAT), **_table(1, 2, 3)), small_run(tmp_path, 2, PA))
    put = service.put(f"{study_path}/sites/X", json={"lat_ms": 1, "view_a": run_uid(1), "view_b": run_uid(2)}).json()
    assert (put["missing"], put["warnings"]) == ([], ["table_moved"])
    assert _reasons(study_path, "X") == ()
    snapshot = _frozen(study_path)
    assert snapshot.site("X").doubts == (Reason.TABLE_MOVED,)
    assert {run.gantry.table_offset_mm for run in snapshot.runs.values()} == {(0, 0, 0)}


def test_no_ready_site_lists_what_each_misses(service: TestClient, study_path: str, upload: Upload) -> None:
    empty = service.post(f"{study_path}/jobs", json={})
    assert (empty.status_code, empty.json()["code"]) == (422, "no_ready_site")
    upload((1, LAT), (2, PA))
    answer = service.post(f"{study_path}/jobs", json={})
    assert (answer.status_code, answer.json()["code"]) == (422, "no_ready_site")
    assert answer.json()["sites"] == [
        {"site": None, "pair": 1, "missing": ["site", "lat_ms"], "reasons": ["no_activation_time"]}
    ]
    assert service.get("/v1/jobs").json()["items"] == []


@pytest.mark.parametrize(
    ("pipeline", "code", "where"),
    [
        ({"segmenter": {"name": "deep-magic"}}, "unknown_plugin", "pipeline.segmenter.name"),
        (
            {"fuser": {"name": "convex-hull", "params": {"fill_mm": -4}}},
            "invalid_parameter",
            "pipeline.fuser.params.fill_mm",
        ),
        (
            {"fuser": {"name": "convex-hull", "params": {"fil_mm": 4}}},
            "invalid_parameter",
            "pipeline.fuser.params.fil_mm",
        ),
        ({"fusor": {}}, "invalid", "body.pipeline.fusor"),
    ],
)
def test_a_wrong_pipeline_names_the_field(
    service: TestClient, study_path: str, pipeline: dict[str, Any], code: str, where: str
) -> None:
    answer = service.post(f"{study_path}/jobs", json={"pipeline": pipeline})
    assert (answer.status_code, answer.json()["code"]) == (422, code)
    assert [error["where"] for error in answer.json()["errors"]] == [where]


def test_marks_travel_into_the_manifest(service: TestClient, study_path: str, upload: Upload) -> None:
    upload((1, LAT), (2, PA), site="X")
    service.put(f"{study_path}/sites/X", json={"lat_ms": 3})
    electrode = {"catheter": "mapping", "electrode": 1, "u_px": 10.0, "v_px": 20.0}
    service.put(f"{study_path}/instances/{run_uid(1)}/frames/2/electrodes", json=[electrode])
    with writing() as session:
        study = studies.get(session, study_path.rsplit("/", 1)[1])
        snapshot = freeze(session, study, PipelineRequest(), "a")
    assert snapshot.views == ("a",)
    (correction,) = snapshot.runs[run_uid(1)].corrections[2]
    assert (correction.catheter, correction.u_px, correction.sd_px) == ("mapping", 10.0, 1.0)
    with pytest.raises(Problem, match="no such study"), writing() as session:
        studies.lock(session, "nothing")
