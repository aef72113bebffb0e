"""Waiting time after a correction in the page: ``python benchmarks/page_correction.py [corrections] [segmenter]``.

The benchmark computes a study of clinical size (20 sites, 2 views, 120 frames at 30 a second, simulated) with the real service,
and opens its page in Chromium as on a machine without a graphics card. For each correction, at another located site, it moves an
electrode by keys in view a, in the frame that the map uses, and presses "Compute the map again". It prints the seconds from the
press to the new map, drawn in 3D, and their median and longest.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from browser import open_page
from clinical_study import simulated_files, start_job, upload_study
from playwright.sync_api import Page

from fluoromap.phantom import StudySpec
from fluoromap.registry import DEFAULTS
from fluoromap_service.cli.supervisor import private_service

SPEC = StudySpec(seed=2026, sites=20, frames=120, frame_rate_hz=30.0)
STEPS_PX = 4
DRAWN = """before => {
  const panel = document.querySelector("#panel-map [data-job]");
  return panel && panel.dataset.job !== before && panel.querySelector(".scene canvas[data-drawn=yes]");
}"""
SHOWN = "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
LOCATED = "#panel-map tr[data-grade]:not([data-grade=rejected])"
SHOWN_JOB = "#panel-map [data-job]"


def main(corrections: int, segmenter: str) -> None:
    """Compute the study, correct it, and print the waiting times."""
    files = simulated_files(SPEC)
    with tempfile.TemporaryDirectory() as folder, private_service(Path(folder) / "service") as service:
        with service.client() as http:
            study, _ = upload_study(http, files)
            job = start_job(http, study, segmenter)
            while http.get(f"/v1/jobs/{job}?wait=30").json()["state"] in ("queued", "running"):
                pass
        with open_page(service) as page:
            page.goto(f"/studies/{study}#map")
            page.wait_for_function(DRAWN, arg="")
            sites = [row.get_attribute("data-site") or "" for row in page.locator(LOCATED).all()]
            choose_segmenter(page, segmenter)
            seconds = []
            for number in range(corrections):
                seconds.append(correct(page, sites[number % len(sites)]))
                print(f"correction at {sites[number % len(sites)]}: {seconds[-1]:.2f} s to the new map", flush=True)
    print(f"median {median(seconds):.2f} s, longest {max(seconds):.2f} s")


def choose_segmenter(page: Page, segmenter: str) -> None:
    page.get_by_role("tab", name="3 Compute").click()
    page.get_by_text("Methods and parameters").click()
    page.get_by_role("group", name="Find electrodes").get_by_label("Method").select_option(segmenter)


def correct(page: Page, site: str) -> float:
    """Return the seconds from the press of the button to the new map."""
    page.get_by_role("tab", name="2 Look and correct").click()
    page.get_by_label("Site", exact=True).select_option(label=f"site {site}")
    view = page.locator("#panel-electrodes .view[data-view=a]")
    view.get_by_text("used for the map").wait_for()
    page.locator("#panel-electrodes .view[data-view=a][data-electrodes]:not([data-electrodes='0'])").wait_for()
    view.locator("canvas").focus()
    page.keyboard.press("n")
    for _ in range(STEPS_PX):
        view.locator(".status").evaluate("status => (status.textContent = '')")
        page.keyboard.press("Shift+ArrowRight")
        view.locator(".status", has_text="stored").wait_for()
    before = page.locator(SHOWN_JOB).get_attribute("data-job")
    start = time.perf_counter()
    page.get_by_role("button", name="Compute the map again").click()
    page.wait_for_function(DRAWN, arg=before)
    page.evaluate(SHOWN)
    seconds = time.perf_counter() - start
    page.get_by_text("The computation has ended: finished.").wait_for()
    return seconds


if __name__ == "__main__":
    main(
        int(sys.argv[1]) if len(sys.argv) > 1 else 12,
        sys.argv[2] if len(sys.argv) > 2 else DEFAULTS["segmenter"],
    )
