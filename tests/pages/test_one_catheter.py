"""A study with a single catheter, made on the page and shown with its doubt."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fluoromap.catheters import Catalogue, catheter_type
from fluoromap.phantom import StudySpec
from fluoromap_service.cli.client import Client
from fluoromap_service.dicom.simulation import simulate

CATALOGUE = Catalogue((catheter_type("ablation-4", "mapping"),), reference=None, mapping="mapping")


def test_a_study_with_one_catheter_is_made_and_its_map_states_the_doubt(
    page: Any, service_url: str, tmp_path: Path
) -> None:
    files = simulate(tmp_path / "study", StudySpec(7, sites=5, frames=16, catalogue=CATALOGUE), processes=1)
    page.goto("/")
    page.locator("body[data-ready]").wait_for()
    if page.locator("details[open]").count() == 0:
        page.get_by_text("New study").click()
    page.get_by_label("Name of the study").fill("One catheter")
    for _ in range(2):
        page.get_by_role("button", name="Remove").first.click()
    page.get_by_role("button", name="Create the study").click()
    page.wait_for_url("**/studies/*")
    study = page.url.split("/studies/")[1].split("#")[0]
    stored = page.request.get(f"/v1/studies/{study}").json()
    assert (stored["reference"], stored["mapping"], len(stored["catheters"])) == (None, "mapping", 1)

    with Client(service_url) as client:
        for path in files.runs:
            client.upload(study, path)
        client.put_activation_times(study, files.activation_times)
        assert [each["state"] for each in client.follow(client.start_job(study))][-1] == "succeeded"
    page.goto(f"/studies/{study}#map")
    page.reload()
    page.locator(".scene canvas[data-drawn=yes]").first.wait_for()
    page.get_by_text("No catheter rests in this study").first.wait_for()
    page.get_by_label("Runs of site").select_option("S02")
    page.locator(".fused[data-frames]").nth(1).wait_for()
