"""A real browser for tests."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from typing import Any

import pytest
from server_stubs import eventually

CHROMIUM = next(
    (
        path
        for name in ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
        if (path := shutil.which(name))
    ),
    None,
)

needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="needs the chromium binary: apt-get install chromium"
)

# Nothing but the page under test: no look-ups of the browser's own, no graphics card.
_ARGUMENTS = (
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-gpu",
    "--disable-quic",
    "--disable-sync",
    "--no-first-run",
    "--no-sandbox",
)


@contextlib.contextmanager
def chromium() -> Iterator[Any]:
    """A headless Chromium, as a playwright ``Browser``."""
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(_ARGUMENTS))
        try:
            yield browser
        finally:
            browser.close()


class Visit:
    """One page in a context of its own, with what went wrong in it.

    Attributes:
        page: a playwright ``Page``.
        complaints: errors on the console, and exceptions.
        asked: addresses of all requests.
    """

    def __init__(self, browser: Any, **context: Any) -> None:
        self._context = browser.new_context(**context)
        self.page = self._context.new_page()
        self.complaints: list[str] = []
        self.asked: list[str] = []
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on(
            "console",
            lambda said: self.complaints.append(said.text) if said.type == "error" else None,
        )

    def text(self, selector: str) -> str:
        """What one element says."""
        return str(self.page.locator(selector).first.inner_text())

    def wait(self, expression: str) -> None:
        """Returns when a JavaScript expression is true.

        Asked again and again from here: what waits inside the page would be against its policy.
        """
        eventually(lambda: self.page.evaluate(expression))

    def sideways(self) -> int:
        """Pixels by which the page is wider than the window."""
        return int(self.page.evaluate("document.documentElement.scrollWidth - innerWidth"))

    def close(self) -> None:
        """Ends the visit."""
        self._context.close()
