"""A real browser without a window for the tests of pages: the system's Chromium, driven by Playwright."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

PHONE = (360, 740)
DESKTOP = (1200, 900)


@contextmanager
def open_page(path: Path, size: tuple[int, int] = DESKTOP, dark: bool = False) -> Iterator[Any]:
    """Yield the page, opened without a network; whatever it complains about fails the test at the end."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    names = [os.environ.get("CHROME", ""), "chromium", "chromium-browser", "google-chrome"]
    browser_path = next((found for name in names if name and (found := shutil.which(name))), None)
    if browser_path is None:
        pytest.skip("no Chromium found: install chromium, or name one in CHROME")
    complaints: list[str] = []
    with playwright.sync_playwright() as driver:
        # Chromium refuses to run as root with its sandbox, and the page is our own.
        browser = driver.chromium.launch(executable_path=browser_path, args=["--no-sandbox"])
        context = browser.new_context(
            viewport={"width": size[0], "height": size[1]},
            color_scheme="dark" if dark else "light",
            offline=True,
            has_touch=size == PHONE,
        )
        page = context.new_page()
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("requestfailed", lambda request: complaints.append(request.url[:100]))
        page.goto(path.as_uri())
        yield page
        browser.close()
    assert complaints == []


def assert_page_works(path: Path) -> None:
    """Assert that a page with a comparison complains about nothing, fits a phone, and its divider moves."""
    with open_page(path) as page:
        divider = page.locator(".divider input").first
        divider.scroll_into_view_if_needed()
        box = divider.bounding_box()

        def at() -> float:
            style = "getComputedStyle(document.querySelector('.compare')).getPropertyValue('--at')"
            return float(page.evaluate(style).rstrip("%"))

        assert at() == 50
        middle = box["y"] + box["height"] / 2
        page.mouse.move(box["x"] + box["width"] * 0.5, middle)
        page.mouse.down()
        page.mouse.move(box["x"] + box["width"] * 0.2, middle, steps=4)
        page.mouse.up()
        dragged = at()
        assert dragged == pytest.approx(20, abs=2)
        divider.focus()
        page.keyboard.press("ArrowRight")
        assert at() > dragged
        page.keyboard.press("Home")
        assert at() == 0

        left = page.locator(".compare select").first
        before = page.locator(".picture.left img").first.get_attribute("alt")
        left.select_option(index=left.locator("option").count() - 1)
        assert page.locator(".picture.left img").first.get_attribute("alt") != before
        views = page.locator(".compare").first.get_by_label("View").locator("option")
        if views.count() > 1:
            page.get_by_label("View").first.select_option(index=1)
            scale = "new DOMMatrix(getComputedStyle(document.querySelector('.picture.left img')).transform).a"
            assert page.evaluate(scale) > 1
        broken = "[...document.images].filter(image => !image.complete || !image.naturalWidth).length"
        assert page.evaluate(broken) == 0
    for dark in (False, True):
        with open_page(path, PHONE, dark) as page:
            assert page.evaluate("document.documentElement.scrollWidth") <= PHONE[0]
            divider = page.locator(".divider input").first
            divider.scroll_into_view_if_needed()
            box = divider.bounding_box()
            page.touchscreen.tap(box["x"] + box["width"] * 0.75, box["y"] + box["height"] / 2)
            assert float(divider.input_value()) == pytest.approx(75, abs=3)
