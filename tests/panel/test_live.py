"""Pages on real sockets of loopback, beside a run that the test makes up."""

import asyncio
import contextlib
import json
import signal
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
from fake_run import CYCLE_S, FakeRun, PanelBeside, rows_of, wait_until
from rig import settings_with
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from canwall import config
from canwall.analysis import metrics
from canwall.config import ConfigError
from canwall.cycle.state import MAX_LAWS
from canwall.panel import follower, session
from canwall.panel import server as panel_server
from canwall.panel.launch import Launcher, StartedRun
from canwall.panel.messages import Start
from canwall.panel.pages import MOST_PAGES, Outbox

PATIENCE_S = 30.0


@pytest.fixture
def beside(tmp_path: Path) -> Iterator[PanelBeside]:
    with PanelBeside(tmp_path) as panel:
        yield panel


class PageOf:
    """A page without a browser."""

    def __init__(self, connection: ClientConnection) -> None:
        self.socket = connection
        self.heard: list[Any] = []
        self._aside: list[Any] = []
        self._asked = 0

    @classmethod
    @contextlib.contextmanager
    def opened(cls, panel: PanelBeside) -> Iterator["PageOf"]:
        with connect(
            f"ws://{panel.address}/live",
            additional_headers=panel.bearer,
            max_size=None,
            max_queue=None,
            ping_interval=None,
        ) as connection:
            yield cls(connection)

    def hear(self) -> Any:
        message = self.socket.recv(timeout=PATIENCE_S)
        self.heard.append(json.loads(message) if isinstance(message, str) else message)
        return self.heard[-1]

    def until(self, condition: Callable[[Any], bool]) -> Any:
        """Hear until there is something of this kind; what was heard during `ask` comes first."""
        while True:
            message = self._aside.pop(0) if self._aside else self.hear()
            if condition(message):
                return message

    def event(self, name: str, /, **content: Any) -> dict[str, Any]:
        wanted = {"event": name} | content
        return self.until(lambda m: isinstance(m, dict) and wanted.items() <= m.items())

    def ask(self, do: str, **content: Any) -> dict[str, Any]:
        self._asked += 1
        self.socket.send(json.dumps({"id": self._asked, "do": do} | content))
        while True:
            message = self.hear()
            if isinstance(message, dict) and message.get("answer") == self._asked:
                return message
            self._aside.append(message)


@pytest.fixture
def open_page(beside: PanelBeside) -> Iterator[Callable[[], PageOf]]:
    with contextlib.ExitStack() as stack:

        def open_page() -> PageOf:
            return stack.enter_context(PageOf.opened(beside))

        yield open_page


@pytest.fixture
def run(beside: PanelBeside) -> FakeRun:
    return beside.begin_run()


@pytest.fixture
def page(run: FakeRun, open_page: Callable[[], PageOf]) -> PageOf:
    page = open_page()
    page.event("run", state="attached")
    page.event("status")
    return page


def decoded(frame: bytes) -> tuple[int, float, np.ndarray, np.ndarray]:
    """Kind, the header's number, times and values of a binary frame, as the page reads it."""
    kind, version, columns, points, number = struct.unpack_from("<BBHId", frame)
    assert version == 1
    times = np.frombuffer(frame, "<f8", points, 16)
    per_column = 2 if kind == 1 else 1
    values = np.frombuffer(frame, "<f4", offset=16 + 8 * points)
    return kind, number, times, values.reshape(columns, per_column, points)


def press(cycles: int = 3000) -> np.ndarray:
    """A handle that goes into the wall and out of it once a second."""
    return 0.01 * np.cos(np.arange(cycles) * 2.0 * np.pi / 1000.0)


def test_no_peak_is_lost(page: PageOf, run: FakeRun) -> None:
    y = np.random.default_rng(1).normal(0.0, 1.0, 1003)
    for part in np.array_split(rows_of(y, torque_cmd=np.arange(1003)), 17):
        run.publish(part)
    frames: list[Any] = []
    while sum(len(frame[2]) for frame in frames) < 250:
        message = page.until(lambda m: isinstance(m, bytes) and m[0] == 1)
        frames.append(decoded(message))
    times = np.concatenate([frame[2] for frame in frames])
    low, high = (np.concatenate([frame[3][:, k] for frame in frames], axis=1) for k in (0, 1))
    assert low.shape == (7, 250)
    assert np.array_equal(times, np.arange(0, 1000, 4) * CYCLE_S)
    buckets = y[:1000].reshape(-1, 4).astype(np.float32)
    assert np.array_equal(low[0], buckets.min(1))
    assert np.array_equal(high[0], buckets.max(1))
    assert np.array_equal(high[2], np.arange(3, 1000, 4))


def test_contacts_are_those_of_the_metrics(page: PageOf, run: FakeRun) -> None:
    y = press()
    force = np.maximum(-50.0 * y, 0.0) * (1.0 + 0.2 * (np.gradient(y) > 0.0))  # gives energy
    rows = rows_of(y, force_applied=force)
    found = metrics.contacts(y, force)
    assert len(found) == 3
    for part in np.array_split(rows, 101):
        run.publish(part)
        time.sleep(0.001)
    for n, contact in enumerate(found, start=1):
        event = page.event("contact")
        assert event["n"] == n
        assert event["start_s"] == pytest.approx(contact.start * CYCLE_S)
        assert event["end_s"] == pytest.approx((contact.stop - 1) * CYCLE_S)
        work = metrics.energy_out(y[contact], force[contact])
        assert event["energy_j"] == pytest.approx(work[-1])
        assert event["passive"] is False
        assert event["depth_rad"] == pytest.approx(0.01)
        assert event["stiffness"] == 50.0
        assert event["law"] == "mean_force"
    end_s = rows["t_s"][found[-1]][-1]
    page.until(lambda m: isinstance(m, bytes) and m[0] == 2 and end_s in decoded(m)[2])
    # Each row of contact is sent once, with a beginning before it.
    points: list[np.ndarray] = []
    for message in (m for m in page.heard if isinstance(m, bytes) and m[0] == 2):
        _, stiffness, times, values = decoded(message)
        assert stiffness == 50.0
        if not len(times):
            points.append(np.empty((3, 0)))
        points[-1] = np.concatenate([points[-1], [times, *values[:, 0]]], axis=1)
    assert [each.shape[1] for each in points] == [c.stop - c.start for c in found]
    assert np.array_equal(points[0][0], rows["t_s"][found[0]])
    assert np.array_equal(points[0][2], force[found[0]].astype(np.float32))


def test_a_contact_without_its_beginning_is_not_measured(page: PageOf, run: FakeRun) -> None:
    y = press(3000)
    run.publish(rows_of(y[500:1600], first=500))  # in contact at first
    run.publish(rows_of(y[2500:], first=2500))  # and after a gap
    run.publish(rows_of(press(1000), first=3000))
    assert page.event("contact")["start_s"] == pytest.approx(1.251, abs=0.002)
    assert page.event("contact")["start_s"] == pytest.approx(3.251, abs=0.002)


def test_passive_contact_and_chatter(page: PageOf, run: FakeRun) -> None:
    y = press(1000)
    lossy = np.maximum(-50.0 * y, 0.0) * (1.0 + 0.2 * (np.gradient(y) < 0.0))
    run.publish(rows_of(y, force_applied=lossy))
    assert page.event("contact")["passive"] is True
    assert not page.event("status", in_contact=False)["chatter"]
    buzz = -0.005 + 0.006 * np.cos(np.arange(1000) * 2.0 * np.pi * 80.0 * CYCLE_S)
    run.publish(rows_of(buzz, first=1000))
    status = page.event("status", chatter=True)
    assert status["chatter_hz"] == pytest.approx(80.0, abs=3.0)


def test_limits_and_marks(page: PageOf, run: FakeRun, beside: PanelBeside) -> None:
    run.publish(rows_of(np.full(1000, 0.1), torque_cmd=np.linspace(0.0, -0.95, 1000), v_est=3.0))
    status = page.until(lambda m: isinstance(m, dict) and len(m.get("limits", ())) > 0)
    used = {limit["name"]: limit["used"] for limit in status["limits"]}
    assert used["torque_nm"] == pytest.approx(0.5)  # of 1.9 N·m
    assert used["speed_rad_s"] == pytest.approx(0.05)
    line = json.dumps({"cycle": 5, "t_s": 0.005, "what": "mark", "text": "here"})
    events = beside.folder / "one" / "events.jsonl"
    events.write_text(f"{line}\n" + line[:10])
    assert page.event("marks")["marks"] == [json.loads(line)]
    events.write_text(f"{line}\n{line}\n")
    assert page.event("marks")["marks"] == [json.loads(line)]


def test_requests_reach_the_run(page: PageOf, run: FakeRun) -> None:
    change = {"stiffness_nm_per_rad": 80, "limits": {"torque_nm": 1.0}}
    assert page.ask("change", **change) == {"answer": 1, "ok": True, "cycle": 7}
    assert page.ask("take_turns", walls=[{"law": "midpoint"}, {"damping_ratio": 0.4}])["ok"]
    assert page.ask("mark", text="a strange noise")["ok"]
    assert page.ask("watch_beat", timeout_s=0.5)["ok"]
    assert page.ask("end")["ok"]
    assert [request["do"] for request in run.requests] == [
        "change",
        "take_turns",
        "mark",
        "watch_beat",
        "end",
    ]
    assert run.requests[0]["stiffness_nm_per_rad"] == 80.0
    assert run.requests[0]["limits"] == {"torque_nm": 1.0}
    run.refusal = "limits.torque_nm = 3: above that in force"
    assert page.ask("change", limits={"torque_nm": 3.0})["error"] == run.refusal


@pytest.mark.parametrize(
    ("message", "said"),
    [
        ("{", "not JSON"),
        ("[" * 60_000, "not JSON"),
        ('"stop"', "an object"),
        ("[]", "an object"),
        ('{"do": "stop"}', "id: has to be"),
        ('{"id": 1}', "do: has to be one of"),
        ('{"id": 1, "do": ["stop"]}', "do: has to be one of"),
        ('{"id": 1, "do": "__init__"}', "do: has to be one of"),
        ('{"id": 1, "do": "change", "stiffness_nm_per_rad": NaN}', "NaN"),
        ('{"id": 1, "do": "change", "stiffness_nm_per_rad": -1}', "stiffness_nm_per_rad"),
        ('{"id": 1, "do": "change", "stiffness_nm_per_rad": "80"}', "stiffness_nm_per_rad"),
        ('{"id": 1, "do": "change", "stiffness": 80}', "unknown key"),
        ('{"id": 1, "do": "change", "law": "a\\u0000"}', "NUL"),
        ('{"id": 1, "do": "change", "limits": {"position_rad": [-9, 9]}}', "unknown key"),
        ('{"id": 1, "do": "mark", "text": "%s"}' % ("x" * 201), "text"),
        ('{"id": 1, "do": "watch_beat", "timeout_s": 0.01}', "timeout_s"),
        ('{"id": 1, "do": "watch_beat", "timeout_s": 6}', "timeout_s"),
        ('{"id": 1, "do": "take_turns", "walls": [1]}', "walls"),
        ('{"id": 1, "do": "start", "config": ""}', "config"),
        ('{"id": 1, "do": "start"}', "a run is in progress"),
        ('{"id": 1, "do": "stop", "now": true}', "now: unknown key"),
        ('{"id": 1, "do": "preset_use", "name": "%s"}' % ("x" * 201), "has to be a shorter text"),
        (r'{"id": 1, "do": "mark", "text": "\ud83d"}', "text: has half of a surrogate pair"),
    ],
)
def test_what_is_wrong_is_told_and_not_passed_on(
    page: PageOf, run: FakeRun, message: str, said: str
) -> None:
    page.socket.send(message)
    answer = page.until(lambda m: isinstance(m, dict) and "answer" in m)
    assert answer["ok"] is False
    assert said in answer["error"]
    assert not run.requests
    assert not run.stopped
    assert page.ask("mark", text="still here")["ok"]


@pytest.mark.parametrize("seed", ["-1", "1" * 30, r'"\u0000"', r'"\ud83d"'])
def test_answer_has_the_number_of_a_request_with_a_value_that_is_none(
    page: PageOf, seed: str
) -> None:
    page.socket.send(f'{{"id": 5, "do": "blind_begin", "procedure": "staircase", "seed": {seed}}}')
    answer = page.until(lambda m: isinstance(m, dict) and "answer" in m)
    assert answer["answer"] == 5
    assert answer["error"].startswith("seed: ")


@pytest.mark.parametrize("message", ["x" * 65_537, b"\x00" * 65_537, b"bytes"])
def test_page_that_sends_what_no_page_does_is_closed(
    page: PageOf, open_page: Callable[[], PageOf], message: str | bytes
) -> None:
    other = open_page()
    page.socket.send(message)
    with pytest.raises(ConnectionClosed):
        page.until(lambda m: False)
    other.event("status")


def test_stop_passes_a_request_that_hangs(page: PageOf, run: FakeRun) -> None:
    run.takes.clear()
    for number in range(100, 120):
        page.socket.send(json.dumps({"id": number, "do": "mark", "text": "x"}))
    # One is being carried out and fifteen wait.
    refused = [page.until(lambda m: isinstance(m, dict) and "answer" in m) for _ in range(4)]
    assert all("too many requests" in answer["error"] for answer in refused)
    answer = page.ask("stop")
    assert answer["ok"]
    assert answer["confirmed"]
    assert run.stopped == 1
    assert not run.requests
    run.takes.set()
    wait_until(lambda: len(run.requests) == 16)


def test_stop_of_a_run_that_has_not_begun(
    beside: PanelBeside, open_page: Callable[[], PageOf]
) -> None:
    page = open_page()
    assert page.ask("stop")["error"] == "no run is in progress"
    with subprocess.Popen(["sleep", "60"]) as process:
        beside.session._starting = StartedRun(beside.folder, process, beside.folder / "output.txt")
        assert page.ask("stop") == {"answer": 2, "ok": True, "confirmed": False}
        assert process.wait(PATIENCE_S) == -signal.SIGINT


def test_two_starts_at_once_start_one_run(
    beside: PanelBeside, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = []
    with subprocess.Popen(["sleep", "60"]) as process:

        def start(self: Launcher, request: Start) -> StartedRun:
            time.sleep(0.2)
            runs.append(StartedRun(beside.folder, process, beside.folder / "output.txt"))
            return runs[-1]

        async def both() -> list[Any]:
            starts = [beside.session.start(Start()) for _ in range(2)]
            return await asyncio.gather(*starts, return_exceptions=True)

        monkeypatch.setattr(Launcher, "start", start)
        loop = beside.session._loop
        assert loop is not None
        _, refused = asyncio.run_coroutine_threadsafe(both(), loop).result(PATIENCE_S)
        process.kill()
    assert str(refused) == "a run is in progress; end it first"
    assert len(runs) == 1


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"law": "dampd"}, "unknown law 'dampd'; did you mean damped?"),
        ({"options": {"zz": 1.0}}, "law mean_force has no option 'zz'"),
    ],
)
def test_start_of_a_law_that_there_is_not(
    tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    given = Start.model_validate({"changes": changes})
    with pytest.raises(ConfigError, match=said):
        Launcher(tmp_path).start(given)
    assert not list(tmp_path.iterdir())


def test_start_announces_no_more_laws_than_a_run_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("subprocess.Popen", lambda *_, **__: None)
    given = settings_with({"wall.law": "half_sample", "wall.deadbeat": True})
    (tmp_path / "mine.toml").write_text(given.to_toml(), encoding="utf-8")
    run = Launcher(tmp_path, tmp_path / "mine.toml").start(Start())
    laws = config.load(run.folder / "start.toml").run.more_laws
    assert "half_sample+deadbeat" in laws
    assert len(laws) == MAX_LAWS


def test_control(page: PageOf, run: FakeRun, open_page: Callable[[], PageOf]) -> None:
    other = open_page()
    other.event("control", you=False, others=1)
    assert "control" in other.ask("change", stiffness_nm_per_rad=10.0)["error"]
    assert not other.ask("beat")["ok"]
    assert not run.requests
    assert not run.beats
    assert other.ask("take_control")["ok"]
    page.event("control", you=False)
    assert other.ask("change", stiffness_nm_per_rad=10.0)["ok"]
    assert "control" in page.ask("end")["error"]
    other.socket.close()
    page.event("control", you=False, others=0)  # nobody's: it is not given without being taken
    assert page.ask("end")["error"].startswith("this page does not have control")
    assert page.ask("stop")["ok"]  # anybody may
    open_page().event("control", you=True, others=1)


def test_beat_of_the_page_in_control(tmp_path: Path) -> None:
    with PanelBeside(tmp_path, dead_man_s=0.5) as beside, PageOf.opened(beside) as page:
        run = beside.begin_run()
        page.event("status")
        assert page.ask("beat")["ok"]
        assert page.ask("beat")["ok"]
        wait_until(lambda: run.requests)
        assert run.beats == 2
        assert run.requests == [{"do": "watch_beat", "timeout_s": 0.5}]


def test_watch_of_the_beat_that_fails_is_tried_again(tmp_path: Path) -> None:
    with PanelBeside(tmp_path, dead_man_s=0.5) as beside, PageOf.opened(beside) as page:
        run = beside.begin_run()
        page.event("status")
        run.refusal = "the run does not answer"
        assert page.ask("beat")["ok"]
        page.event("problem", text="the run does not answer")
        run.refusal = None
        assert page.ask("beat")["ok"]
        wait_until(lambda: run.requests, 2.0)
        assert run.requests == [{"do": "watch_beat", "timeout_s": 0.5}]


def test_run_that_ends_and_the_next_one(
    page: PageOf, run: FakeRun, beside: PanelBeside, open_page: Callable[[], PageOf]
) -> None:
    run.publish(rows_of(press(1000)))
    page.event("contact", n=1)
    run.status_now |= {"ended": True, "trip": "the handle left limits.position_rad"}
    told = page.event("run", state="ended")
    assert told["text"] == "the handle left limits.position_rad"
    wait_until(lambda: run.closed)
    assert page.ask("mark", text="late")["error"] == "no run is in progress"
    later = open_page()
    later.event("run", state="ended")
    time.sleep(2.0 * follower._SEARCH_S)  # not attached again, while it writes its record
    next_run = beside.begin_run("two", pid=2)
    page.event("run", state="attached", name="two")
    attached = [
        m["name"] for m in page.heard if isinstance(m, dict) and m.get("state") == "attached"
    ]
    assert attached == ["one", "two"]
    next_run.publish(rows_of(press(1000)))
    page.event("contact", n=1)
    assert page.ask("change", stiffness_nm_per_rad=20.0)["ok"]
    assert len(next_run.requests) == 1


def test_a_and_b(page: PageOf, run: FakeRun) -> None:
    walls = {"a": {"law": "mean_force"}, "b": {"stiffness_nm_per_rad": 80.0}}
    assert page.ask("ab_use", which="a")["ok"] is False  # there is none yet
    assert page.ask("ab_set", **walls)["ok"]
    assert page.ask("ab_use", which="b") == {"answer": 3, "ok": True, "cycle": 7}
    assert page.event("ab", which="b")["b"] == walls["b"]
    assert page.ask("ab_auto", on=True)["ok"]
    assert [request["do"] for request in run.requests] == ["change", "take_turns"]
    assert [wall["stiffness_nm_per_rad"] for wall in run.requests[1]["walls"]] == [50.0, 80.0]


def test_blind_comparison_hides_the_wall(
    page: PageOf, run: FakeRun, beside: PanelBeside, open_page: Callable[[], PageOf]
) -> None:
    assert page.ask("blind_begin", procedure="comparison", repeats=1)["ok"]
    page.event("blind", running=True, trial=1)
    page.event("settings", wall=None, turns=None)
    assert page.ask("change", stiffness_nm_per_rad=1.0)["error"].startswith("a blind comparison")
    assert page.ask("preset_save", name="seen")["ok"] is False
    line = json.dumps({"cycle": 5, "t_s": 0.005, "what": "change", "stiffness_nm_per_rad": 25.0})
    (beside.folder / "one" / "events.jsonl").write_text(f"{line}\n")
    del page.heard[:], page._aside[:]
    run.publish(rows_of(press(1500)))
    contact = page.event("contact")
    assert contact["law"] is None
    assert contact["stiffness"] is None
    signals = decoded(page.until(lambda m: isinstance(m, bytes) and m[0] == 1))
    assert np.isnan(signals[3][6]).all()
    assert np.isfinite(signals[3][:6]).all()
    page.until(lambda m: isinstance(m, bytes) and m[0] == 2)
    assert all(np.isnan(decoded(m)[1]) for m in page.heard if isinstance(m, bytes) and m[0] == 2)
    page.event("status")
    page.event("status")
    assert not [m for m in page.heard if isinstance(m, dict) and m["event"] == "marks"]
    assert open_page().event("settings")["wall"] is None
    assert page.ask("blind_end")["ok"]
    page.event("blind", running=False)
    assert page.event("settings")["wall"]["stiffness_nm_per_rad"] == 50.0
    assert page.event("marks")["marks"] == [json.loads(line)]


def test_run_that_ends_ends_its_blind_comparison(page: PageOf, run: FakeRun) -> None:
    assert page.ask("blind_begin", procedure="comparison", repeats=1)["ok"]
    run.status_now |= {"ended": True}
    assert page.event("blind", phase="ended")["text"] == "the run has ended"


def test_presets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "home"))
    with PanelBeside(tmp_path) as beside, PageOf.opened(beside) as page:
        page.event("presets", presets=[])
        run = beside.begin_run()
        page.event("status")
        assert page.ask("preset_save", name="as it is")["ok"]
        (preset,) = page.event("presets")["presets"]
        assert preset["name"] == "as it is"
        assert preset["change"]["damping_ratio"] == 0.5
        assert "damping_nm_s_per_rad" not in preset["change"]
        assert page.ask("preset_use", name="as it is")["ok"]
        assert run.requests[-1] == {"do": "change", **preset["change"]}
        assert page.ask("preset_use", name="other")["error"].startswith("other: no preset")
        assert page.ask("preset_remove", name="as it is")["ok"]
        page.event("presets", presets=[])


def test_panel_of_a_run_ends_after_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with PanelBeside(tmp_path, with_run=True) as beside:
        run = beside.begin_run()
        wait_until(lambda: beside.session.folder_of_run)
        monkeypatch.setattr(session, "_ALONE_S", 0.5)
        time.sleep(0.7)
        with PageOf.opened(beside) as page:
            run.alive = False
            page.event("run", state="ended")
            time.sleep(0.7)
            assert beside.is_serving
        wait_until(lambda: not beside.is_serving)


def test_run_that_is_killed(page: PageOf, run: FakeRun) -> None:
    run.alive = False
    assert "watchdog" in page.event("run", state="ended")["text"]


def test_new_page_has_the_last_seconds(
    page: PageOf, run: FakeRun, open_page: Callable[[], PageOf]
) -> None:
    run.publish(rows_of(press()))
    page.event("contact", n=3)
    later = open_page()
    assert [later.event("contact")["n"] for _ in range(3)] == [1, 2, 3]
    _, _, times, _ = decoded(later.until(lambda m: isinstance(m, bytes)))
    assert len(times) == 749  # the last bucket may get more rows


def raw_page(panel: PanelBeside) -> socket.socket:
    """A page that has been let in, and reads no more."""
    sock = socket.create_connection(("127.0.0.1", panel.server.port))
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    token = panel.server.access.token
    sock.sendall(
        f"GET /live HTTP/1.1\r\nHost: {panel.address}\r\nUpgrade: websocket\r\n"
        f"Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
        f"Authorization: Bearer {token}\r\n\r\n".encode()
    )
    assert sock.recv(12) == b"HTTP/1.1 101"
    return sock


def test_slow_reader_slows_nobody_and_is_closed(
    page: PageOf, run: FakeRun, beside: PanelBeside, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(panel_server, "_PATIENCE_S", 0.5)
    slow = raw_page(beside)
    page.event("control", others=1)
    first, shown = 0, 0
    y = np.full(4000, 0.1)
    while len(beside.session.pages) == 2:
        run.publish(rows_of(y, first))
        first += len(y)
        shown += len(decoded(page.until(lambda m: isinstance(m, bytes) and m[0] == 1))[2])
        waiting = [len(each.outbox._looks) for each in beside.session.pages._pages]
        assert max(waiting) <= 30
        assert first < 4_000_000
    assert shown >= (first - 5 * len(y)) // 4  # the other page has missed nothing
    slow.close()


def test_what_waits_for_a_page_is_bounded() -> None:
    async def rest_of(outbox: Outbox) -> list[str | bytes | None]:
        found = []
        while outbox._something.is_set():
            found.append(await outbox.get())
            if found[-1] is None:
                break
        return found

    outbox = Outbox()
    for n in range(1000):
        outbox.put_frames([b"%d" % n])
        outbox.put_contact(f"contact {n}")
        outbox.put_state("status", f"status {n}")
    contacts = [f"contact {n}" for n in range(900, 1000)]
    frames = [b"%d" % n for n in range(970, 1000)]
    assert asyncio.run(rest_of(outbox)) == ["status 999", *contacts, *frames]
    for n in range(257):
        outbox.put_event(f"answer {n}")
    assert asyncio.run(rest_of(outbox)) == [None]  # answers are not left out: the page is closed


def test_200_connections(page: PageOf, beside: PanelBeside) -> None:
    crowd = []
    for _ in range(200):
        crowd.append(socket.create_connection(("127.0.0.1", beside.server.port)))
    wait_until(lambda: len(beside.connections) == 64)
    page.event("status")
    assert page.ask("mark", text="still here")["ok"]
    for each in crowd:
        each.close()
    wait_until(lambda: len(beside.connections) == 1)
    assert httpx2.get(f"http://{beside.address}/", headers=beside.bearer).status_code == 200


@pytest.mark.parametrize("said", [b"", b"GET / HT", b"POST /api/start HTTP/1.1\r\nHost: %b\r\n"])
def test_connection_that_does_not_ask_is_closed(
    beside: PanelBeside, monkeypatch: pytest.MonkeyPatch, said: bytes
) -> None:
    monkeypatch.setattr(panel_server, "_PATIENCE_S", 0.2)
    with socket.create_connection(("127.0.0.1", beside.server.port)) as sock:
        sock.settimeout(PATIENCE_S)
        sock.sendall(said.replace(b"%b", beside.address.encode()))
        with contextlib.suppress(ConnectionResetError):
            assert sock.recv(1) == b""


def test_many_pages(
    beside: PanelBeside, open_page: Callable[[], PageOf], caplog: pytest.LogCaptureFixture
) -> None:
    for _ in range(MOST_PAGES):
        open_page()
    wait_until(lambda: len(beside.session.pages) == MOST_PAGES)
    with pytest.raises(Exception, match="503"):
        open_page()
    assert caplog.text == ""
