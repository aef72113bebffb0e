"""A computation that a person cancelled does not look finished."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from fluoromap_service.jobs.pipeline import PIPELINE


def test_cancelled_stages_are_not_done(page: Any, new_study: Callable[[Any, str], str]) -> None:
    study = new_study(page, "Cancelled").rsplit("/", 1)[1]
    stages = [
        {
            "name": stage.name, "subject": study, "plugin": "any", "version": "1", "attempt": 1, "progress": 0.0,
            "state": "done" if stage.name == "segment" else "cancelled", "reused": False, "error": None,
        }
        for stage in PIPELINE
    ]  # fmt: skip
    job = {
        "id": "f" * 32, "study": study, "state": "cancelled", "progress": 0.2, "stages": stages, "error": None,
        "warnings": [], "created": "2026-03-01T09:30:00.000Z", "started": None, "finished": None, "links": {},
    }  # fmt: skip
    answers = {f"/v1/jobs?study={study}&limit=20": {"items": [job], "next": None}, f"/v1/jobs/{job['id']}": job}
    for address, answer in answers.items():
        body = json.dumps(answer)
        page.route(
            lambda url, wanted=address: str(url).endswith(wanted),
            lambda route, _, body=body: route.fulfill(body=body, content_type="application/json"),
        )
    page.goto("about:blank")
    page.goto(f"/studies/{study}#compute")
    page.get_by_text("Computation: cancelled").wait_for()
    page.get_by_text("Find electrodes: 100 %").wait_for()
    page.get_by_text("Make the map: 0 % (1 cancelled)").wait_for()
