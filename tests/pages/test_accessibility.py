"""Accessibility by axe-core, in light and dark; phone width; keyboard."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from small_runs import small_run

STEPS = ("runs", "electrodes", "compute", "map")


@pytest.fixture
def filled_study(page: Any, tmp_path: Path) -> str:
    """Return the page of a study with two small runs."""
    study = page.request.post("/v1/studies", data={"label": "For axe"}).json()["id"]
    for number, angle in ((1, 0.0), (2, 90.0)):
        page.request.post(
            f"/v1/studies/{study}/instances",
            data=small_run(tmp_path, number, angle),
            headers={"Content-Type": "application/dicom"},
        )
    return f"/studies/{study}"


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious(
    browser: Any, service_url: str, filled_study: str, mapped_study: tuple[str, str], node_modules: Path, scheme: str
) -> None:
    script = (node_modules / "axe-core" / "axe.min.js").read_text()
    addresses = ["/", "/sign-in", "/docs", *(f"{filled_study}#{step}" for step in STEPS)]
    with_map = f"/studies/{mapped_study[0]}#map"
    found = []
    # The policy of the pages would keep the checker itself out.
    with browser.new_context(base_url=service_url, color_scheme=scheme, bypass_csp=True) as context:
        for address in (*addresses, with_map):
            opened = context.new_page()
            opened.goto(address)
            opened.locator("h1").wait_for()
            if address not in ("/sign-in", "/docs"):
                opened.locator("body[data-ready]").wait_for()
            if address == with_map:
                opened.locator(".fused[data-frames]").nth(1).wait_for()
            opened.evaluate(script)
            for finding in opened.evaluate("axe.run()")["violations"]:
                if finding["impact"] in ("serious", "critical"):
                    found.append((address, finding["id"], [node["html"] for node in finding["nodes"]][:3]))
            opened.close()
    assert not found, json.dumps(found, indent=1)


def test_pages_fit_a_phone(page: Any, filled_study: str, mapped_study: tuple[str, str]) -> None:
    page.set_viewport_size({"width": 390, "height": 800})
    with_map = f"/studies/{mapped_study[0]}#map"
    for address in ("/", with_map, *(f"{filled_study}#{step}" for step in STEPS)):
        page.goto("about:blank")
        page.goto(address)
        page.locator("body[data-ready]").wait_for()
        if address == with_map:
            page.locator(".fused[data-frames]").nth(1).wait_for()
        assert page.locator("html").evaluate("root => root.scrollWidth") <= 390, address


def test_keys_play_and_step_the_cine(page: Any, filled_study: str) -> None:
    page.goto(f"{filled_study}#electrodes")
    page.locator(".view[data-frames]").nth(1).wait_for()
    page.locator(".view canvas").first.focus()
    page.keyboard.press("ArrowRight")
    page.get_by_text("2 / 3").wait_for()
    page.keyboard.press("End")
    page.get_by_text("3 / 3").wait_for()
    page.keyboard.press(" ")
    page.get_by_role("button", name="Pause view a").wait_for()
