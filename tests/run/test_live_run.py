"""A run in progress, and what other processes see of it and do to it."""

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import wait_for
from rig import Loop, RigFactory, settings_with

from canwall.config import ConfigError, with_overrides
from canwall.cycle import Outcome
from canwall.cycle import loop as loop_module
from canwall.errors import RunFailedError
from canwall.record import ROW, TIMING_COLUMNS, Phase, RunFolder
from canwall.record.controls import Controls
from canwall.record.live import LiveRun
from canwall.run import changes
from canwall.run.changes import open_to_changes

#: A hand that strikes once, from cycle 200 on, and stays.
STAYS = {
    "simulation.hand.strikes": 1,
    "simulation.hand.press_s": 1000.0,
    "simulation.hand.interval_s": 2000.0,
}
#: A calm wall with other laws beside it.
CALM = STAYS | {
    "wall.law": "half_sample",
    "wall.stiffness_nm_per_rad": 30.0,
    "run.more_laws": ["standard", "mean_force", "exponential"],
}
PRESSING = 500

Request = Mapping[str, Any]


class Attended:
    """A run that other processes may change; the loop waits until each request has got to it."""

    def __init__(self, make_rig: RigFactory, path: Path, values: Mapping[str, Any]) -> None:
        settings = with_overrides(settings_with(), CALM | dict(values))
        self.settings = settings.model_copy(update={"schedule": ()})
        self.loop = Loop(make_rig(self.settings))
        self.folder = RunFolder(path)
        self.answers: list[int | str] = []
        self.ended = False
        self._sender: threading.Thread | None = None

    @property
    def axis(self) -> Any:
        return self.loop.axis

    def ask(self, request: Request) -> None:
        """Make a request, and wait until it is offered to the loop or answered."""

        def post() -> None:
            try:
                self.answers.append(self.live.request(dict(request)))
            except (ConfigError, RunFailedError) as error:
                self.answers.append(str(error))

        self.join()
        answered = len(self.answers)
        self._sender = threading.Thread(target=post)
        self._sender.start()
        while not self.axis.offers and len(self.answers) == answered:
            time.sleep(0.0001)

    def join(self) -> None:
        if self._sender is not None:
            self._sender.join()

    def run(
        self,
        requests: Mapping[int, Request | Callable[[], object]],
        cycles: int | None = 1000,
        at: Callable[[int], bool] = lambda j: False,
    ) -> Outcome:
        """Run, with requests made and things done between two cycles."""

        def between(j: int) -> bool:
            found = requests.get(j)
            if callable(found):
                found()
            elif found is not None:
                self.ask(found)
            return at(j) or self.ended

        def end() -> None:
            self.ended = True

        outcome = Outcome()
        with (
            open_to_changes([self.axis], [self.folder], self.loop.exchange, outcome, end),
            LiveRun.open(self.folder) as self.live,
        ):
            vars(outcome).update(vars(self.loop.run(cycles, between)))
            self.join()
        return outcome

    def torques(self) -> Any:
        self.rows = self.loop.rows()
        return self.rows["torque_cmd_per_mille"]


@pytest.fixture
def attended(make_rig: RigFactory, tmp_path: Path) -> Callable[..., Attended]:
    return lambda values={}: Attended(make_rig, tmp_path, values)


# The stop word


def stopped_in(run: Attended, phase: Phase) -> Callable[[int], bool]:
    """Stop once there is a cycle of this phase, with a torque if it has any."""

    def at(j: int) -> bool:
        row = run.axis.row[0]
        late_enough = phase == Phase.ENABLING or row["torque_cmd_per_mille"]
        if run.axis.cycle["phase"][0] == phase and late_enough:
            run.live.stop()
        return False

    return at


@pytest.mark.parametrize("phase", [Phase.ENABLING, Phase.MEASURING, Phase.RENDERING])
def test_stop_word_ends_any_phase(attended: Callable[..., Attended], phase: Phase) -> None:
    measured = {"estimator.measure_delay": True} if phase == Phase.MEASURING else {}
    run = attended(measured)
    outcome = run.run({}, at=stopped_in(run, phase))
    (trip,) = outcome.trips
    assert trip.endswith(": stopped by another process, the panel or a script")
    assert outcome.disabled
    torques = run.torques()
    assert run.rows["phase"][outcome.trip_cycle] == phase
    assert not torques[outcome.trip_cycle :].any()
    assert bool(torques[outcome.trip_cycle - 1]) == (phase != Phase.ENABLING)
    assert run.loop.rig.rpdos()[-1] == (0x00, 0)
    assert run.loop.rig.node.read(0x6041) & 0x6F == 0x40
    events = run.folder.read_events()
    assert [event["what"] for event in events] == ["stop"]
    assert run.loop.axis.cycle["j"][0] < 1000


def test_stop_word_on_the_way_out_changes_nothing(
    attended: Callable[..., Attended], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = attended()
    leave = loop_module.Loop.leave

    def stop_and_leave(loop: loop_module.Loop) -> bool:
        run.live.stop()
        return leave(loop)

    monkeypatch.setattr(loop_module.Loop, "leave", stop_and_leave)
    outcome = run.run({}, cycles=PRESSING)
    assert outcome.trips == []
    assert outcome.disabled


# The beat


def test_beat_that_is_lost_ramps_the_wall_down(
    attended: Callable[..., Attended], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = attended()
    monkeypatch.setattr(Controls, "silent_s", lambda self, since_ns: 0.0 if j() < 600 else 0.7)

    def j() -> int:
        return int(run.axis.cycle["j"][0])

    outcome = run.run({400: {"do": "watch_beat", "timeout_s": 0.5}}, cycles=None)
    (trip,) = outcome.trips
    assert "no beat from panel or script for 0.7 s, 0.5 s is the most: the wall was ramped" in trip
    assert outcome.disabled
    torques = run.torques().astype(int)
    ramp = torques[600 : outcome.trip_cycle + 1]
    # Bumpless, over run.blend_s.
    assert 50 <= len(ramp) <= 53
    assert ramp[0] > 300
    assert ramp[-1] == 0
    # The hand goes on into a wall that gives way, so that the last steps are larger ones.
    assert np.abs(np.diff(torques[595 : outcome.trip_cycle + 1])).max() <= ramp[0] / 8
    assert run.rows["stiffness_in_force"][outcome.trip_cycle] == 0.0
    assert [event["what"] for event in run.folder.read_events()] == ["watch_beat", "beat lost"]


def test_beats_keep_the_wall_up(attended: Callable[..., Attended]) -> None:
    run = attended()

    def at(j: int) -> bool:
        if j % 50 == 0 and run.axis.beat_timeout_s:
            time.sleep(0.02)
            run.live.beat()
        return False

    requests: dict[int, Request] = {
        300: {"do": "watch_beat", "timeout_s": 5.0},
        900: {"do": "watch_beat", "timeout_s": 0},
    }
    assert run.run(requests, at=at).trips == []
    assert run.axis.beat_timeout_s == 0.0
    assert run.answers == [300, 900]


# Requests


def test_walls_take_turns(make_rig: RigFactory, tmp_path: Path) -> None:
    """Four strikes, and two walls that differ in more than the law from the first one on."""
    run = Attended(
        make_rig,
        tmp_path,
        {
            "simulation.hand.strikes": 4,
            "simulation.hand.press_s": 0.1,
            "simulation.hand.interval_s": 0.6,
        },
    )
    walls = [{"law": "standard", "stiffness_nm_per_rad": 20.0}, {"position_rad": -0.01}]
    requests: dict[int, Request] = {
        700: {"do": "take_turns", "walls": walls},
        2500: {"do": "change", "law": "mean_force"},
    }
    outcome = run.run(requests, cycles=3000)
    assert outcome.trips == []
    assert run.answers == [700, 2500]
    rows = run.loop.rows()
    names = [law.name for law in run.loop.laws]
    asked = ("law", "stiffness", "wall_position_rad")
    first = np.flatnonzero(np.any([np.diff(rows[name]) for name in asked], axis=0)) + 1
    shown = [(names[rows["law"][j]], *rows[j][list(asked[1:])].tolist()) for j in [0, *first]]
    standard, other = ("standard", 20.0, 0.0), ("half_sample", 30.0, -0.01)
    start = ("half_sample", 30.0, 0.0)
    assert shown == [start, standard, other, standard, other, ("mean_force", 30.0, -0.01)]
    assert first[0] == 700
    assert first[-1] == 2500
    assert run.axis.turns == [run.axis.wall]


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ({"do": "change", "limits": {"torque_nm": 1.95}}, "limits.torque_nm = 1.95: 1.9 is in"),
        ({"do": "change", "limits": {"speed_rad_s": 61.0}}, "limit only goes down"),
        ({"do": "change", "operator": {"adapt": True}}, "operator.adapt: the run began without"),
        ({"do": "take_turns", "walls": [{"limits": {"torque_nm": 1.0}}]}, "walls.0.limits: does"),
        ({"do": "take_turns", "walls": [{"law": "midpoint"}]}, "law midpoint is not one of the"),
        ({"do": "take_turns", "walls": [{}, {"position_rad": 5.0}]}, "position_rad = 5 lies"),
    ],
)
def test_request_that_the_run_refuses(
    attended: Callable[..., Attended], request_: Request, message: str
) -> None:
    run = attended()
    assert run.run({300: request_}, cycles=320).trips == []
    (answer,) = run.answers
    assert message in str(answer)
    assert run.axis.revision == 0
    assert run.folder.read_events() == []


def test_lowered_limits_stay_lowered(attended: Callable[..., Attended]) -> None:
    run = attended({"limits.torque_rate_nm_per_s": 100.0})
    requests: dict[int, Request] = {
        # Below the torque of the contact: it gives way no faster than the rate.
        PRESSING: {"do": "change", "limits": {"torque_nm": 0.1, "energy_j": 1.0}},
        600: {"do": "change", "limits": {"energy_j": 2.0}},
        700: {"do": "change", "limits": {"torque_nm": 0.3}},
    }
    assert run.run(requests, cycles=800).trips == []
    assert run.answers[0] == PRESSING
    assert [str(answer).split(":")[0] for answer in run.answers[1:]] == [
        "limits.energy_j = 2",
        "limits.torque_nm = 0.3",
    ]
    run.torques()
    torque = run.rows["torque_cmd"]
    assert torque[PRESSING - 1] > 0.25
    rounding = 0.5 * run.loop.setup.units.nm_per_mille
    assert np.abs(np.diff(torque[PRESSING - 1 : 800])).max() <= 0.1 + rounding
    assert np.abs(torque[PRESSING + 10 : 800]).max() <= 0.1


def test_marks_and_the_end(attended: Callable[..., Attended]) -> None:
    run = attended()
    run.folder.events.write_bytes(b'{"cut of')  # not by this program: it is left out
    run.folder.events.unlink()
    requests: dict[int, Request] = {
        300: {"do": "mark", "text": "hier drücke ich\nfester"},
        400: {"do": "change", "guard": {"action": "act"}, "options": {}},
        450: {"do": "end"},
    }
    outcome = run.run(requests, cycles=None)
    assert outcome.interrupted
    assert outcome.trips == []
    assert run.answers == [300, 400, 450]
    assert run.folder.read_events() == [
        {"cycle": 300, "t_s": 0.3, "what": "mark", "text": "hier drücke ich\nfester"},
        {"cycle": 400, "t_s": 0.4, "what": "change", "options": {}, "guard": {"action": "act"}},
        {"cycle": 450, "t_s": 0.45, "what": "end"},
    ]


def test_mark_that_cannot_be_written_is_refused(attended: Callable[..., Attended]) -> None:
    run = attended()
    run.folder.events.mkdir()
    requests: dict[int, Request] = {
        300: {"do": "mark", "text": "lost"},
        310: {"do": "change", "stiffness_nm_per_rad": 20.0},
    }
    assert run.run(requests, cycles=330).trips == []
    assert run.answers == [f"{run.folder.events}: Is a directory", 310]


def test_guard_and_identification_change_in_a_run(attended: Callable[..., Attended]) -> None:
    """What the cycle knows of the hand stays in force when it no longer learns, and afterwards."""
    run = attended(
        {
            "operator.adapt": True,
            "mechanics.inertia_kg_m2": 1.0e-4,
            "mechanics.viscous_nm_s_per_rad": 5.0e-4,
            "simulation.hand.strikes": 2,
            "simulation.hand.press_s": 0.1,
            "simulation.hand.interval_s": 0.6,
        }
    )
    masses: dict[int, float] = {}
    delays: dict[int, float] = {}

    def at(j: int) -> bool:
        masses[j] = float(run.axis.cycle["estimator"]["mass"][0, 0])
        delays[j] = float(run.axis.cycle["bank"]["delay_in_force"][0, 0])
        return False

    requests: dict[int, Request] = {
        230: {"do": "change", "operator": {"adapt": False}, "guard": {"action": "act"}},
        750: {"do": "change", "operator": {"adapt": True}},
        950: {"do": "change", "guard": {"action": "off"}},
    }
    assert run.run(requests, cycles=1000, at=at).trips == []
    assert run.answers == [230, 750, 950]
    assert masses[230] > 1.2e-4
    # Between the strikes it would begin with the lightest hand again.
    assert {masses[j] for j in range(232, 800)} == {masses[231]}
    # A delay found with a mass that is another hand's would be wrong.
    assert {delays[j] for j in range(232, 750)} == {delays[231]}
    assert masses[900] != masses[231]
    assert masses[900] == pytest.approx(1.64e-4, rel=0.4)
    assert run.axis.cycle["guard"]["action"][0, 0] == 0


# What readers see


def test_readers_see_how_the_run_is(attended: Callable[..., Attended]) -> None:
    run = attended()
    seen: list[Any] = []

    def look() -> None:
        cycle = int(run.axis.cycle["j"][0])
        wait_for(lambda: run.live.status().cycle >= cycle)
        seen.append((run.live.status(), run.live.settings(), run.live.rows()))

    requests: dict[int, Request | Callable[[], object]] = {
        PRESSING: look,
        600: {"do": "change", "stiffness_nm_per_rad": 20.0, "limits": {"torque_nm": 1.5}},
        601: lambda: run.join(),
        700: look,
    }
    outcome = run.run(requests, cycles=800)
    assert outcome.trips == []
    (status, settings, rows), (later, changed, more) = seen
    assert (status.phase, status.ended, status.revision) == ("rendering", False, 0)
    assert status.drive_state.startswith("OPERATION ENABLED")
    assert (status.trip, status.emcy, status.emcy_code) == ("", "", None)
    assert status.mass_kg_m2 == pytest.approx(1.64e-4)
    assert (status.guard_factor, status.guard_alarms, status.delay_cycles) == (1.0, 0, 1.0)
    assert 0.0 < status.latency_p50_s <= status.latency_p999_s <= status.latency_max_s
    assert np.isnan(status.margin_s)
    assert later.revision == 1
    assert settings.wall == run.settings.wall
    assert settings.limits == run.settings.limits
    assert [law.name for law in settings.laws] == [law.name for law in run.loop.laws]
    assert changed.revision == 1
    assert changed.wall.stiffness_nm_per_rad == 20.0
    assert changed.limits.torque_nm == 1.5
    assert np.concatenate([rows, more])["j"].tolist() == list(range(700))


def test_last_words_reach_the_readers(make_rig: RigFactory, tmp_path: Path) -> None:
    run = Attended(make_rig, tmp_path, {})
    outcome = Outcome()
    with open_to_changes([run.axis], [run.folder], run.loop.exchange, outcome):
        live = LiveRun.open(run.folder)
        outcome.trips.append("cycle 5 (0.005 s): something tripped")
    assert live.status().ended
    assert live.status().trip == "cycle 5 (0.005 s): something tripped"
    with pytest.raises(RunFailedError, match="the run has ended"):
        live.request({"do": "mark", "text": "too late"}, 0.01)
    live.close()


READER = """
import fcntl, sys, time
from pathlib import Path
from canwall.record.live import LiveRun

live = LiveRun.open(Path(sys.argv[1]))
fcntl.flock(live._mailbox._descriptor, fcntl.LOCK_EX)  # as if it were posting
print("attached", flush=True)
while True:
    live.rows(), live.status(), live.settings(), live.beat()
"""


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGKILL])
def test_reader_that_stands_still_or_dies_changes_no_bit(
    make_rig: RigFactory, tmp_path: Path, number: signal.Signals
) -> None:
    alone = Attended(make_rig, tmp_path / "alone", {})
    watched = Attended(make_rig, tmp_path / "watched", {})
    for run in (alone, watched):
        run.folder.path.mkdir()
    alone.run({}, cycles=800)
    readers: list[subprocess.Popen[str]] = []

    def attach() -> None:
        words = [sys.executable, "-c", READER, str(watched.folder.path)]
        readers.append(subprocess.Popen(words, stdout=subprocess.PIPE, text=True))
        assert readers[0].stdout is not None
        assert readers[0].stdout.readline() == "attached\n"

    try:
        requests = {300: attach, PRESSING: lambda: readers[0].send_signal(number)}
        assert watched.run(requests, cycles=800).trips == []
    finally:
        readers[0].kill()
        readers[0].communicate()
    one, other = alone.loop.rows(), watched.loop.rows()
    for name in ROW.names or ():
        if name not in TIMING_COLUMNS:
            np.testing.assert_array_equal(one[name], other[name], name)


# A thousand changes


def random_change(random: np.random.Generator) -> dict[str, Any]:
    """One or several keys at once, within what a hand may meet."""
    laws = ("half_sample", "standard", "mean_force", "exponential")
    drawn = {
        "law": str(random.choice(laws)),
        "stiffness_nm_per_rad": float(10.0 ** random.uniform(0.5, 1.6)),
        "damping_nm_s_per_rad": float(random.choice([0.0, 0.01, 0.02])),
        "position_rad": float(random.uniform(-5e-3, 5e-3)),
        "tension": str(random.choice(["allow", "clamp", "budget"])),
        "guard": {"action": str(random.choice(["off", "warn", "act"]))},
        "limits": {"torque_nm": float(random.uniform(0.5, 2.5))},
    }
    keys = random.choice(list(drawn), random.integers(1, 4), replace=False)
    return {"do": "change"} | {key: drawn[key] for key in keys}


@pytest.mark.slow
@pytest.mark.parametrize(("count", "blend_s"), [(1000, 0.004), (100, 0.0)])
def test_thousand_changes_in_a_contact(
    make_rig: RigFactory,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    count: int,
    blend_s: float,
) -> None:
    """No step of the torque beyond its rate, and each row one of the walls that were asked for."""
    monkeypatch.setattr(changes, "_POLL_S", 0.0005)
    monkeypatch.setattr("canwall.record.mailbox._POLL_S", 0.0005)
    rate = 40.0
    run = Attended(
        make_rig, tmp_path, {"run.blend_s": blend_s, "limits.torque_rate_nm_per_s": rate}
    )
    random = np.random.default_rng(16)
    asked: list[dict[str, Any]] = []
    due = PRESSING

    def at(j: int) -> bool:
        nonlocal due
        if j >= due and not run.axis.cycle["fade_left"][0]:
            if len(asked) == count:
                return True
            asked.append(random_change(random))
            run.ask(asked[-1])
            due = j + int(random.integers(1, 8))
        return False

    outcome = run.run({}, cycles=None, at=at)
    assert outcome.trips == []
    assert len(run.answers) == count
    taken = [k for k in range(count) if isinstance(run.answers[k], int)]
    refused = {k: str(run.answers[k]) for k in range(count) if k not in taken}
    # Only limits that would rise are refused, and those as a whole.
    assert all("a limit only goes down" in text for text in refused.values())
    assert len(taken) > 0.7 * count
    run.torques()
    rows = run.rows[run.rows["phase"] == Phase.RENDERING]
    # Row for row, the wall that was in force.
    wall, limits = run.settings.wall, run.settings.limits
    names = [law.name for law in run.loop.laws]
    since = {int(run.answers[k]): asked[k] for k in taken}
    assert len(since) == len(taken)
    for row in rows:
        if change := since.get(int(row["j"])):
            request = changes.parse_request(change)
            assert isinstance(request, changes.ChangeWall)
            wall, limits = request.applied_to(wall, limits)
        assert (
            names[row["law"]],
            row["stiffness"],
            row["damping"],
            row["wall_position_rad"],
        ) == (
            wall.law,
            wall.stiffness_nm_per_rad,
            wall.damping_nm_s_per_rad,
            wall.position_rad,
        )
    assert run.axis.wall == wall
    assert run.axis.limits == limits
    torque, step = rows["torque_cmd"], rate * run.settings.bus.cycle_s
    rounding = 0.5 * run.loop.setup.units.nm_per_mille
    assert np.abs(np.diff(torque)).max() <= step + rounding
    assert np.abs(torque[rows["j"] >= PRESSING]).max() > 10 * step
    # The hand was at the wall for most of the time.
    assert (rows["y"][rows["j"] >= PRESSING] < 0.0).mean() > 0.8
