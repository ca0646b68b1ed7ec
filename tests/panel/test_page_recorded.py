"""The panel's page in a browser: runs that are compared, the map of a sweep, a blind comparison."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from browser import Window, chromium, window
from fake_run import PanelBeside, wait_until
from recorded_folder import strike_rows, write_run
from rig import settings_with

from canwall.sweep import make_plan, sweep

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.slow

#: A map of 3 by 3 walls, of two laws.
AXES = {
    "law": ["standard", "half_sample"],
    "delay": 1,
    "stiffness_normalised": "0.01:0.6:3",
    "damping_normalised": "0:0.8:3",
    "operator": "finger",
    "servo": "ideal",
    "speed": 0.5,
    "phase": 0.35,
}


@pytest.fixture(scope="module")
def browser() -> "Iterator[Browser]":
    with chromium() as opened:
        yield opened


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two runs, of which the second one has twice the stiffness, and a sweep."""
    folder = tmp_path_factory.mktemp("recorded")
    settings, rows, units = strike_rows()
    write_run(folder / "soft", settings, rows, units)
    stiffer = rows.copy()
    stiffer["stiffness_in_force"] *= 2.0
    stiffer["force_applied"] *= 2.0
    write_run(folder / "stiff", settings, stiffer, units)
    sweep(make_plan(settings_with(), AXES), folder / "map.nc")
    return folder


@pytest.fixture
def page(browser: "Browser", recorded: Path) -> Iterator[Window]:
    with PanelBeside(recorded) as panel:
        address = f"http://{panel.address}/?token={panel.server.access.token}"
        with window(browser, address) as opened:
            opened.page.wait_for_selector("#begin", state="visible")
            opened.page.keyboard.press("o")
            yield opened


#: Keeps the left and right ends of the times below a plot, as it draws them [pixels].
LABELS = """() => {
  window.labels = [];
  const draw = CanvasRenderingContext2D.prototype.fillText;
  CanvasRenderingContext2D.prototype.fillText = function (text, x, ...rest) {
    const half = this.measureText(text).width / 2;
    if (text.endsWith(" ms")) window.labels.push([x - half, x + half]);
    draw.call(this, text, x, ...rest);
  };
}"""


def pixels(page: Window, canvas: str) -> list[int]:
    """Pixels of a canvas, as numbers from 0 to 255."""
    found: list[int] = page.page.evaluate(
        """(name) => { const c = document.querySelector(name);
            return [...c.getContext('2d').getImageData(0, 0, c.width, c.height).data]; }""",
        canvas,
    )
    return found


def test_compares_two_runs(page: Window) -> None:
    page.page.click("#items button:has-text('soft')")
    page.page.wait_for_selector("#strikes td, #strikes th")
    page.page.wait_for_function("() => document.querySelector('#compare').options.length === 2")
    before = pixels(page, "#rec-stiffness canvas")
    with page.page.expect_response("**/signals?*") as asked:
        page.page.select_option("#compare", label="stiff")
    assert asked.value.ok
    page.wait_for_text("compare-legend", "soft stiff")
    wait_until(lambda: pixels(page, "#rec-stiffness canvas") != before)
    with page.page.expect_response("**/signals?*") as asked:
        page.page.select_option("#align", "contact")
    assert asked.value.ok
    assert page.violations() == []
    page.page.keyboard.press("t")
    assert page.violations() == []


def test_strike_of_a_point_of_a_map(page: Window) -> None:
    page.page.click("#items button:has-text('map')")
    page.wait_for_text("sweep-text", "Click, or press Enter")
    assert page.violations() == []
    page.page.select_option("#sweep-choices select", label="half sample")
    page.page.evaluate(LABELS)
    page.page.set_viewport_size({"width": 1230, "height": 900})  # a label every 55 pixels
    place = page.page.locator("#sweep").bounding_box()
    assert place is not None
    with page.page.expect_response("**/strike") as asked:
        page.page.mouse.click(place["x"] + 0.5 * place["width"], place["y"] + 0.3 * place["height"])
    assert asked.value.ok
    assert asked.value.request.post_data_json["indices"]["law"] == 1
    page.wait_for_text("sweep-text", "half_sample")
    clicked = page.text("sweep-text")
    assert "differs" not in clicked
    assert page.page.is_visible("#strike-place")
    wait_until(lambda: bool(page.page.evaluate("() => window.labels.length")))
    labels = page.page.evaluate("() => window.labels")
    gaps = [right[0] - left[1] for left, right in itertools.pairwise(labels) if right > left]
    assert min(gaps) > 8.0
    drawn = pixels(page, "#strike-force canvas")
    page.page.keyboard.press("ArrowDown")
    with page.page.expect_response("**/strike") as asked:
        page.page.keyboard.press("Enter")
    assert asked.value.ok
    page.wait_for_text("sweep-text", "half_sample")
    assert page.text("sweep-text") != clicked
    wait_until(lambda: pixels(page, "#strike-force canvas") != drawn)
    assert page.violations() == []


def test_blind_comparison_is_accessible_and_hides_the_wall(
    browser: "Browser", tmp_path: Path
) -> None:
    with PanelBeside(tmp_path) as panel:
        run = panel.begin_run()
        address = f"http://{panel.address}/?token={panel.server.access.token}"
        with window(browser, address) as page:
            page.wait_for_text("run-state", "wall in force")
            page.page.click("#tab-compare")
            page.page.click("#blind-begin")
            page.wait_for_text("blind-hint", "Wall 1 is in force")
            wait_until(lambda: any("stiffness_nm_per_rad" in each for each in run.requests))
            page.wait_for_text("k-law", "hidden")
            assert not page.page.is_visible("#scene")
            assert page.violations() == []
            page.page.keyboard.press("t")
            assert page.violations() == []
            page.page.keyboard.press("1")  # before both have been felt
            page.wait_for_text("said", "feel wall 2 before you answer")
