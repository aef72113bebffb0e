"""A person without a mouse corrects electrodes: by keys alone, from the address of the study to the new map."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
from playwright.sync_api import expect


@pytest.fixture
def view(page: Any, own_study: str) -> Any:
    """Return view a of the first site, focused by Tab."""
    page.goto(f"/studies/{own_study}#electrodes")
    shown = page.locator(".view[data-view=a]")
    # The page begins with the frame of the map.
    shown.get_by_text("used for the map").wait_for()
    page.locator(".view[data-view=a][data-electrodes='12']").wait_for()
    for _ in range(60):
        page.keyboard.press("Tab")
        if shown.locator("canvas").evaluate("canvas => canvas === document.activeElement"):
            return shown
    pytest.fail("Tab does not reach the picture")


def electrodes(page: Any, study: str) -> dict[tuple[str, int], dict[str, Any]]:
    """Return the stored electrodes of the frame in view a of site S01."""
    frame = page.get_by_label("Frame of view a").input_value()
    site = page.request.get(f"/v1/studies/{study}/sites/S01").json()
    address = f"/v1/studies/{study}/instances/{site['view_a']}/frames/{frame}/electrodes"
    return {(each["catheter"], each["electrode"]): each for each in page.request.get(address).json()}


def press(page: Any, view: Any, *keys: str) -> None:
    """Send keys, and wait until the service has stored the change."""
    view.locator(".status").evaluate("status => (status.textContent = '')")
    for key in keys:
        page.keyboard.press(key)
    expect(view.locator(".status")).to_have_text("stored")


def test_the_focus_and_the_choice_are_visible(page: Any, view: Any) -> None:
    canvas = view.locator("canvas")
    assert canvas.evaluate("canvas => getComputedStyle(canvas).outlineStyle") == "solid"
    page.keyboard.press("n")
    view.locator(".status", has_text="mapping 1, found by the service").wait_for()
    page.keyboard.press("n")
    view.locator(".status", has_text="mapping 2, found by the service").wait_for()
    page.keyboard.press("Shift+N")
    view.locator(".status", has_text="mapping 1").wait_for()
    # The tools now change the catheter of the chosen electrode.
    page.keyboard.press("[")
    view.locator(".status", has_text="reference 4").wait_for()
    assert page.get_by_label("Catheter to mark").input_value() == "reference"


def test_an_electrode_is_moved_deleted_added_undone_and_redone(page: Any, view: Any, own_study: str) -> None:
    before = electrodes(page, own_study)
    tip = before["mapping", 1]
    press(page, view, "n", "Shift+ArrowRight")
    page.keyboard.down("Shift")
    for _ in range(4):
        page.keyboard.press("ArrowDown")
    # The way of one press of Shift is stored once.
    view.locator(".status").evaluate("status => (status.textContent = '')")
    page.keyboard.up("Shift")
    expect(view.locator(".status")).to_have_text("stored")
    moved = electrodes(page, own_study)["mapping", 1]
    assert moved["source"] == "manual"
    assert (moved["u_px"] - tip["u_px"], moved["v_px"] - tip["v_px"]) == pytest.approx((1, 4), abs=0.01)

    press(page, view, "Delete")
    assert ("mapping", 1) not in electrodes(page, own_study)
    press(page, view, "Control+z")
    assert ("mapping", 1) in electrodes(page, own_study)
    press(page, view, "Control+y")
    assert ("mapping", 1) not in electrodes(page, own_study)

    page.keyboard.press("a")
    page.get_by_text('that the catheter "mapping" lacks').wait_for()
    press(page, view, "ArrowLeft", "Shift+ArrowUp", "Enter")
    added = electrodes(page, own_study)["mapping", 1]
    last = before["mapping", 4]
    assert (added["u_px"] - last["u_px"], added["v_px"] - last["v_px"]) == pytest.approx((-1, -10), abs=0.01)
    page.get_by_role("button", name="Move electrodes", pressed=True).wait_for()


def test_a_catheter_is_marked_from_its_tip_on(page: Any, view: Any, own_study: str) -> None:
    page.keyboard.press("m")
    for number in (1, 2, 3, 4):
        page.get_by_text(f'Click electrode {number} of 4 of the catheter "mapping"').wait_for()
        press(page, view, *["ArrowRight"] * 5, "Enter")
    page.get_by_role("button", name="Move electrodes", pressed=True).wait_for()
    found = electrodes(page, own_study)
    places = [found["mapping", number]["u_px"] for number in (1, 2, 3, 4)]
    assert [b - a for a, b in itertools.pairwise(places)] == pytest.approx([5, 5, 5], abs=0.01)


def test_track_again_from_here_takes_the_frame_as_right_and_computes(page: Any, view: Any, own_study: str) -> None:
    page.keyboard.press("n")
    chosen = view.locator(".status").inner_text().split(" ")[0]
    page.keyboard.press("t")
    # The new map comes by itself.
    page.locator("#panel-map .scene canvas[data-drawn=yes]").first.wait_for()
    page.get_by_text("The computation has ended: finished.").wait_for()
    page.locator("#panel-map .fused[data-frames]").nth(1).wait_for()
    stored = electrodes(page, own_study)
    assert {each["source"] for each in stored.values()} == {"manual"}
    assert {name for name, _ in stored} == {chosen}


def test_the_page_says_which_keys_there_are(page: Any, view: Any) -> None:
    page.keyboard.press("h")
    page.get_by_text("move the chosen electrode by 1 pixel").wait_for()
    page.get_by_text("track again from here: this frame is right").wait_for()
