"""Electrodes set by hand are stored in order; "stored" means that nothing is on its way, and a job waits for it."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from playwright.sync_api import expect

ELECTRODES = "**/frames/*/electrodes"


def test_a_quick_hand_sees_stored_after_the_last_change_and_computes_with_it(
    page: Any, own_study: str, click_pixel: Callable[..., None]
) -> None:
    held: list[Any] = []
    order: list[str] = []

    def refuse(route: Any) -> None:
        order.append("job")
        body = json.dumps({"code": "refused", "detail": "This test computes nothing.", "status": 422})
        route.fulfill(status=422, body=body, content_type="application/problem+json")

    def is_stored(response: Any) -> None:
        if response.request.method == "PUT":
            order.append("stored")

    page.route(ELECTRODES, lambda route: held.append(route))
    page.route("**/v1/studies/*/jobs", refuse)
    page.on("response", is_stored)
    page.goto(f"/studies/{own_study}#electrodes")
    page.locator(".view[data-view=a][data-electrodes='12'][data-frames]").wait_for()
    status = page.locator(".view[data-view=a] .status")
    page.get_by_label("Catheter to mark").select_option("mapping")
    page.get_by_role("button", name="Mark from the tip").click()
    with page.expect_request(ELECTRODES):
        click_pixel(page, "a", 200, 200)
    click_pixel(page, "a", 220, 200)
    # The first change is stored when the request of the second begins.
    with page.expect_request(ELECTRODES):
        held[0].continue_()
    assert status.inner_text() == "storing"

    page.get_by_role("button", name="Compute the map again").click()
    assert order == ["stored"]
    held[1].continue_()
    page.get_by_text("This test computes nothing.").wait_for()
    assert order == ["stored", "stored", "job"]
    expect(status).to_have_text("stored")
