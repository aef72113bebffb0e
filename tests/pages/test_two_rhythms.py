"""Two rhythms of one heart: the same runs with other activation times, compared on the page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

LATER_MS = 25.0
SITE = "S02"


def test_two_rhythms_of_a_study_are_computed_and_compared(page: Any, own_study: str, tmp_path: Path) -> None:
    sites = page.request.get(f"/v1/studies/{own_study}/sites").json()["items"]
    first = {each["site"]: each["lat_ms"] for each in sites}
    second = {site: -lat_ms + (LATER_MS if site == SITE else 0.0) for site, lat_ms in first.items()}
    table = tmp_path / "tachycardia.csv"
    table.write_text("site,lat_ms\n" + "".join(f"{site},{lat_ms}\n" for site, lat_ms in second.items()))

    page.goto(f"/studies/{own_study}")
    page.locator("body[data-ready]").wait_for()
    page.locator("#files").set_input_files(table)
    page.get_by_text("times of 5 sites").wait_for()
    page.get_by_role("tab", name="3 Compute").click()
    page.locator("#panel-compute").get_by_role("button", name="Compute the map").click()
    page.get_by_text("The computation has ended: finished.").wait_for()
    page.get_by_role("button", name="Show the map").click()
    page.locator("#panel-map [data-job]").wait_for()
    newest = page.request.get(f"/v1/jobs?study={own_study}").json()["items"][0]["id"]
    page.locator(f"#panel-map [data-job='{newest}']").wait_for()
    page.get_by_role("button", name="Compare", exact=True).click()
    words = page.get_by_text("The maps differ by")
    words.wait_for()
    assert float(words.inner_text().split(" ms")[0].split()[-1]) > 5
    for row in page.locator(".comparison tbody tr").all():
        site, moved, changed, *_ = [cell.inner_text() for cell in row.locator("td").all()]
        # The runs are the same, so no site moves.
        assert moved in ("0.00", "–")
        assert changed == f"{second[site] - first[site]:.1f}".replace("-", "−")
    # Both computations say which times they have.
    page.get_by_label("Show the computation of").select_option(index=1)
    page.locator(f"#panel-map [data-job='{newest}']").wait_for(state="detached")
