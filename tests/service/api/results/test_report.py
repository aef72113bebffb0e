"""The report: whole, self-contained, and drawn in a real browser."""

from __future__ import annotations

import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from finished_study import FinishedStudy, no_map
from playwright.sync_api import sync_playwright

from fluoromap_service.store.engine import writing
from fluoromap_service.store.models import Study

pytestmark = pytest.mark.usefixtures("file_processes")

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
ARGUMENTS = ["--no-sandbox", "--disable-dev-shm-usage", "--enable-unsafe-swiftshader"]
PATIENCE_MS = 240_000


class _References(HTMLParser):
    """Everything a page would load or link to."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "action")]


def _page(client: TestClient, study: FinishedStudy) -> str:
    answer = client.get(f"/v1/jobs/{study.job_id}/report.html")
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"].startswith("text/html")
    return answer.text


@pytest.mark.parametrize("path", ["report.html", "archive.zip"])
def test_report_and_archive_wait_for_the_end(client: TestClient, study: FinishedStudy, path: str) -> None:
    study.mapped()
    answer = client.get(f"/v1/jobs/{study.job_id}/{path}")
    assert (answer.status_code, answer.json()["code"]) == (409, "not_ready")
    assert int(answer.headers["retry-after"]) > 0


def test_the_job_links_to_it(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    link = client.get(f"/v1/jobs/{study.job_id}").json()["links"]["report"]
    first = client.get(link)
    assert first.status_code == 200
    assert client.get(link, headers={"If-None-Match": first.headers["etag"]}).status_code == 304


def test_it_shows_every_site_reason_plugin_and_input(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    page = _page(client, study)
    for site in ("S01", "S03"):
        assert f'<td class="text">{site}</td>' in page
    for code in ("identity_by_motion", "one_view_only", "no_activation_time", "depth_assumed"):
        assert f"<code>{code}</code>" in page
    assert page.count("by-hand") >= 4
    for uid in study.uids.values():
        assert uid in page
    assert len(set(re.findall(r"\b[0-9a-f]{64}\b", page))) >= 2


def test_it_needs_nothing_from_elsewhere(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    references = _References()
    references.feed(_page(client, study))
    assert references.found
    assert all(reference.startswith("data:image/") for reference in references.found)


def test_a_label_is_text(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    with writing() as session:
        session.get_one(Study, study.study_id).label = "<script>alert(1)</script>"
    page = _page(client, study)
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert(1)" in page


def test_a_new_label_is_on_the_page(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    before = _page(client, study)
    assert client.patch(f"/v1/studies/{study.study_id}", json={"label": "Second rhythm"}).status_code == 200
    assert "Second rhythm" not in before
    assert "Second rhythm" in _page(client, study)


def test_a_parameter_without_a_value_is_not_set(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    assert "= None" not in _page(client, study)


def test_without_a_map_it_says_why(client: TestClient, study: FinishedStudy) -> None:
    study.finish(no_map())
    page = _page(client, study)
    assert "a chamber surface needs at least four" in page
    assert 'id="view"' not in page


def test_a_browser_draws_the_map(client: TestClient, study: FinishedStudy, tmp_path: Path) -> None:
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip("no Chromium here to open the report in")
    study.finish()
    path = tmp_path / "report.html"
    path.write_text(_page(client, study), encoding="utf-8")
    with sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=browser, args=ARGUMENTS)
        page = opened.new_page()
        page.goto(path.as_uri())
        page.wait_for_selector('canvas.wall[data-drawn="yes"]', state="attached", timeout=PATIENCE_MS)
        opened.close()
