"""A site that could not be located: the page says which one and why, and leads to its electrodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
from playwright.sync_api import expect

from fluoromap_service.dicom import deterministic_uid
from fluoromap_service.dicom.simulation import SimulatedFiles

LOST = "S03"


@pytest.fixture
def study_with_a_lost_site(
    compute_study: Callable[[str, SimulatedFiles], tuple[str, str]], study_files: SimulatedFiles, tmp_path: Path
) -> str:
    """Return the id of a study with a map; view a of one site shows no catheter."""
    runs = list(study_files.runs)
    place = next(k for k, path in enumerate(runs) if path.name.startswith(f"{LOST}-a"))
    run = pydicom.dcmread(runs[place])
    run.PixelData = np.full_like(run.pixel_array, int(run.pixel_array.mean())).tobytes()
    # Another picture is another instance.
    run.SOPInstanceUID = run.file_meta.MediaStorageSOPInstanceUID = deterministic_uid(
        "tests", "a run without catheters"
    )
    runs[place] = tmp_path / runs[place].name
    run.save_as(runs[place])
    return compute_study("One site is lost", replace(study_files, runs=tuple(runs)))[0]


def test_the_page_leads_to_the_site_that_is_not_located(page: Any, study_with_a_lost_site: str) -> None:
    page.goto(f"/studies/{study_with_a_lost_site}#map")
    page.get_by_text(f"Site {LOST} is not located.").wait_for()
    expect(page.locator("[data-lost]")).to_have_count(1)
    page.get_by_role("button", name=f"Correct site {LOST}", exact=True).click()

    panel = page.locator("#panel-electrodes")
    panel.locator("option:checked", has_text=f"site {LOST}, not located").wait_for(state="attached")
    panel.get_by_text(f"Site {LOST} is not located.").wait_for()
    page.get_by_label("Site", exact=True).select_option(label="site S01")
    panel.get_by_text(f"Site {LOST} is not located.").wait_for(state="hidden")
