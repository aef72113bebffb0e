"""The reason codes with their sentences."""

from __future__ import annotations

from fastapi.testclient import TestClient

from fluoromap.reasons import Reason


def test_every_reason_has_its_sentence(service: TestClient) -> None:
    answer = service.get("/v1/reasons").json()
    assert {each["code"]: each["sentence"] for each in answer} == {str(each): each.sentence for each in Reason}
