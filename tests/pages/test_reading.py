"""Pages and report are readable: enlarged to 200 %, on a phone, on paper, and without a network."""

from __future__ import annotations

import io
import re
from typing import Any

import pytest

STEPS = ("runs", "electrodes", "compute", "map")
PHONE_PX = 390
WIDTH = "root => root.scrollWidth"


@pytest.mark.parametrize("way", ["the browser's zoom", "larger text"])
def test_pages_are_readable_at_200_percent(
    browser: Any, service_url: str, mapped_study: tuple[str, str], way: str
) -> None:
    # The zoom of a browser halves the width of a page.
    width, text = (640, "100%") if way == "the browser's zoom" else (1280, "200%")
    with browser.new_context(
        base_url=service_url, viewport={"width": width, "height": 450}, bypass_csp=True
    ) as context:
        for address in ("/", "/docs", "/sign-in", *(f"/studies/{mapped_study[0]}#{step}" for step in STEPS)):
            page = context.new_page()
            page.goto(address)
            page.locator("h1").wait_for()
            if address.endswith("#map"):
                page.locator(".fused[data-frames]").nth(1).wait_for()
            page.add_style_tag(content=f"html {{ font-size: {text}; }}")
            assert page.locator("html").evaluate(WIDTH) <= width, address
            cut = page.locator("button, summary, label, h1, h2, p").evaluate_all(
                "all => all.filter(each => each.scrollWidth > each.clientWidth + 1"
                " && getComputedStyle(each).overflowX !== 'visible').map(each => each.textContent)"
            )
            assert cut == [], address
            page.close()


def test_the_report_fits_a_phone(page: Any, mapped_study: tuple[str, str]) -> None:
    page.set_viewport_size({"width": PHONE_PX, "height": 800})
    page.goto(f"/v1/jobs/{mapped_study[1]}/report.html")
    page.locator(".scene canvas[data-drawn=yes]").first.wait_for()
    assert page.locator("html").evaluate(WIDTH) <= PHONE_PX


def test_the_report_prints_whole(page: Any, mapped_study: tuple[str, str]) -> None:
    page.goto(f"/v1/jobs/{mapped_study[1]}/report.html")
    page.locator(".scene canvas[data-drawn=yes]").first.wait_for()
    page.emulate_media(media="print")
    # A4 less its margins, in pixels of the page.
    page.set_viewport_size({"width": round((210 - 24) / 25.4 * 96), "height": 1000})
    assert page.locator("html").evaluate(WIDTH) <= round((210 - 24) / 25.4 * 96)
    hidden = page.locator("details > :not(summary)").evaluate_all(
        "all => all.filter(each => !each.checkVisibility({contentVisibilityAuto: true})).map(each => each.tagName)"
    )
    assert hidden == []
    pdf = page.pdf(format="A4")
    assert len(re.findall(rb"/Type\s*/Page\b", io.BytesIO(pdf).getvalue())) >= 1


def test_the_page_of_the_api_needs_no_network(page: Any) -> None:
    # The fixture checks that the browser asked nobody else.
    page.goto("/docs")
    page.locator("h1").wait_for()
    page.get_by_text("/v1/studies/{study_id}/jobs").first.wait_for(state="attached")
