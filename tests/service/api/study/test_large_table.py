"""A table of activation times keeps others from writing for as long as few statements take."""

from __future__ import annotations

from typing import Any

import pytest
from fastapi.testclient import TestClient
from sql_statements import sql_statements


def _put(service: TestClient, study_path: str, sites: int, lat_ms: float) -> tuple[list[str], Any]:
    table = "site,lat_ms\n" + "".join(f"S{number},{lat_ms}\n" for number in range(sites))
    with sql_statements() as statements:
        answer = service.put(f"{study_path}/activation-times", content=table, headers={"Content-Type": "text/csv"})
    assert answer.status_code == 200, answer.text
    return statements, answer.json()


def test_no_site_has_a_statement_of_its_own(service: TestClient, study_path: str) -> None:
    for lat_ms in (1.0, 2.0):
        statements, told = _put(service, study_path, 300, lat_ms)
        assert told["sites"] == 300
        assert len(statements) < 30


@pytest.mark.parametrize("before", [[], ["S2", "S9"]])
def test_new_sites_keep_the_order_of_the_table(service: TestClient, study_path: str, before: list[str]) -> None:
    for name in before:
        service.put(f"{study_path}/sites/{name}", json={"lat_ms": 7.0}).raise_for_status()
    _, told = _put(service, study_path, 5, 1.0)
    assert told["unmatched"] == ["S0", "S1", "S2", "S3", "S4"]
    listed = service.get(f"{study_path}/sites").json()["items"]
    new = [f"S{number}" for number in range(5) if f"S{number}" not in before]
    assert [site["site"] for site in listed] == [*before, *new]
    assert [site["lat_ms"] for site in listed if site["site"] != "S9"] == [1.0] * 5
