"""Names that arrive composed and decomposed are one name at every door."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from urllib.parse import quote

from fastapi.testclient import TestClient
from small_runs import run_uid, small_run

COMPOSED, DECOMPOSED = "M\u00fcller", "Mu\u0308ller"


def _sites(service: TestClient, study_path: str) -> dict[str, Any]:
    return {site["site"]: site for site in service.get(f"{study_path}/sites").json()["items"]}


def test_a_site_is_the_same_in_table_path_and_form(service: TestClient, study_path: str, tmp_path: Path) -> None:
    table = f"site,lat_ms\n{DECOMPOSED},1.5\n"
    put = service.put(f"{study_path}/activation-times", content=table.encode(), headers={"Content-Type": "text/csv"})
    assert put.status_code == 200
    for number, (site, query) in enumerate([(DECOMPOSED, False), (DECOMPOSED, True)]):
        files = {"file": ("run.dcm", small_run(tmp_path, number, 90.0 * number), "application/dicom")}
        sent: dict[str, Any] = {"params": {"site": site}} if query else {"data": {"site": site}}
        assert service.post(f"{study_path}/instances", files=files, **sent).status_code == 201
    for name in (COMPOSED, DECOMPOSED):
        path = f"{study_path}/sites/{quote(name)}"
        assert service.get(path).json()["site"] == COMPOSED
    moved = service.patch(f"{study_path}/instances/{run_uid(0)}", json={"site": DECOMPOSED})
    assert moved.json()["site"] == COMPOSED
    assert service.put(f"{study_path}/sites/{quote(DECOMPOSED)}", json={"lat_ms": 3}).status_code == 200
    (site,) = _sites(service, study_path).values()
    assert (site["site"], site["lat_ms"]) == (COMPOSED, 3)
    assert None not in (site["view_a"], site["view_b"])


def test_a_view_names_a_file_as_macos_writes_it(service: TestClient, study_path: str, tmp_path: Path) -> None:
    for number, name in enumerate([f"{DECOMPOSED}-a.dcm", f"{COMPOSED}-b.dcm"]):
        files = {"file": (name, small_run(tmp_path, number, 90.0 * number), "application/dicom")}
        assert service.post(f"{study_path}/instances", files=files).status_code == 201
    table = f"site,lat_ms,view_a,view_b\nS,1,{COMPOSED}-a.dcm,{DECOMPOSED}-b.dcm\n"
    put = service.put(f"{study_path}/activation-times", content=table.encode(), headers={"Content-Type": "text/csv"})
    assert put.json()["unmatched"] == []
    site = _sites(service, study_path)["S"]
    assert (site["view_a"], site["view_b"]) == (run_uid(0), run_uid(1))


def test_catheters_have_one_name(service: TestClient) -> None:
    catheters = [{"name": DECOMPOSED, "type": "decapolar-2-5-2"}, {"name": "mapping", "type": "decapolar-2-5-2"}]
    study = service.post("/v1/studies", json={"label": "x", "catheters": catheters, "reference": COMPOSED})
    assert study.status_code == 201, study.text
    assert study.json()["reference"] == COMPOSED
    twice = service.post(
        "/v1/studies", json={"label": "x", "catheters": [*catheters, catheters[0] | {"name": COMPOSED}]}
    )
    assert twice.status_code == 422
