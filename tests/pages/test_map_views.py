"""The map in its views: 3D, both fluoroscopy views and the table find the same site, and show the same map."""

from __future__ import annotations

import base64
import io
import re
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import expect

SIDE = 512


@pytest.fixture
def map_page(page: Any, mapped_study: tuple[str, str]) -> Any:
    """Return the page of a study that shows its map."""
    page.goto(f"/studies/{mapped_study[0]}#map")
    page.locator(".scene canvas[data-drawn=yes]").first.wait_for()
    page.locator(".fused[data-frames]").nth(1).wait_for()
    return page


def placement(page: Any, job: str, view: str) -> dict[str, Any]:
    """Return camera and places of the map in a view that the page shows."""
    site = page.get_by_label("Runs of site").input_value()
    overlays = page.request.get(f"/v1/jobs/{job}/overlays").json()["overlays"]
    href = next(each["href"] for each in overlays if (each["site"], each["view"]) == (site, view))
    found: dict[str, Any] = page.request.get(href.replace(".png", "/placement")).json()
    return found | {"href": href}


def pixel(place: dict[str, Any], point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pixel (2,) of a point of the map at diastole."""
    shift = place["frames"][place["frame"] - 1]["shift_mm"]
    *uv, depth = np.array(place["projection"]) @ [*(point + shift), 1.0]
    return np.array(uv) / depth


def on_canvas(page: Any, view: str) -> NDArray[np.int64]:
    """Return the picture of a fluoroscopy view, (512, 512, 3)."""
    address = page.locator(f".fused[data-fused={view}] .picture canvas").first.evaluate("canvas => canvas.toDataURL()")
    picture = Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))).convert("RGB")
    return np.asarray(picture.resize((SIDE, SIDE))).astype(np.int64)


def coloured(picture: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return where a picture is not grey."""
    return np.ptp(picture, axis=2) > 12


@pytest.mark.parametrize("view", ["a", "b"])
def test_the_playing_view_and_the_overlay_colour_the_same_wall(
    map_page: Any, mapped_study: tuple[str, str], view: str
) -> None:
    place = placement(map_page, mapped_study[1], view)
    overlay = Image.open(io.BytesIO(map_page.request.get(place["href"]).body()))
    drawn, shown = coloured(np.asarray(overlay).astype(np.int64)), coloured(on_canvas(map_page, view))
    # The colour bars are at different places; labels differ.
    drawn, shown = drawn[:, : SIDE - 110], shown[:, : SIDE - 110]
    assert (drawn & shown).sum() > 0.85 * (drawn | shown).sum()
    assert drawn.mean() > 0.05


def test_a_click_on_a_site_finds_it_in_every_view_and_keeps_the_runs(
    map_page: Any, mapped_study: tuple[str, str]
) -> None:
    job = mapped_study[1]
    runs = map_page.get_by_label("Runs of site").input_value()
    sites = map_page.request.get(f"/v1/jobs/{job}/map").json()["sites"]
    place = placement(map_page, job, "a")
    uv = {each["site"]: pixel(place, np.array([each[f"{axis}_mm"] for axis in "xyz"])) for each in sites}
    # The site that lies most apart from all others is hit without doubt.
    apart = {
        name: min(np.linalg.norm(uv[name] - uv[other]) for other in uv if other != name) for name in uv if name != runs
    }
    name = max(apart, key=lambda each: apart[each])
    canvas = map_page.locator(".fused[data-fused=a] .picture canvas").first
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    u, v = (uv[name] + 0.5) / SIDE
    before = on_canvas(map_page, "b")
    map_page.mouse.click(box["x"] + u * box["width"], box["y"] + v * box["height"])
    map_page.locator(f"#panel-map tr.chosen[data-site={name}]").wait_for()
    # The scene draws its labels with its next picture.
    expect(map_page.locator(".scene .labels .chosen")).to_have_text(re.compile(f"^{name}"))
    assert map_page.get_by_label("Runs of site").input_value() == runs
    assert (on_canvas(map_page, "b") != before).any()


def test_a_choice_in_the_table_shows_the_runs_of_the_site_and_the_way_to_the_earliest(
    map_page: Any, mapped_study: tuple[str, str]
) -> None:
    chamber = map_page.request.get(f"/v1/jobs/{mapped_study[1]}/map").json()
    earliest = chamber["earliest"][0]["site"]
    name = next(each["site"] for each in chamber["sites"] if each["site"] != earliest)
    map_page.get_by_role("button", name=f"Find site {name} in all views").click()
    map_page.locator(".fused .caption", has_text=f"of site {name}").nth(1).wait_for()
    assert map_page.get_by_label("Runs of site").input_value() == name
    words = map_page.locator(".distance").inner_text()
    at = {each["site"]: np.array([each[f"{axis}_mm"] for axis in "xyz"]) for each in chamber["sites"]}
    mm = float(np.linalg.norm(at[name] - at[earliest]))
    assert words.startswith(f"From the tip at {name} to the earliest site {earliest}: {mm:.1f} mm (95 %: ")
    for catheter in ("reference", "pacing", "mapping"):
        expect(map_page.locator(".scene .labels .catheter", has_text=catheter)).to_have_count(1)


def test_the_map_follows_the_frames_while_they_play(map_page: Any) -> None:
    shown = [map_page.locator(f".fused[data-fused={view}]") for view in "ab"]
    map_page.get_by_role("button", name="Play the map over fluoroscopy").click()
    for each in shown:
        each.evaluate(
            "view => new Promise(done => { const look = () =>"
            " Number(view.dataset.frames) > 30 ? done() : requestAnimationFrame(look); look(); })"
        )
    map_page.get_by_role("button", name="Pause the map over fluoroscopy").click()
    tips = set()
    for frame in (1, 5, 9):
        map_page.get_by_label("Frame of the map over view a").fill(str(frame))
        tips.add(shown[0].get_attribute("data-tip"))
    assert len(tips) == 3


def test_found_electrodes_are_shown_and_hidden(map_page: Any, mapped_study: tuple[str, str]) -> None:
    place = placement(map_page, mapped_study[1], "a")
    electrodes = place["frames"][place["frame"] - 1]["electrodes"]
    plain = on_canvas(map_page, "a")
    map_page.get_by_label("found electrodes").check()
    marked = on_canvas(map_page, "a")
    assert len(electrodes) == 12
    for each in electrodes:
        u, v = round(each["u_px"]), round(each["v_px"])
        around = np.s_[max(0, v - 7) : v + 8, max(0, u - 7) : u + 8]
        assert (marked[around] != plain[around]).any()
    map_page.get_by_label("found electrodes").uncheck()
    assert (on_canvas(map_page, "a") == plain).all()


def test_colours_uncertainty_and_time_change_every_view(map_page: Any) -> None:
    until = map_page.get_by_label("Activated until, ms")
    seen = [on_canvas(map_page, "a")]
    for change in (
        lambda: map_page.get_by_label("Colours").select_option("red-early"),
        lambda: map_page.get_by_label("uncertainty instead of time").check(),
        lambda: until.fill(str(round((float(until.get_attribute("min")) + float(until.get_attribute("max"))) / 2))),
    ):
        change()
        seen.append(on_canvas(map_page, "a"))
        assert (seen[-1] != seen[-2]).mean() > 0.01


def test_a_browser_without_webgl_shows_the_outline_and_the_sites(page: Any, mapped_study: tuple[str, str]) -> None:
    page.add_init_script(
        "const real = HTMLCanvasElement.prototype.getContext;"
        "HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {"
        "  return kind.startsWith('webgl') ? null : real.call(this, kind, ...rest); };"
    )
    page.goto(f"/studies/{mapped_study[0]}#map")
    page.get_by_text("This browser cannot draw in 3D").wait_for()
    page.locator(".fused[data-frames]").nth(1).wait_for()
    assert 0.001 < coloured(on_canvas(page, "a")).mean() < 0.05
