"""Tools of the two views: contrast, zoom, moving the picture, and the line of an electrode in the other view."""

from __future__ import annotations

from typing import Any

import pytest

PICTURE = "canvas => canvas.toDataURL()"
CHANGED = "([canvas, before]) => canvas.toDataURL() !== before"


@pytest.fixture
def canvases(page: Any, mapped_study: tuple[str, str]) -> dict[str, Any]:
    """Return the canvases of both views of the first site, with their electrodes."""
    page.goto(f"/studies/{mapped_study[0]}#electrodes")
    found = {}
    for view in "ab":
        page.locator(f".view[data-view={view}][data-electrodes='12'][data-frames]").wait_for()
        found[view] = page.locator(f".view[data-view={view}] canvas")
    return found


def drag(page: Any, canvas: Any, button: str) -> None:
    box = canvas.bounding_box()
    # The corner has no electrode.
    page.mouse.move(box["x"] + 12, box["y"] + 12)
    page.mouse.down(button=button)
    page.mouse.move(box["x"] + 72, box["y"] + 42, steps=3)
    page.mouse.up(button=button)


def test_contrast_zoom_and_place_change_the_picture_and_return(page: Any, canvases: dict[str, Any]) -> None:
    canvas = canvases["a"]
    canvas.scroll_into_view_if_needed()
    whole = canvas.evaluate(PICTURE)
    seen = [whole]
    for act in (
        lambda: drag(page, canvas, "right"),
        lambda: page.mouse.wheel(0, -400),
        lambda: drag(page, canvas, "middle"),
    ):
        act()
        page.wait_for_function(CHANGED, arg=[canvas.element_handle(), seen[-1]])
        seen.append(canvas.evaluate(PICTURE))
    assert len(set(seen)) == 4
    canvas.focus()
    page.keyboard.press("0")
    assert canvas.evaluate(PICTURE) == whole


def test_the_line_of_an_electrode_is_drawn_in_the_other_view(page: Any, canvases: dict[str, Any]) -> None:
    before = canvases["b"].evaluate(PICTURE)
    canvases["a"].focus()
    page.keyboard.press("n")
    page.wait_for_function(CHANGED, arg=[canvases["b"].element_handle(), before])
