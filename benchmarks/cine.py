"""Playing a run in the browser: ``python benchmarks/cine.py [frames] [seconds]``.

The benchmark computes a simulated study of 5 sites (120 frames of 512x512 pixels, 60 frames a second) with the real service and
opens its pages in Chromium. It lets each view play once, so that its frames are loaded, and then counts the frames that the
page paints. It prints for one view, for both views of a site, and for both views with the map over them:

- painted frames a second and view; the run itself has 60,
- the processor time for each painted frame, ms: of the page's process, of the process that draws for a missing graphics card,
  and of all of Chromium,
- the frames that the page holds in memory, MiB, and their limit.

The benchmark opens Chromium as a machine without a graphics card does. A machine with a card draws the map on the card.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil
from browser import open_page
from playwright.sync_api import Page
from rich.console import Console

from fluoromap.phantom import StudySpec
from fluoromap_service.cli.client import Client
from fluoromap_service.cli.progress import progress_bars
from fluoromap_service.cli.submission import find_files, run_job, upload
from fluoromap_service.cli.supervisor import private_service
from fluoromap_service.dicom.simulation import simulate

RATE_HZ = 60.0
COUNT = """([views, seconds]) => new Promise(done => {
  const painted = () => views.map(view => Number(view.dataset.frames));
  const [start, before] = [performance.now(), painted()];
  const look = now => now - start < 1000 * seconds ? requestAnimationFrame(look)
    : done(painted().map((each, k) => 1000 * (each - before[k]) / (now - start)));
  requestAnimationFrame(look);
})"""
STORED = """async () => {
  const store = await import("/assets/viewer/frame-store.js");
  return [store.storedBytes(), store.MOST_BYTES];
}"""
LOADED = """([view, frames]) => new Promise(done => {
  const before = Number(view.dataset.frames);
  const look = () => Number(view.dataset.frames) - before > frames ? done() : requestAnimationFrame(look);
  look();
})"""


def main(frames: int, seconds: float) -> None:
    with tempfile.TemporaryDirectory() as folder:
        simulate(Path(folder) / "study", StudySpec(seed=7, sites=5, frames=frames, frame_rate_hz=RATE_HZ))
        with private_service(Path(folder) / "service") as service:
            with Client(service.url, service.token) as client, progress_bars(Console(stderr=True)) as progress:
                study = upload(client, find_files(Path(folder) / "study"), "cine", progress).study
                run_job(client, study, progress)
            with open_page(service) as page:
                page.goto(f"/studies/{study}#electrodes")
                page.locator(".view[data-frames]").nth(1).wait_for()
                for letters in ("a", "ab"):
                    for letter in letters:
                        page.get_by_role("button", name=f"Play view {letter}").click()
                    playing = [f"#panel-electrodes .view[data-view={each}]" for each in letters]
                    report(page, f"{len(letters)} view", playing, frames, seconds)
                    for letter in letters:
                        page.get_by_role("button", name=f"Pause view {letter}").click()
                page.get_by_role("tab", name="4 Map and results").click()
                page.locator(".fused[data-frames]").nth(1).wait_for()
                page.get_by_role("button", name="Play the map over fluoroscopy").click()
                report(page, "2 views with the map", [f".fused[data-fused={each}]" for each in "ab"], frames, seconds)


def report(page: Page, title: str, selectors: list[str], frames: int, seconds: float) -> None:
    """Print the rate of views that play, once all their frames are loaded."""
    views: list[Any] = [page.locator(each).element_handle() for each in selectors]
    for view in views:
        page.evaluate(LOADED, [view, frames])
    before, start = _processor_seconds(), time.perf_counter()
    rates = page.evaluate(COUNT, [views, seconds])
    painted = max(sum(rates) * (time.perf_counter() - start), 1)
    spent_ms = {kind: 1000 * (spent - before.get(kind, 0.0)) / painted for kind, spent in _processor_seconds().items()}
    stored, most = (value / 2**20 for value in page.evaluate(STORED))
    shown = " and ".join(f"{rate:.0f}" for rate in rates)
    print(
        f"{title}: {shown} frames/s; a frame takes {spent_ms['renderer']:.1f} ms of the page's process, "
        f"{spent_ms['gpu-process']:.1f} ms of the drawing process, {sum(spent_ms.values()):.1f} ms of all of Chromium"
    )
    print(f"  {stored:.0f} of at most {most:.0f} MiB of frames")


def _processor_seconds() -> dict[str, float]:
    """Return the processor time of Chromium by kind of process."""
    total: dict[str, float] = {}
    for process in psutil.Process().children(recursive=True):
        if "chrom" in process.name():
            times = process.cpu_times()
            # Chromium writes its arguments as one text.
            kind = next(
                (each[7:] for each in " ".join(process.cmdline()).split() if each.startswith("--type=")), "browser"
            )
            total[kind] = total.get(kind, 0.0) + times.user + times.system
    return total


if __name__ == "__main__":
    main(
        int(sys.argv[1]) if len(sys.argv) > 1 else 120,
        float(sys.argv[2]) if len(sys.argv) > 2 else 5.0,
    )
