"""The panel's page in a browser, at the real server, beside a run that is made up."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from browser import Window, chromium, window
from fake_run import CYCLE_S, FakeRun, PanelBeside, rows_of, wait_until

if TYPE_CHECKING:
    from playwright.sync_api import Browser, WebSocketRoute

pytestmark = pytest.mark.slow

#: A press of the handle, 10 mrad deep, and its rest, in 0.4 s.
PRESS = 0.05 - 0.06 * np.sin(np.linspace(0.0, np.pi, 400))


@pytest.fixture(scope="module")
def browser() -> "Iterator[Browser]":
    with chromium() as opened:
        yield opened


@contextmanager
def pressing(run: FakeRun) -> Iterator[None]:
    """Have the run publish one press after another, by the clock."""
    ended = threading.Event()

    def publish() -> None:
        cycle = 0
        while not ended.wait(0.02):
            part = PRESS[cycle % 400 : cycle % 400 + 20]
            run.publish(rows_of(part, cycle, force=np.maximum(-50.0 * part, 0.0)))
            cycle += 20
            run.status_now |= {"cycle": cycle, "t_s": cycle * CYCLE_S}

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@pytest.fixture
def panel(tmp_path: Path) -> Iterator[PanelBeside]:
    with PanelBeside(tmp_path) as beside:
        yield beside


def address(panel: PanelBeside) -> str:
    return f"http://{panel.address}/?token={panel.server.access.token}"


@contextmanager
def attached(
    browser: "Browser", panel: PanelBeside, **options: Any
) -> Iterator[tuple[Window, FakeRun]]:
    run = panel.begin_run()
    with window(browser, address(panel), **options) as opened:
        opened.wait_for_text("run-state", "wall in force")
        yield opened, run


def test_accessible_in_both_themes(browser: "Browser", panel: PanelBeside) -> None:
    with attached(browser, panel, color_scheme="light") as (page, run):
        with pressing(run):
            page.page.wait_for_selector(BARS)
        assert page.violations() == []
        page.page.keyboard.press("t")
        for tab in ("compare", "limits", "run"):
            page.page.click(f"#tab-{tab}")
            assert page.violations() == []
        page.page.keyboard.press("?")
        assert page.violations() == []
        page.page.keyboard.press("Escape")
        page.page.keyboard.press("o")
        page.page.wait_for_selector("#view-recorded", state="visible")
        assert page.violations() == []


def test_draws_what_the_run_publishes(browser: "Browser", panel: PanelBeside) -> None:
    with attached(browser, panel) as (page, run), pressing(run):
        page.page.wait_for_function(
            "() => Number(document.getElementById('k-force').textContent) > 0.3"
        )
        page.page.wait_for_selector(BARS)
        inked = """() => { const c = document.querySelector('#plot-force canvas');
            const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
            let n = 0; for (let i = 3; i < d.length; i += 4) n += d[i] > 0; return n; }"""
        before = page.page.evaluate(inked)
        page.page.wait_for_function(f"() => ({inked})() !== {before}")
        page.page.wait_for_function(
            "() => parseInt(document.getElementById('f-page').textContent) > 5"
        )


def test_fits_a_phone(browser: "Browser", panel: PanelBeside) -> None:
    with attached(browser, panel, viewport={"width": 360, "height": 740}) as (page, _):
        for view in ("l", "o"):
            page.page.keyboard.press(view)
            assert page.page.evaluate("document.documentElement.scrollWidth") <= 360
            assert page.page.is_visible("#stop")


#: Bars of contacts.
BARS = "#energy :is(.bar-passive, .bar-edge)"
FOCUS = ["#stiffness", "#stiffness-slider", "#tab-limits", "#theme", "#adapt", "#stop"]


def test_space_stops_whatever_has_the_focus(browser: "Browser", panel: PanelBeside) -> None:
    with attached(browser, panel) as (page, run):
        for n, focus in enumerate(FOCUS, start=1):
            page.page.focus(focus)
            page.page.keyboard.press("Space")
            wait_until(lambda n=n: run.stopped == n)
        page.wait_for_text("stop-state", "stopped: zero torque, confirmed after")
        assert page.page.get_attribute("#adapt", "aria-checked") == "true"  # not pressed too


def test_text_fields_keep_the_space_bar(browser: "Browser", panel: PanelBeside) -> None:
    with attached(browser, panel) as (page, run):
        page.page.click("#tab-run")
        page.page.focus("#mark-text")
        page.page.keyboard.type("first touch")
        assert page.page.input_value("#mark-text") == "first touch"
        assert run.stopped == 0
        page.page.keyboard.press("Enter")
        wait_until(lambda: run.requests == [{"do": "mark", "text": "first touch"}])
        page.page.keyboard.press("Shift+Space")
        wait_until(lambda: run.stopped == 1)


def test_beats_until_it_stops(browser: "Browser", panel: PanelBeside) -> None:
    with attached(browser, panel) as (page, run):
        wait_until(lambda: run.beats >= 5)
        page.page.keyboard.press("Space")
        wait_until(lambda: run.stopped == 1)
        time.sleep(0.3)
        beats = run.beats
        time.sleep(0.5)
        assert run.beats == beats


@pytest.mark.parametrize(
    ("timeout_s", "said"),
    [
        (0.0, "No beat is watched: use Ctrl-C at the terminal, or the emergency stop"),
        (2.0, "the run ends when its beat is missed, in 1."),
    ],
)
def test_stop_says_that_nobody_answers(
    browser: "Browser", panel: PanelBeside, timeout_s: float, said: str
) -> None:
    run = panel.begin_run()
    run.status_now["beat_timeout_s"] = timeout_s
    context = browser.new_context()

    def stuck(socket: "WebSocketRoute") -> None:
        """Pass everything on, but the stop."""
        server = socket.connect_to_server()
        socket.on_message(lambda text: None if '"stop"' in str(text) else server.send(text))

    context.route_web_socket("**/live", stuck)
    page = Window(context, address(panel))
    page.wait_for_text("run-state", "wall in force")
    page.wait_for_text("f-beat", "watched")
    page.page.keyboard.press("Space")
    page.wait_for_text("stop-state", said)
    assert page.text("stop-state").startswith("No answer from the server")
    context.close()


def _requests(run: FakeRun) -> list[dict[str, Any]]:
    return [request for request in run.requests if request["do"] != "watch_beat"]


CASES: list[tuple[Callable[[Any], None], dict[str, Any]]] = [
    (lambda page: page.keyboard.press("ArrowRight"), {"stiffness_nm_per_rad": 51.0}),
    (lambda page: page.keyboard.press("Shift+ArrowLeft"), {"stiffness_nm_per_rad": 41.6667}),
    (lambda page: page.locator("#stiffness-slider").fill("600"), {"stiffness_nm_per_rad": 63.1}),
    (lambda page: page.locator("#damping").fill("0.7"), {"damping_ratio": 0.7}),
    (lambda page: page.locator("#position").fill("20"), {"position_rad": 0.02}),
    (lambda page: page.get_by_label("allow").click(force=True), {"tension": "allow"}),
    (
        lambda page: page.get_by_label("act", exact=True).click(force=True),
        {"guard": {"action": "act"}},
    ),
    (lambda page: page.locator("#adapt").press("Enter"), {"operator": {"adapt": False}}),
]


def test_controls_ask_for_changes(browser: "Browser", panel: PanelBeside) -> None:
    with attached(browser, panel) as (page, run):
        for n, (move, change) in enumerate(CASES, start=1):
            # What the run has in force, which is always the same.
            page.page.wait_for_function("() => document.getElementById('stiffness').value === '50'")
            move(page.page)
            page.page.evaluate("() => document.activeElement.blur()")
            wait_until(lambda n=n: len(_requests(run)) == n)
            assert _requests(run)[-1] == {"do": "change", **change}
        page.wait_for_text("said", "in force since cycle 7")


def test_limits_only_go_down(browser: "Browser", panel: PanelBeside) -> None:
    with attached(browser, panel) as (page, run):
        page.page.click("#tab-limits")
        torque = page.page.locator("#limit-fields input").first
        torque.fill("2.5")
        torque.press("Tab")
        page.wait_for_text("said", "Torque: at most the 1.9 N·m in force")
        torque.fill("1.2")
        torque.press("Tab")
        wait_until(lambda: _requests(run) == [{"do": "change", "limits": {"torque_nm": 1.2}}])


def test_refusal_is_told_and_the_control_goes_back(browser: "Browser", panel: PanelBeside) -> None:
    with attached(browser, panel) as (page, run):
        page.page.wait_for_function("() => document.getElementById('stiffness').value === '50'")
        run.refusal = "stiffness_nm_per_rad: too stiff"
        page.page.keyboard.press("ArrowRight")
        page.wait_for_text("said", "too stiff")
        page.page.wait_for_function("() => document.getElementById('stiffness').value === '50'")


def test_second_page_watches_until_it_takes_control(browser: "Browser", panel: PanelBeside) -> None:
    with (
        attached(browser, panel) as (one, run),
        window(browser, address(panel)) as two,
    ):
        two.wait_for_text("notice", "This page watches, and can stop.")
        two.page.keyboard.press("ArrowRight")
        two.wait_for_text("said", "this page does not have control")
        two.page.click("#take-control")
        one.wait_for_text("notice", "This page watches")
        one.page.keyboard.press("Space")
        wait_until(lambda: run.stopped == 1)
