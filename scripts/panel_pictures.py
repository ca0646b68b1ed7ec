"""Takes the pictures of the panel in docs/panel."""

import os
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Browser, Page, TimeoutError, sync_playwright

from canwall import config
from canwall.panel.opening import open_panel

TARGET = Path(__file__).parents[1] / "docs/panel"

#: Patience with a machine that draws the pages meanwhile.
PATIENT = {
    "watchdog_s = 0.1 ": "watchdog_s = 5.0 ",
    "late_cycles = 50 ": "late_cycles = 0 ",
    "hold_cycles = 2 ": "hold_cycles = 100 ",
}

#: A small Z-width map for the picture of a sweep.
SWEEP = ["--law", "standard", "--stiffness", "2:200:16", "--damping", "0:0.2:9"]


def main() -> None:
    """Start a panel in a folder of its own, and take the pictures."""
    TARGET.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        sweep(Path(folder))
        with panel() as address, sync_playwright() as playwright:
            browser = playwright.chromium.launch(
                executable_path=shutil.which("chromium"), args=["--no-sandbox"]
            )
            try:
                take(browser, address)
            finally:
                browser.close()


def sweep(folder: Path) -> None:
    """Write a sweep beside the runs."""
    (folder / "runs").mkdir()
    subprocess.run(
        [
            sys.executable,
            "-m",
            "canwall",
            "sweep",
            str(config.shipped("config/sim.toml")),
            *SWEEP,
            "--output",
            "runs/z-width.nc",
        ],
        check=True,
        stdout=subprocess.DEVNULL,
    )


@contextmanager
def panel() -> Iterator[str]:
    """A panel on the folder of runs; its address."""
    text = config.shipped("config/sim.toml").read_text()
    text = text.replace("../eds/canwall-drive.eds", str(config.shipped("eds/canwall-drive.eds")))
    for usual, patient in PATIENT.items():
        text = text.replace(usual, patient)
    Path("sim.toml").write_text(text)
    opened = open_panel(Path("sim.toml"))
    ready = threading.Event()
    thread = threading.Thread(target=opened.server.serve, args=(ready.set,))
    thread.start()
    try:
        ready.wait()
        yield f"{opened.server.url}?token={opened.server.access.token}"
    finally:
        opened.server.end()
        thread.join()


def take(browser: Browser, address: str) -> None:
    """Take all pictures, of one run from its start to its record."""
    page = browser.new_page(viewport={"width": 1920, "height": 1080}, color_scheme="light")
    page.set_default_timeout(120_000)
    page.goto(address)
    page.wait_for_selector("#config option", state="attached")
    page.keyboard.press("r")
    until_text(page, "run-state", "wall in force")
    page.wait_for_timeout(9_000)  # until the plots have forgotten how the hand lay in the wall
    pressing(page)
    picture(page, "light")
    page.keyboard.press("2")  # the plain wall
    page.wait_for_timeout(4_000)
    page.keyboard.press("t")
    pressing(page)
    picture(page, "dark")
    page.keyboard.press("1")
    page.wait_for_timeout(7_000)  # until the plots have forgotten the plain wall
    page.keyboard.press("t")
    page.set_viewport_size({"width": 390, "height": 844})
    pressing(page)
    picture(page, "phone")
    page.set_viewport_size({"width": 1440, "height": 900})
    page.click("#tab-compare")
    page.click("#ab-take-a")
    page.keyboard.press("Shift+ArrowRight")
    until_text(page, "said", "in force")
    page.wait_for_timeout(600)
    page.click("#ab-take-b")
    page.wait_for_timeout(300)
    page.click("#blind-begin")
    page.wait_for_selector("#blind", state="visible")
    page.wait_for_timeout(800)
    picture(page, "blind")
    page.click("#blind-end")
    page.wait_for_timeout(500)
    page.click("#blind-end")  # close what it found
    pressing(page)
    page.keyboard.press("Space")
    until_text(page, "stop-state", "stopped")
    until_text(page, "run-state", "run ended")
    picture(page, "stopped")
    until_recorded(page)
    page.click("#items button:has-text('strikes')")
    page.wait_for_timeout(1_500)
    picture(page, "recorded")
    page.click("#items button:has-text('z-width')")
    page.wait_for_timeout(1_500)
    page.click("#sweep", position={"x": 400, "y": 200})
    page.wait_for_selector("#strike-place", state="visible")
    page.wait_for_timeout(1_000)
    picture(page, "sweep", full_page=True)


def until_text(page: Page, identity: str, words: str) -> None:
    """Wait until an element has these words."""
    page.wait_for_function(
        "([id, words]) => document.getElementById(id).textContent.includes(words)",
        arg=[identity, words],
    )


def until_recorded(page: Page) -> None:
    """Open the list of what is recorded, with the run in it."""
    page.keyboard.press("o")
    for _ in range(60):
        page.click("#reload")
        page.wait_for_timeout(500)
        if page.locator("#items button:has-text('strikes')").count():
            return
    raise SystemExit("panel_pictures.py: the run is not in the list")


def pressing(page: Page) -> None:
    """Wait until the handle presses on the wall."""
    force = "parseFloat(document.getElementById('k-force').textContent)"
    try:
        page.wait_for_function(f"() => {force} === 0")
        page.wait_for_function(f"() => {force} > 0.1")
    except TimeoutError:
        raise SystemExit(f"panel_pictures.py: {page.inner_text('#begin-text')}") from None
    page.wait_for_timeout(200)


def picture(page: Page, name: str, full_page: bool = False) -> None:
    """Take a picture."""
    page.screenshot(path=TARGET / f"{name}.png", full_page=full_page)


if __name__ == "__main__":
    main()
