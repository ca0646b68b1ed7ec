"""The panel's page in Debian's Chromium, and what axe-core says of it."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserContext, Page

#: Rules of the WCAG, levels A and AA, and what axe-core calls best practice.
_RULES = {"runOnly": {"type": "tag", "values": ["wcag2a", "wcag2aa", "wcag21aa", "best-practice"]}}


@contextmanager
def chromium() -> Iterator["Browser"]:
    """A browser without a window; skips the test where there is none."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    executable = shutil.which("chromium")
    if executable is None:
        pytest.skip("needs chromium")
    with sync_api.sync_playwright() as playwright:
        # The sandbox does not start as root, and the only page is our own.
        browser = playwright.chromium.launch(executable_path=executable, args=["--no-sandbox"])
        yield browser
        browser.close()


class Window:
    """A page that is open, and what it said that it should not have."""

    def __init__(self, context: "BrowserContext", address: str) -> None:
        context.set_default_timeout(20_000)
        self.page: Page = context.new_page()
        self.errors: list[str] = []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on(
            "console",
            lambda message: message.type == "error" and self.errors.append(message.text),
        )
        self.page.goto(address)

    def text(self, identity: str) -> str:
        return self.page.inner_text(f"#{identity}")

    def wait_for_text(self, identity: str, words: str) -> None:
        """Wait until an element has these words."""
        self.page.wait_for_function(
            "([id, words]) => document.getElementById(id).textContent.includes(words)",
            arg=[identity, words],
        )

    def violations(self) -> list[str]:
        """What axe-core finds wrong with the page as it is, once colours have changed."""
        self.page.wait_for_function(
            "() => !document.getAnimations().some((each) => each instanceof CSSTransition)"
        )
        axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="needs axe")
        found: dict[str, Any] = axe.Axe().run(self.page, options=_RULES).response
        return [
            f"{rule['id']}: {rule['help']}: {node['html'][:200]} {node['any'][:1]}"
            for rule in found["violations"]
            for node in rule["nodes"]
        ]


@contextmanager
def window(browser: "Browser", address: str, **options: Any) -> Iterator[Window]:
    """A page at an address, in a context of its own; it must not have reported errors."""
    options = {"viewport": {"width": 1440, "height": 900}} | options
    context = browser.new_context(**options)
    try:
        opened = Window(context, address)
        yield opened
        assert opened.errors == []
    finally:
        context.close()
