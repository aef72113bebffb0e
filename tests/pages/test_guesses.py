"""Pairs that the service guessed are marked as guesses, and a person confirms them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from playwright.sync_api import expect
from small_runs import small_run


def test_guesses_are_confirmed_by_hand(page: Any, new_study: Callable[[Any, str], str], tmp_path: Path) -> None:
    study = new_study(page, "Guesses")
    paths = []
    for number, angle in ((1, 0.0), (2, 90.0), (3, 0.0), (4, 90.0)):
        paths.append(tmp_path / f"run{number}.dcm")
        paths[-1].write_bytes(small_run(tmp_path, number, angle))
    page.locator("#files").set_input_files(paths)
    page.get_by_text("guess: time of acquisition").nth(1).wait_for()
    page.get_by_text("Pair 2 lacks a name and its activation time.").wait_for()

    table = tmp_path / "times.csv"
    table.write_text("site;lat_ms\nS01;12,5\nS02;-30\n")
    page.locator("#files").set_input_files(table)
    page.get_by_text("guess: row order").nth(1).wait_for()
    page.get_by_role("button", name="Confirm all guesses").click()
    page.get_by_text("All pairs are confirmed.").wait_for()
    expect(page.locator(".badge.guess")).to_have_count(0)
    sites = page.request.get(f"{study}/sites").json()["items"]
    assert [(each["bound_by"], each["lat_ms"], each["warnings"]) for each in sites] == [
        ("explicit", 12.5, []), ("explicit", -30.0, []),
    ]  # fmt: skip


def test_a_file_that_is_no_run_is_refused_in_words(
    page: Any, new_study: Callable[[Any, str], str], tmp_path: Path
) -> None:
    new_study(page, "Refusals")
    (tmp_path / "letter.dcm").write_bytes(b"Dear colleague")
    (tmp_path / "times.csv").write_text("site,lat_ms\nS01,late\n")
    page.locator("#files").set_input_files([tmp_path / "letter.dcm", tmp_path / "times.csv"])
    page.get_by_text("column lat_ms: must be a number").wait_for()
    expect(page.locator("li .notice.problem")).to_have_count(2)


def test_a_folder_is_sent_without_the_files_that_are_no_runs(
    page: Any, new_study: Callable[[Any, str], str], tmp_path: Path
) -> None:
    study = new_study(page, "A folder")
    folder = tmp_path / "study"
    folder.mkdir()
    for number, angle in ((1, 0.0), (2, 90.0)):
        (folder / f"run{number}.dcm").write_bytes(small_run(tmp_path, number, angle))
    (folder / "times.csv").write_text("site,lat_ms\nS01,12\n")
    (folder / "truth.json").write_text("{}")
    page.locator("#folder").set_input_files(folder)
    page.get_by_text("left out: no run and no table").wait_for()
    page.get_by_text("1 of 1 sites are ready").wait_for()
    expect(page.locator("li .notice.problem")).to_have_count(0)
    assert len(page.request.get(f"{study}/instances").json()["items"]) == 2
