"""A running service, and a real browser that can reach nothing else."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import servers
from processes import environment_of, wait_until_ready, with_servers

from fluoromap.phantom import StudySpec
from fluoromap_service.cli.client import Client
from fluoromap_service.dicom.simulation import SimulatedFiles, simulate

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: no test opens the pages")

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
ARGUMENTS = [
    "--no-sandbox", "--disable-dev-shm-usage", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    # The browser resolves no name but its own machine's.
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
]  # fmt: skip
PATIENCE_MS = 240_000

ClickPixel = Callable[[Any, str, float, float], None]


@pytest.fixture(scope="session")
def service_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Yield the address of an open service with one worker."""
    folder = tmp_path_factory.mktemp("pages")
    environment = environment_of(folder / "data", FLUOROMAP_WORKERS="1")
    port = servers.free_port()
    with with_servers(environment, port):
        url = f"http://127.0.0.1:{port}"
        wait_until_ready(url, folder / "data")
        yield url


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Yield Debian's Chromium."""
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip("no Chromium here to open the pages in")
    playwright.expect.set_options(timeout=PATIENCE_MS)
    with playwright.sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=program, args=ARGUMENTS)
        yield opened
        opened.close()


@pytest.fixture
def page(browser: Any, service_url: str) -> Iterator[Any]:
    """Yield an empty page; afterwards no script has failed and nothing foreign was asked for."""
    with browser.new_context(viewport={"width": 1280, "height": 900}, base_url=service_url) as context:
        opened = context.new_page()
        opened.set_default_timeout(PATIENCE_MS)
        failures: list[str] = []
        addresses: list[str] = []
        opened.on("pageerror", lambda error: failures.append(str(error)))
        opened.on("request", lambda request: addresses.append(request.url))
        yield opened
        assert failures == []
        assert [each for each in addresses if not each.startswith((service_url, "blob:", "data:"))] == []


@pytest.fixture
def click_pixel() -> ClickPixel:
    """Return a function that clicks a stored pixel (u, v) of a view of 512 pixels."""

    def click(page: Any, view: str, u: float, v: float) -> None:
        x, y = pixel_place(page, view, u, v)
        page.mouse.click(x, y)

    return click


def pixel_place(page: Any, view: str, u: float, v: float) -> tuple[float, float]:
    """Return the place of a stored pixel in the window."""
    canvas = page.locator(f".view[data-view={view}] canvas")
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    return box["x"] + (u + 0.5) / 512 * box["width"], box["y"] + (v + 0.5) / 512 * box["height"]


@pytest.fixture
def drag_pixel() -> Callable[..., None]:
    """Return a function that drags from a stored pixel of a view to another."""

    def drag(page: Any, view: str, start: tuple[float, float], stop: tuple[float, float]) -> None:
        page.mouse.move(*pixel_place(page, view, *start))
        page.mouse.down()
        page.mouse.move(*pixel_place(page, view, *stop), steps=5)
        page.mouse.up()

    return drag


@pytest.fixture
def new_study() -> Callable[[Any, str], str]:
    """Return a function that makes a study on the first page, and returns its address in the API."""

    def make(page: Any, label: str) -> str:
        page.goto("/")
        page.locator("body[data-ready]").wait_for()
        if page.locator("details[open]").count() == 0:
            page.get_by_text("New study").click()
        page.get_by_label("Name of the study").fill(label)
        page.get_by_role("button", name="Create the study").click()
        page.wait_for_url("**/studies/*")
        page.locator("body[data-ready]").wait_for()
        return "/v1/studies/" + page.url.split("/studies/")[1].split("#")[0]

    return make


@pytest.fixture(scope="session")
def study_files(tmp_path_factory: pytest.TempPathFactory) -> SimulatedFiles:
    """Return the files of a simulated study of five sites."""
    # Another heart than that of the fixture `simulated_study`: tests upload changed files of its runs.
    return simulate(tmp_path_factory.mktemp("mapped"), StudySpec(8, sites=5, frames=24), processes=1)


@pytest.fixture(scope="session")
def compute_study(service_url: str) -> Callable[[str, SimulatedFiles], tuple[str, str]]:
    """Return a function that computes a new study of files, and returns the ids of study and job."""

    def compute(label: str, files: SimulatedFiles) -> tuple[str, str]:
        with Client(service_url) as client:
            study = client.make_study(label)
            for path in files.runs:
                assert client.upload(study, path).uid
            client.put_activation_times(study, files.activation_times)
            job = client.start_job(study)
            states = [each["state"] for each in client.follow(job)]
            assert states[-1] == "succeeded", states
        return study, job

    return compute


@pytest.fixture(scope="session")
def mapped_study(
    compute_study: Callable[[str, SimulatedFiles], tuple[str, str]], study_files: SimulatedFiles
) -> tuple[str, str]:
    """Return the ids of a study with a map and of its job. No test changes it."""
    return compute_study("With a map", study_files)


@pytest.fixture
def own_study(
    compute_study: Callable[[str, SimulatedFiles], tuple[str, str]],
    study_files: SimulatedFiles,
    mapped_study: tuple[str, str],
) -> str:
    """Return the id of a study with the same map, for a test that changes it. The service takes the stages from the other study."""
    return compute_study("With a map, to change", study_files)[0]


@pytest.fixture(scope="session")
def node_modules() -> Path:
    """Return the folder of the checks that come from npm."""
    folder = Path(os.environ.get("FLUOROMAP_NODE_MODULES", Path(__file__).parent / "node_modules"))
    if not (folder / "typescript").exists():
        pytest.skip("types and accessibility of the pages are not checked: run npm install --prefix tests/pages")
    return folder
