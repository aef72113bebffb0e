"""The catalogue of catheter types, and studies that use it."""

from __future__ import annotations

import pytest
from fastapi.testclient import TestClient

from fluoromap.catheters import CATHETER_TYPES


def test_every_type_is_listed_with_electrodes_and_spacing(service: TestClient) -> None:
    items = service.get("/v1/catheter-types").json()["items"]
    assert [item["name"] for item in items] == list(CATHETER_TYPES)
    decapolar = next(item for item in items if item["name"] == "decapolar-2-8-2")
    assert decapolar == {
        "name": "decapolar-2-8-2",
        "electrodes": 10,
        "spacing_mm": [3.5, 9.0, 3.0, 9.0, 3.0, 9.0, 3.0, 9.0, 3.0],
        "edge_spacing_mm": [2.0, 8.0, 2.0, 8.0, 2.0, 8.0, 2.0, 8.0, 2.0],
        "tip_mm": 2.0,
        "ring_mm": 1.0,
    }


def test_the_list_has_pages(service: TestClient) -> None:
    first = service.get("/v1/catheter-types?limit=5").json()
    second = service.get(f"/v1/catheter-types?limit=5&cursor={first['next']}").json()
    assert [item["name"] for item in first["items"] + second["items"]] == list(CATHETER_TYPES)[:10]


def test_a_study_takes_each_type_with_its_lengths(service: TestClient) -> None:
    for item in service.get("/v1/catheter-types").json()["items"]:
        catheters = [{"name": "mapping", "type": "ablation-4"}, {"name": "reference", "type": item["name"]}]
        answer = service.post("/v1/studies", json={"label": "x", "catheters": catheters})
        assert answer.status_code == 201, answer.text
        stored = answer.json()["catheters"][1]
        lengths = ("electrodes", "spacing_mm", "tip_mm", "ring_mm")
        assert {name: stored[name] for name in lengths} == {name: item[name] for name in lengths}


@pytest.mark.parametrize(("catheters", "electrodes", "status"), [(6, 20, 201), (7, 4, 422), (2, 21, 422)])
def test_most_catheters_and_electrodes(service: TestClient, catheters: int, electrodes: int, status: int) -> None:
    described = [
        {"name": f"C{number}", "electrodes": electrodes, "spacing_mm": [2 + number] * (electrodes - 1), "tip_mm": 2,
         "ring_mm": 1}
        for number in range(catheters)
    ]  # fmt: skip
    assert service.post("/v1/studies", json={"label": "x", "catheters": described}).status_code == status
