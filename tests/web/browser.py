"""A real browser for the pages; modules that import this are skipped where there is none."""

from __future__ import annotations

import contextlib
import os
import shutil
from typing import TYPE_CHECKING

import pytest

from tests.web.sitekit import TOKEN

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from playwright.async_api import ConsoleMessage, Error, Page

playwright = pytest.importorskip(
    "playwright.async_api", reason="needs playwright, of the extra dev"
)

CHROMIUM = os.environ.get("CHROMIUM") or next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
if CHROMIUM is None:
    pytest.skip("needs Chromium on the path, or named by CHROMIUM", allow_module_level=True)

BROWSER_MARKS = [pytest.mark.long, pytest.mark.real_time, pytest.mark.asyncio(loop_scope="module")]
"""The mark of a module that shows pages."""

PATIENCE = 60.0
"""Seconds; only what has gone wrong takes as long."""


@contextlib.asynccontextmanager
async def new_page(width: int = 1200, height: int = 900) -> AsyncIterator[Page]:
    """Start a browser and show an empty page."""
    async with playwright.async_playwright() as tool:
        browser = await tool.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = await browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(1000 * PATIENCE)
        yield page
        await browser.close()


async def see(page: Page, selector: str, text: str = "") -> None:
    """Wait until something is to be seen, with a text."""
    await page.locator(selector).filter(has_text=text).first.wait_for()


HIDE = """
hidden => {
  Object.defineProperty(document, "hidden", { configurable: true, get: () => hidden });
  document.dispatchEvent(new Event("visibilitychange"));
}
"""
"""Tells a page whether it is visible."""


async def pass_gate(page: Page) -> None:
    """See that a page asks for the token, refuses another one, and takes it."""
    await see(page, "#gate")
    await page.fill("#token", "not-the-token_of-24-chars")
    await page.click("#gate button")
    await see(page, "#gate-error", "Refused")
    await page.fill("#token", TOKEN)
    await page.click("#gate button")


@contextlib.contextmanager
def nothing_wrong(page: Page) -> Iterator[None]:
    """Fail where the browser finds something wrong with the page."""
    wrong: list[str] = []

    def on_error(error: Error) -> None:
        wrong.append(str(error))

    def on_console(said: ConsoleMessage) -> None:
        # an answer that refuses is told here, too
        if said.type == "error" and "Failed to load resource" not in said.text:
            wrong.append(said.text)

    page.on("pageerror", on_error)
    page.on("console", on_console)
    yield
    page.remove_listener("pageerror", on_error)
    page.remove_listener("console", on_console)
    assert wrong == []
