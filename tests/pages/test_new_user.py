"""The way of a new user: from an empty list of studies to a corrected map and its mesh."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from playwright.sync_api import expect
from small_runs import edited


def _compute(page: Any) -> None:
    page.get_by_role("tab", name="3 Compute").click()
    page.locator("#panel-compute").get_by_role("button", name="Compute the map").click()
    page.locator("[data-job=queued], [data-job=running]").wait_for()
    page.get_by_text("The computation has ended: finished.").wait_for()
    page.get_by_role("button", name="Show the map").click()
    page.locator(".scene canvas[data-drawn=yes]").first.wait_for()


def test_from_upload_over_a_correction_to_the_mesh(
    page: Any,
    new_study: Callable[[Any, str], str],
    drag_pixel: Callable[..., None],
    simulated_study: Path,
    tmp_path: Path,
) -> None:
    study = new_study(page, "Dog 3, sinus rhythm")
    paths = []
    for source in sorted(simulated_study.rglob("*.dcm")):
        paths.append(tmp_path / source.name)
        paths[-1].write_bytes(edited(source.read_bytes(), DistanceSourceToDetector=None))
    page.locator("#files").set_input_files([*paths, simulated_study / "activation_times.csv"])
    page.locator("li[data-state=done]").nth(len(paths)).wait_for()

    # The page says what is missing, and takes it.
    page.get_by_text("10 of 10 runs lack geometry: distance source to detector.").wait_for()
    page.get_by_label("Source to detector, mm").fill("1000")
    page.get_by_role("button", name="Save the geometry").click()
    page.get_by_text("5 of 5 sites are ready").wait_for()

    _compute(page)
    first_map = page.locator("#panel-map").get_by_text("total activation time").inner_text()
    expect(page.locator("#panel-map tr[data-site]")).to_have_count(5)

    # Somebody drags the tip of the mapping catheter in view a of a located site.
    located = page.locator("#panel-map tr[data-grade]:not([data-grade=rejected])").first
    site = located.get_attribute("data-site")
    located.get_by_role("button", name="Find site").click()
    page.get_by_role("tab", name="2 Look and correct").click()
    page.locator(".view[data-view=a][data-frames]").wait_for()
    shown = page.request.get(f"{study}/sites/{site}").json()
    frames = page.request.get(f"{study}/instances/{shown['view_a']}/electrodes").json()
    # In the frame that the map uses, along the line of sight of view b, which then cannot contradict it.
    job = page.request.get(f"/v1/jobs?study={study.split('/')[-1]}").json()["items"][0]["id"]
    overlays = page.request.get(f"/v1/jobs/{job}/overlays").json()["overlays"]
    used = next(each["frame"] for each in overlays if (each["site"], each["view"]) == (site, "a"))
    frame = next(each for each in frames if each["frame"] == used)
    tip = next(e for e in frame["electrodes"] if e["catheter"] == "mapping" and e["electrode"] == 1)
    page.get_by_label("Frame of view a").fill(str(frame["frame"]))
    drag_pixel(page, "a", (tip["u_px"], tip["v_px"]), (tip["u_px"] + 10, tip["v_px"]))
    expect(page.locator(".view[data-view=a] .status")).to_have_text("stored")
    address = f"{study}/instances/{shown['view_a']}/frames/{frame['frame']}/electrodes"
    stored = page.request.get(address).json()
    assert {each["catheter"] for each in stored} == {"mapping"}
    assert {each["source"] for each in stored} == {"manual"}
    moved = next(each for each in stored if each["electrode"] == 1)
    assert abs(moved["u_px"] - tip["u_px"] - 10) < 1

    page.locator(".view[data-view=a] canvas").focus()
    page.keyboard.press("Control+z")
    expect(page.locator(".view[data-view=a] .status")).to_have_text("stored")
    page.keyboard.press("Control+y")
    expect(page.locator(".view[data-view=a] .status")).to_have_text("stored")

    _compute(page)
    page.get_by_role("button", name="Compare", exact=True).click()
    page.get_by_text("The maps differ by").wait_for()
    row = page.locator("table.comparison tbody tr", has_text=site)
    assert float(row.locator("td").nth(1).inner_text()) > 1.0
    assert page.locator("#panel-map").get_by_text("total activation time").inner_text() != first_map

    with page.expect_download() as download:
        page.get_by_role("link", name="Mesh, PLY").click()
    assert Path(download.value.path()).read_bytes().startswith(b"ply")
