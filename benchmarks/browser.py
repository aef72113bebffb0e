"""The browser in which benchmarks open the pages of the service."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from playwright.sync_api import Page, sync_playwright

from fluoromap_service.cli.supervisor import PrivateService

ARGUMENTS = ["--no-sandbox", "--enable-unsafe-swiftshader"]
PATIENCE_MS = 240_000


@contextmanager
def open_page(service: PrivateService) -> Iterator[Page]:
    """Open Chromium as on a machine without a graphics card, signed in to a service."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        sys.exit("There is no Chromium to open the pages in; install it (on Debian: apt-get install chromium).")
    with sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=browser, args=ARGUMENTS)
        page = opened.new_page(viewport={"width": 1280, "height": 900}, base_url=service.url)
        page.set_default_timeout(PATIENCE_MS)
        page.goto(service.sign_in_link())
        page.wait_for_url(f"{service.url}/")
        yield page
        opened.close()
