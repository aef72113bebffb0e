"""The map and its mesh: origins, formats read by others, refusals, tags."""

from __future__ import annotations

import io
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh
from fastapi.testclient import TestClient
from finished_study import REFERENCE_MM, TIP_MM, FinishedStudy, map_result, no_map
from sqlalchemy import select

from fluoromap.contracts import ConductionVelocity
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Rendering


def test_the_map_is_relative_to_the_reference(client: TestClient, study: FinishedStudy) -> None:
    study.mapped()
    answer = client.get(f"/v1/jobs/{study.job_id}/map").json()
    chamber = map_result().chamber
    assert chamber is not None
    assert answer["frame"] == {"axes": "LPS", "origin": "reference", "unit": "mm"}
    np.testing.assert_array_equal(answer["vertices_mm"], chamber.vertices_mm)
    np.testing.assert_array_equal(answer["faces"], chamber.faces)
    assert answer["lat_ms"] == [10.0, 20.0, 30.0, 40.0, 50.0, None]
    assert answer["lat_sd_ms"][5] is None
    assert answer["covered"][4:] == [True, False]
    assert answer["earliest"] == [{"site": "S01", "probability": 1.0}]
    assert answer["sites"][0]["leave_one_out_error_ms"] is None
    assert {"total_activation_time_ms", "leave_one_out_rms_ms", "volume_ml", "area_cm2", "coverage"} <= set(answer)
    assert (answer["conduction_velocity"], answer["cycle_length_ms"]) == (None, None)


def test_the_map_shows_conduction_velocity_and_cycle(client: TestClient, study: FinishedStudy) -> None:
    outcome = map_result()
    assert outcome.chamber is not None
    chamber = replace(outcome.chamber, conduction_velocity=ConductionVelocity(0.8, 0.7, 0.9), cycle_length_ms=240.0)
    study.mapped(replace(outcome, chamber=chamber))
    answer = client.get(f"/v1/jobs/{study.job_id}/map").json()
    assert answer["conduction_velocity"] == {"median_m_per_s": 0.8, "low_m_per_s": 0.7, "high_m_per_s": 0.9}
    assert answer["cycle_length_ms"] == 240.0


def test_the_map_from_the_isocentre_is_shifted_as_a_whole(client: TestClient, study: FinishedStudy) -> None:
    study.mapped()
    relative, absolute = (
        client.get(f"/v1/jobs/{study.job_id}/map?origin={origin}").json() for origin in ("reference", "isocentre")
    )
    np.testing.assert_allclose(np.subtract(absolute["vertices_mm"], relative["vertices_mm"]) - REFERENCE_MM, 0)
    site = absolute["sites"][0]
    np.testing.assert_allclose([site["x_mm"], site["y_mm"], site["z_mm"]], TIP_MM)
    np.testing.assert_allclose(site["surface_mm"], TIP_MM - 0.5)


def test_a_map_without_reference_lies_about_the_isocentre(client: TestClient, study: FinishedStudy) -> None:
    study.mapped(replace(map_result(), reference_mm=None))
    relative, absolute = (
        client.get(f"/v1/jobs/{study.job_id}/map?origin={origin}").json() for origin in ("reference", "isocentre")
    )
    assert relative == absolute
    assert relative["frame"]["origin"] == "isocentre"


@pytest.mark.parametrize("what", ["map", "mesh.ply", "overlays"])
def test_no_map_says_why(client: TestClient, study: FinishedStudy, what: str) -> None:
    study.mapped(no_map())
    answer = client.get(f"/v1/jobs/{study.job_id}/{what}")
    assert (answer.status_code, answer.json()["code"]) == (409, "no_map")
    assert "Fewer than four sites" in answer.json()["detail"]


@pytest.mark.parametrize("what", ["map", "mesh.stl", "overlays"])
def test_the_map_is_not_ready_before_fusing(client: TestClient, study: FinishedStudy, what: str) -> None:
    study.triangulated()
    answer = client.get(f"/v1/jobs/{study.job_id}/{what}")
    assert (answer.status_code, answer.json()["code"]) == (409, "not_ready")


def test_the_map_is_ready_before_the_views_are_followed(client: TestClient, study: FinishedStudy) -> None:
    study.mapped()
    assert client.get(f"/v1/jobs/{study.job_id}").json()["state"] == "running"
    assert client.get(f"/v1/jobs/{study.job_id}/map").status_code == 200


def test_the_maps_tag(client: TestClient, study: FinishedStudy) -> None:
    study.mapped()
    path = f"/v1/jobs/{study.job_id}/map"
    etag = client.get(path).headers["etag"]
    assert client.get(path, headers={"If-None-Match": etag}).status_code == 304
    assert client.get(f"{path}?origin=isocentre", headers={"If-None-Match": etag}).status_code == 200


@pytest.mark.parametrize("file_type", ["ply", "stl", "glb"])
@pytest.mark.parametrize(("origin", "shift"), [("reference", np.zeros(3)), ("isocentre", REFERENCE_MM)])
def test_meshes_are_read_by_others(
    client: TestClient, study: FinishedStudy, file_type: str, origin: str, shift: np.ndarray
) -> None:
    study.mapped()
    answer = client.get(f"/v1/jobs/{study.job_id}/mesh.{file_type}?origin={origin}")
    assert answer.status_code == 200
    assert answer.headers["content-disposition"] == f'attachment; filename="chamber-{origin}.{file_type}"'
    mesh = trimesh.load(io.BytesIO(answer.content), file_type=file_type, force="mesh")
    assert mesh.is_watertight
    if file_type == "glb":
        # glTF: metres, +Y up (head), +Z forward (front).
        left, head, front = 1e3 * mesh.vertices.T
        mesh.vertices = np.stack([left, -front, head], axis=1)
    np.testing.assert_allclose(mesh.bounds, [shift - 10, shift + 10], atol=1e-5)
    assert mesh.volume == pytest.approx(4 / 3 * 10**3, rel=1e-5)


def test_the_vtp_mesh_has_the_times(client: TestClient, study: FinishedStudy) -> None:
    study.mapped()
    answer = client.get(f"/v1/jobs/{study.job_id}/mesh.vtp")
    root = ElementTree.fromstring(answer.content)
    assert root.attrib["type"] == "PolyData"
    assert {"lat_ms", "lat_sd_ms"} <= {array.get("Name") for array in root.iter("DataArray")}
    piece = root.find("PolyData/Piece")
    assert piece is not None
    assert (piece.get("NumberOfPoints"), piece.get("NumberOfPolys")) == ("6", "8")


def test_meshes_are_made_once(client: TestClient, study: FinishedStudy) -> None:
    study.mapped()
    path = f"/v1/jobs/{study.job_id}/mesh.ply"
    first, second = client.get(path), client.get(path)
    assert first.content == second.content
    assert client.get(path, headers={"If-None-Match": first.headers["etag"]}).status_code == 304
    with reading() as session:
        assert len(session.scalars(select(Rendering)).all()) == 1


def test_an_unknown_mesh_format(client: TestClient, study: FinishedStudy) -> None:
    assert client.get(f"/v1/jobs/{study.job_id}/mesh.obj").status_code == 422
