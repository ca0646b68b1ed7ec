"""The panel's page in a browser, with a run that it starts: what it changes is on the bus."""

import math
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from browser import Window, chromium, window
from commands import Record, config_file
from fake_run import wait_until

from canwall.panel.opening import open_panel
from canwall.record import RunFolder

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.slow

#: Plain laws, of which a frame tells everything; a run in real time that goes on although the
#: machine has other things to do.
CHANGES = {
    "cycle_s = 0.001 ": "cycle_s = 0.004 ",
    "watchdog_s = 0.1 ": "watchdog_s = 5.0 ",
    "adapt = true ": "adapt = false ",
    'law = "mean_force"         #': 'law = "standard" #',
    "stiffness_nm_per_rad = 50.0\n": "stiffness_nm_per_rad = 1.0\n",
    "damping_ratio = 0.5 ": "damping_ratio = 0.0 ",
    "cap = 0.8 ": "cap = 0.0 ",
    "hold_cycles = 2 ": "hold_cycles = 100 ",
    "late_cycles = 50 ": "late_cycles = 0 ",
    "stuck_rad = 0.0006 ": "stuck_rad = 0.0 ",
}
RAD_PER_COUNT = 2.0 * math.pi / 131072
RATED_NM = 0.637
#: Cycles until a wall has been blended into another one.
BLENDED = 15
#: Cycles until a wall that surrounds the handle at the start has faded in.
FADED_IN = 150
ENABLE_OPERATION = 0x0F


@pytest.fixture(scope="module")
def browser() -> "Iterator[Browser]":
    with chromium() as opened:
        yield opened


@contextmanager
def panel(config: Path) -> Iterator[str]:
    """A panel that offers a configuration; its address."""
    opened = open_panel(config)
    ready = threading.Event()
    thread = threading.Thread(target=opened.server.serve, args=(ready.set,))
    thread.start()
    try:
        assert ready.wait(30.0)
        yield f"http://127.0.0.1:{opened.server.port}/?token={opened.server.access.token}"
    finally:
        opened.server.end()
        thread.join()


def change(page: Window, field: str, value: float) -> int:
    """Give a field a value; return the cycle from which on it is in force."""
    page.page.locator(field).fill(str(value))
    page.page.evaluate("() => document.activeElement.blur()")
    return in_force(page)


def in_force(page: Window) -> int:
    """Wait for the answer to a change; return the cycle from which on it is in force."""
    page.wait_for_text("said", "in force since cycle")
    cycle = int(page.text("said").split()[-1])
    page.page.evaluate("() => { document.getElementById('said').textContent = ''; }")
    return cycle


def presses(page: Window) -> None:
    """Wait until the handle has pressed on the wall for a while after now."""
    force = "parseFloat(document.getElementById('k-force').textContent)"
    page.page.wait_for_function(f"() => {force} === 0")
    page.page.wait_for_function(f"() => {force} > 0.02")
    page.page.wait_for_timeout(300)


class Frames:
    """Positions and torques of a run, cycle by cycle, from bus.log alone."""

    def __init__(self, folder: Path) -> None:
        cycles = Record(folder).cycles
        self.controlwords, self.torques = zip(
            *(struct.unpack("<Hh", rpdo[:4]) for _, rpdo in cycles), strict=True
        )
        self.positions = [
            struct.unpack_from("<i", tpdo)[0] * RAD_PER_COUNT if tpdo else math.nan
            for tpdo, _ in cycles
        ]

    def pressed(self, surface: float, first: int, last: int) -> Iterator[tuple[float, bool, int]]:
        """Cycles in contact between two changes: depth [rad], if it shrinks, torque [‰]."""
        y = self.positions
        for j in range(first + BLENDED, last):
            if y[j] < surface:
                yield surface - y[j], y[j] > y[j - 1], self.torques[j]


@dataclass
class Wall:
    """A wall of the plain laws, as the changes of a run leave it."""

    law: str = "standard"
    stiffness: float = 1.0
    softening: float = 1.0
    limit_nm: float = 1.9
    surface: float = 0.0

    def change(self, event: dict[str, Any]) -> None:
        """Apply a change of events.jsonl."""
        self.stiffness = event.get("stiffness_nm_per_rad", self.stiffness)
        self.surface = event.get("position_rad", self.surface)
        self.limit_nm = event.get("limits", {}).get("torque_nm", self.limit_nm)
        if "law" in event:
            self.law, self.softening = event["law"], 0.8
        self.softening = event.get("options", {}).get("softening", self.softening)

    def per_mille(self, depth: float, leaves: bool) -> float:
        """Torque that the wall answers a depth with [‰ of the rated torque]."""
        eases = leaves and self.law == "hysteresis"
        force = self.stiffness * depth * (self.softening if eases else 1.0)
        return 1000.0 * min(force, self.limit_nm) / RATED_NM


def compare_blind(page: Window) -> None:
    """Take two walls, switch between them, and compare them blind."""
    page.page.click("#tab-compare")
    page.page.click("#ab-take-a")
    page.page.keyboard.press("Shift+ArrowLeft")
    in_force(page)
    page.page.wait_for_function("() => document.getElementById('stiffness').value === '1.25'")
    page.page.click("#ab-take-b")
    page.wait_for_text("said", "A and B can be switched")
    for which in ("a", "b"):
        page.page.keyboard.press("b")
        in_force(page)
        page.page.wait_for_selector(f"#ab-{which}[aria-pressed=true]")
        presses(page)
    page.page.select_option("#blind-with", "ab")
    page.page.fill("#blind-repeats", "2")
    page.page.click("#blind-begin")
    page.wait_for_text("blind-title", "trial 1 of 2")
    page.wait_for_text("k-law", "hidden")
    page.wait_for_text("k-stiffness", "–")
    for trial in (1, 2):
        page.wait_for_text("blind-title", f"trial {trial} of 2")
        for wall in (1, 2):
            page.wait_for_text("blind-hint", f"Wall {wall} is in force")
            presses(page)
            if wall == 1:
                page.page.keyboard.press("b")
        page.page.keyboard.press("2")
    page.page.wait_for_selector("#blind-table td")
    page.page.click("#blind-end")


def climb_stairs(page: Window) -> None:
    """Take a staircase of two walls: the first one is free of chatter, the second one is not."""
    page.page.select_option("#blind-procedure", "staircase")
    for field, value in (("start", 0.8), ("ceiling", 1.6), ("finest", 2)):
        page.page.fill(f"#blind-{field}", str(value))
    page.page.click("#blind-begin")
    for trial, answer in ((1, "1"), (2, "2")):
        page.wait_for_text("blind-title", f"Staircase, trial {trial}")
        presses(page)
        page.page.keyboard.press(answer)
    page.page.wait_for_selector("#blind-table td")
    limits = [float(text) for text in page.page.locator("#blind-table td").all_inner_texts()[1:3]]
    assert limits == [0.8, 1.6]
    page.page.click("#blind-end")


def slide(page: Window, slider: str, share: float) -> int:
    """Click on a slider; return the cycle from which on what it says is in force."""
    place = page.page.locator(slider).bounding_box()
    assert place is not None
    page.page.mouse.click(place["x"] + share * place["width"], place["y"] + 0.5 * place["height"])
    return in_force(page)


def open_record(page: Window, name: str) -> None:
    """Open the record of a run, and look closer."""
    page.page.keyboard.press("o")
    page.page.click(f"#items button:has-text('{name}')")
    page.page.wait_for_selector("#strikes td, #strikes th")
    page.wait_for_text("zoom-text", "0.000 …")
    whole = page.text("zoom-text")
    with page.page.expect_response("**/signals?*") as asked:
        page.page.keyboard.press("+")
    assert asked.value.ok
    assert page.text("zoom-text") != whole


def test_page_changes_what_is_on_the_bus(
    browser: "Browser", tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "presets"))
    config = config_file(tmp_path / "soft.toml", CHANGES)
    with panel(config) as address, window(browser, address) as page:
        page.page.set_default_timeout(120_000)  # the run may have to be compiled
        page.page.wait_for_selector("#start")
        page.page.wait_for_function("() => document.getElementById('config').value !== ''")
        page.page.keyboard.press("r")
        page.wait_for_text("run-state", "wall in force")
        presses(page)
        presses(page)  # of the first press, the wall that fades in may have had all
        at = [slide(page, "#stiffness-slider", 0.1)]
        slid = float(page.page.input_value("#stiffness"))
        presses(page)
        at.append(change(page, "#stiffness", 1.5))
        page.page.click("#tab-compare")
        page.page.fill("#preset-name", "soft")
        page.page.click("#preset-save")
        page.wait_for_text("presets", "soft")
        page.page.click("#tab-wall")
        presses(page)
        page.page.get_by_label("hysteresis").click(force=True)
        at.append(in_force(page))
        page.page.wait_for_selector("#options input")
        at.append(change(page, "#options label:first-child input", 0.5))  # softening
        presses(page)
        compare_blind(page)
        climb_stairs(page)
        page.page.click("#presets button:has-text('soft')")
        at.append(in_force(page))
        presses(page)
        page.page.click("#ab-b")
        in_force(page)
        page.page.click("#tab-limits")
        at.append(change(page, "#limit-fields label:first-child input", 0.04))
        presses(page)
        page.page.keyboard.press("m")
        page.wait_for_text("marks", "mark")
        page.page.click("#tab-wall")
        at.append(change(page, "#position", 150))  # where the handle is in the wall all the time
        page.page.wait_for_timeout(300)
        page.page.keyboard.press("Space")
        page.wait_for_text("stop-state", "stopped: zero torque, confirmed after")
        page.wait_for_text("begin-text", "stopped by another process, the panel or a script")
        stopped = int(page.text("begin-text").split()[1])  # cycle …
        (folder,) = (tmp_path / "runs").iterdir()
        record = RunFolder(folder)
        wait_until(lambda: record.summary.exists() and not record.is_being_written)
        open_record(page, folder.name)
    frames = Frames(folder)
    events = record.read_events()
    assert any(event["what"] == "mark" for event in events)
    changes = [event for event in events if event["what"] == "change"]
    assert set(at) <= {change["cycle"] for change in changes}
    wall, first = Wall(), frames.controlwords.index(ENABLE_OPERATION) + FADED_IN
    met = set()
    for event in [*changes, {"cycle": stopped}]:
        for depth, leaves, torque in frames.pressed(wall.surface, first, event["cycle"]):
            assert abs(torque - wall.per_mille(depth, leaves)) <= 1.0
            met.add((wall.law, wall.stiffness, wall.softening, wall.limit_nm, wall.surface))
        wall.change(event)
        first = event["cycle"]
    assert met >= {
        ("standard", 1.0, 1.0, 1.9, 0.0),
        ("standard", slid, 1.0, 1.9, 0.0),
        ("standard", 1.5, 1.0, 1.9, 0.0),
        ("hysteresis", 0.8, 0.5, 1.9, 0.0),  # the staircase
        ("hysteresis", 1.6, 0.5, 1.9, 0.0),
        ("hysteresis", 1.5, 0.5, 1.9, 0.0),  # A
        ("hysteresis", 1.25, 0.5, 1.9, 0.0),  # B
        ("hysteresis", 1.25, 0.5, 0.04, 0.0),
        ("hysteresis", 1.25, 0.5, 0.04, 0.15),
    }
    # In contact, torque up to the stop; none from then on, and only then the way out.
    assert frames.torques[stopped - 1] > 0
    assert not any(frames.torques[stopped:])
    assert frames.controlwords[stopped] == ENABLE_OPERATION
    assert frames.controlwords[-1] != ENABLE_OPERATION
