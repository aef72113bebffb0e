"""Real frames without gantry geometry: values typed in, electrodes marked by hand."""

from __future__ import annotations

import csv
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import expect
from small_runs import edited

from fluoromap.geometry import Gantry
from fluoromap_service.dicom import deterministic_uid, write_cine

GEOMETRY = (
    "PositionerPrimaryAngle", "PositionerSecondaryAngle", "DistanceSourceToDetector", "DistanceSourceToPatient",
    "ImagerPixelSpacing",
)  # fmt: skip


@pytest.fixture
def real_frames(sample_data: Path) -> Path:
    """Return the folder of real fluoroscopy frames with labels."""
    folder = sample_data / "real"
    if not folder.exists():
        pytest.skip("FLUOROMAP_SAMPLE_DATA has no folder 'real'")
    return folder


def _run(folder: Path, frames: list[np.ndarray[Any, Any]], number: int) -> Path:
    path = folder / f"real{number}.dcm"
    write_cine(
        path,
        iter(frames),
        frame_count=len(frames),
        gantry=Gantry(90.0 * (number - 1), 0.0, 1000.0, 750.0, (0.3, 0.3), 512, 512),
        frame_time_ms=66.7,
        acquired=datetime(2026, 3, 1, 9, 30, tzinfo=UTC) + timedelta(seconds=20 * number),
        study_instance_uid=deterministic_uid("tests", "real study"),
        series_number=number,
        sop_instance_uid=deterministic_uid("tests", "real run", str(number)),
    )
    path.write_bytes(edited(path.read_bytes(), **dict.fromkeys((*GEOMETRY, "Manufacturer"))))
    return path


def test_electrodes_of_real_frames_marked_from_the_tip(
    page: Any,
    new_study: Callable[[Any, str], str],
    click_pixel: Callable[..., None],
    real_frames: Path,
    tmp_path: Path,
) -> None:
    study = new_study(page, "Real frames")
    pictures = [np.asarray(Image.open(real_frames / f"ep_b_{k}.png")).astype(np.uint16) for k in (1, 2, 3)]
    page.locator("#files").set_input_files([_run(tmp_path, pictures, number) for number in (1, 2)])
    page.locator("li[data-state=done]").nth(1).wait_for()
    page.get_by_text("2 of 2 runs lack geometry").wait_for()

    # Distances hold for the whole study, angles for each run.
    page.get_by_label("Source to detector, mm").fill("1000")
    page.get_by_label("Source to isocentre, mm").fill("750")
    page.get_by_label("Pixel spacing at the detector, mm").fill("0,43")
    page.get_by_role("button", name="Save the geometry").click()
    for number, angle in ((1, "0"), (2, "90")):
        page.get_by_text("The geometry is saved.").wait_for()
        page.get_by_role("button", name="Close").click()
        page.get_by_label("Geometry of").select_option(index=number)
        page.get_by_label("Primary angle, °").fill(angle)
        page.get_by_label("Secondary angle, °").fill("0")
        page.get_by_role("button", name="Save the geometry").click()
    page.get_by_label("Name of pair 1").fill("S01")
    page.get_by_label("Activation time of pair 1 in ms").fill("12,5")
    page.get_by_role("button", name="Save pair 1").click()
    page.get_by_text("1 of 1 sites are ready").wait_for()

    page.get_by_role("tab", name="2 Look and correct").click()
    page.locator(".view[data-frames]").nth(1).wait_for()
    with (real_frames / "ep_b_labels.csv").open() as file:
        labels = [row for row in csv.DictReader(file) if row["file"] == "ep_b_1.png"]
    names = list(dict.fromkeys(row["catheter"] for row in labels))[:2]
    for view in "ab":
        for name, catheter in zip(names, ("reference", "mapping"), strict=True):
            page.get_by_label("Catheter to mark").select_option(catheter)
            page.get_by_role("button", name="Mark from the tip").click()
            for row in [each for each in labels if each["catheter"] == name][:4]:
                click_pixel(page, view, float(row["u_px"]), float(row["v_px"]))
            page.get_by_role("button", name="Move electrodes", pressed=True).wait_for()
        expect(page.locator(f".view[data-view={view}] .status")).to_have_text("stored")
    site = page.request.get(f"{study}/sites/S01").json()
    for view in ("view_a", "view_b"):
        stored = page.request.get(f"{study}/instances/{site[view]}/frames/1/electrodes").json()
        assert [each["source"] for each in stored] == ["manual"] * 8

    page.get_by_role("button", name="Compute the map again").click()
    page.get_by_text("The computation has ended").wait_for()
    page.get_by_role("tab", name="4 Map and results").click()
    # One site makes no surface; the page says so, and what it knows about the site.
    page.get_by_text("at least four").wait_for()
    expect(page.locator("#panel-map tr[data-site=S01]")).to_have_count(1)
