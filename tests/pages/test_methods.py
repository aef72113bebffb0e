"""Methods and parameters: forms made from the plugins' JSON schema."""

from __future__ import annotations

import json
from typing import Any

from playwright.sync_api import expect


def test_a_form_has_each_parameter_and_sends_what_a_person_changed(page: Any, mapped_study: tuple[str, str]) -> None:
    sent: list[dict[str, Any]] = []

    def refuse(route: Any) -> None:
        sent.append(json.loads(route.request.post_data))
        body = json.dumps({"code": "refused", "detail": "This test computes nothing.", "status": 422})
        route.fulfill(status=422, body=body, content_type="application/problem+json")

    page.route("**/v1/studies/*/jobs", refuse)
    plugins = page.request.get("/v1/plugins").json()
    page.goto(f"/studies/{mapped_study[0]}#compute")
    page.get_by_text("Methods and parameters").click()
    method = page.locator("fieldset", has_text="Find electrodes")
    for name in ("catheter-chain", "four-step"):
        method.get_by_label("Method").select_option(name)
        schema = next(each["parameters"] for each in plugins if each["name"] == name)
        expect(method.locator(".fields input, .fields select")).to_have_count(len(schema["properties"]))
    names = {each["name"] for each in plugins if each["kind"] == "fuser" and each["error"] is None}
    fuser = page.locator("fieldset", has_text="Make the map").get_by_label("Method")
    assert set(fuser.locator("option").evaluate_all("all => all.map(each => each.value)")) == names
    first = next(iter(schema["properties"]))
    method.locator(".fields input").first.fill("0.25")
    page.locator("#panel-compute").get_by_role("button", name="Compute the map").click()
    page.get_by_text("This test computes nothing.").wait_for()
    assert sent[0]["pipeline"]["segmenter"] == {"name": "four-step", "params": {first: 0.25}}
