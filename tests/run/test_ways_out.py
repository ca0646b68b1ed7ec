"""Whatever happens to the master: the torque goes, by the loop or by the drive's own watchdog.

Two processes on unixcan, in real time, and a witness on the bus. Nothing here is measured by the
clock: what counts is what is on the bus, and in which order (`scripts/bench ways_out` has times).
"""

import itertools
import re
import signal
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import numpy as np
import pytest
from commands import (
    COMMAND,
    ON_A_BUSY_MACHINE,
    PATIENCE_S,
    SOFT_WALL,
    STOPPED_SAID,
    Record,
    Start,
    command,
    config_file,
    python,
    torque_is_on,
    wait_for,
)
from fork_server import PYTHON
from rig import RPDO1, SDO_ANSWER, SDO_REQUEST, SYNC, Loop, RigFactory, eds_without, settings_with

from canwall import config
from canwall.record import Phase, RunFolder
from canwall.record.folder import stream_of
from canwall.record.live import LiveRun
from canwall.run import stop_on_signals

EMCY = 0x085
ENABLE_OPERATION = 0x0F

#: A hand that stays on the wall.
CHANGES = (
    ON_A_BUSY_MACHINE
    | SOFT_WALL
    | {
        "press_s = 0.5": "press_s = 3000.0",
        "strikes = 4\n": "strikes = 1\n",
        "interval_s = 1.0": "interval_s = 4000.0",
        "duration_s = 4.2\n": "",
    }
)

#: Objects without which each watchdog is the strongest one left, and the code of its EMCY.
WATCHDOGS = {
    "RPDO event timer": ((), 0x8250),
    "consumer heartbeat": (("1400sub5",), 0x8130),
    "life guarding": (("1400sub5", "1016"), 0x8130),
}


class Witness(can.Listener):
    """Every frame on the bus, in order; asks the drive."""

    def __init__(self, channel: Path) -> None:
        self.bus = can.Bus(interface="unixcan", channel=str(channel))
        self.frames: list[tuple[int, bytes]] = []
        self._notifier = can.Notifier(self.bus, [self], timeout=0.05)

    def on_message_received(self, msg: can.Message) -> None:
        self.frames.append((msg.arbitration_id, bytes(msg.data)))

    def close(self) -> None:
        self._notifier.stop()
        self.bus.shutdown()

    def torque_is_on(self) -> bool:
        """Return True if the latest RPDO has a torque."""
        rpdos = [data for can_id, data in self.frames[-50:] if can_id == RPDO1]
        return bool(rpdos) and rpdo(rpdos[-1])[0] == ENABLE_OPERATION and rpdo(rpdos[-1])[1] != 0

    def emergencies(self) -> list[int]:
        return [int.from_bytes(d[:2], "little") for can_id, d in self.frames if can_id == EMCY]

    def read(self, index: int) -> int:
        """An object of the drive [unsigned 16 bits]."""
        seen = len(self.frames)
        request = struct.pack("<BHB4x", 0x40, index, 0)
        self.bus.send(can.Message(arbitration_id=SDO_REQUEST, data=request, is_extended_id=False))

        def answers() -> list[bytes]:
            found = self.frames[seen:]
            return [d for i, d in found if i == SDO_ANSWER and d[1:4] == request[1:4]]

        wait_for(lambda: bool(answers()))
        return int(struct.unpack_from("<H", answers()[0], 4)[0])

    def assert_drive_gives_nothing(self) -> None:
        assert self.read(0x6041) & 0x6F == 0x40
        assert self.read(0x6077) == 0


def rpdo(data: bytes) -> tuple[int, int]:
    """Controlword and torque."""
    controlword, torque = struct.unpack("<Hh", data)
    return controlword, torque


@contextmanager
def walled(
    start: Start,
    tmp_path: Path,
    watchdog: str = "RPDO event timer",
    exchange: str = "native",
    law: str | None = None,
    waits: bool = True,
) -> "Iterator[tuple[subprocess.Popen[str], Witness, Path]]":
    """A master that presses back, its drive, and a witness; with the folder of the run."""
    channel, folder = tmp_path / "bus", tmp_path / "run"
    missing, _ = WATCHDOGS[watchdog]
    eds = eds_without(tmp_path / "drive.eds", *missing)
    changes = CHANGES | {
        'channel = "/tmp/canwall.sock"': f'channel = "{channel}"\nexchange = "{exchange}"'
    }
    file = config_file(tmp_path / "c.toml", changes, config.shipped("config/unixcan.toml"))
    shipped = str(config.shipped("eds/canwall-drive.eds"))
    file.write_text(file.read_text().replace(shipped, str(eds)))
    drive = start(COMMAND, "drive", file, "--real-time")
    assert drive.stdout is not None
    assert drive.stdout.readline().startswith("simulated drive, node 5")
    witness = Witness(channel)
    try:
        other = ("--law", law) if law else ()
        master = start(COMMAND, "run", file, "--output", folder, *other)
        if waits:
            wait_for(lambda: witness.torque_is_on() or master.poll() is not None)
            assert master.poll() is None, master.communicate()[1]
        yield master, witness, folder
    finally:
        witness.close()


# The master is asked to end


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "exchange"),
    [
        (signal.SIGINT, "native"),
        (signal.SIGTERM, "native"),
        (signal.SIGHUP, "native"),
        (signal.SIGINT, "python-can"),
    ],
)
def test_signal_that_asks_for_the_end(
    start: Start, tmp_path: Path, number: int, exchange: str
) -> None:
    with walled(start, tmp_path, exchange=exchange) as (master, witness, folder):
        master.send_signal(number)
        _, errors = master.communicate(timeout=PATIENCE_S)
        assert (master.returncode, errors) == (130, STOPPED_SAID)
        witness.assert_drive_gives_nothing()
        rpdos = [rpdo(data) for can_id, data in witness.frames if can_id == RPDO1]
    # From the first word of the way down on there is no torque.
    leaving = next(k for k, (word, _) in enumerate(rpdos) if k and word < rpdos[k - 1][0])
    assert rpdos[leaving - 1][0] == ENABLE_OPERATION
    assert {torque for _, torque in rpdos[leaving:]} == {0}
    # No watchdog has bitten before: it misses the master only once that has gone.
    ids = [can_id for can_id, _ in witness.frames]
    assert EMCY not in ids[: len(ids) - ids[::-1].index(RPDO1)]
    assert Record(folder).summary["interrupted"] is True


@pytest.mark.slow
def test_terminal_that_is_closed_under_nohup(start: Start, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    log = folder / "bus.log"
    running = start("nohup", COMMAND, "run", "--duration", 3600, "--output", folder)
    wait_for(lambda: torque_is_on(log))
    running.send_signal(signal.SIGHUP)
    size = log.stat().st_size
    wait_for(lambda: log.stat().st_size > size + 100_000)
    assert running.poll() is None
    running.send_signal(signal.SIGTERM)
    assert running.wait(PATIENCE_S) == 130


def test_impatient_ctrl_c_while_the_drive_is_taken_down(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(settings_with({"wall.law": "half_sample"})))
    note, pressed = loop.rig.link.log, 0
    assert note is not None

    def press(time_s: float, message: can.Message, received: bool) -> None:
        nonlocal pressed
        note(time_s, message, received)
        if loop.record["j"][0] >= 500 and message.arbitration_id in (SYNC, RPDO1):
            signal.raise_signal(signal.SIGINT)
            pressed += 1

    loop.rig.link.log = press
    with stop_on_signals() as stop:
        outcome = loop.run(None, lambda j: stop())
    assert pressed > 5
    assert outcome.interrupted
    assert outcome.disabled
    assert outcome.trips == []
    words = [word for word, _ in loop.rig.rpdos()]
    assert [word for word, _ in itertools.groupby(words)][-2:] == [0x0F, 0x00]
    assert loop.rig.node.read(0x6041) & 0x6F == 0x40


# Another process stops it


@pytest.mark.slow
@pytest.mark.parametrize("exchange", ["native", "python-can"])
def test_stop_word(start: Start, tmp_path: Path, exchange: str) -> None:
    with walled(start, tmp_path, exchange=exchange) as (master, witness, folder):
        with LiveRun.open(folder) as live:
            live.stop()
        _, errors = master.communicate(timeout=PATIENCE_S)
        witness.assert_drive_gives_nothing()
        assert witness.emergencies() == []
    assert master.returncode == 1
    # A witness that is slow loses frames, the master's own log has them all.
    rpdos = [rpdo(data) for _, data in Record(folder).cycles]
    (line,) = errors.splitlines()
    assert line.endswith(": stopped by another process, the panel or a script")
    # The wall's last RPDO has no torque, before the loop had to be asked.
    leaving = next(k for k, (word, _) in enumerate(rpdos) if k and word < rpdos[k - 1][0])
    assert [torque != 0 for _, torque in rpdos[leaving - 2 : leaving]] == [True, False]
    assert {torque for _, torque in rpdos[leaving - 1 :]} == {0}
    assert Record(folder).summary["trips"] == [line.removeprefix("canwall: ")]


@pytest.mark.slow
def test_panel_that_is_killed_in_the_contact(start: Start, tmp_path: Path) -> None:
    """Its beats are watched, and missed."""
    with walled(start, tmp_path) as (master, witness, folder):
        panel = start(PYTHON, "-c", BEATS, folder)
        assert panel.stdout is not None
        assert panel.stdout.readline() == "watched\n", panel.communicate()[1]
        panel.kill()
        _, errors = master.communicate(timeout=PATIENCE_S)
        witness.assert_drive_gives_nothing()
        assert witness.emergencies() == []
    assert master.returncode == 1
    # A witness that is slow loses frames, the master's own log has them all.
    rpdos = [rpdo(data) for _, data in Record(folder).cycles]
    (line,) = errors.splitlines()
    assert "no beat from panel or script for" in line
    assert "the wall was ramped down" in line
    torques = np.array([torque for word, torque in rpdos if word == ENABLE_OPERATION])
    held = np.abs(torques).max()
    assert torques[-1] == 0
    assert np.abs(np.diff(torques[-200:])).max() < 0.3 * held
    assert [event["what"] for event in RunFolder(folder).read_events()] == [
        "watch_beat",
        "beat lost",
    ]


BEATS = """
import sys, time
from pathlib import Path
from canwall.record.live import LiveRun

live = LiveRun.open(Path(sys.argv[1]))
live.request({"do": "watch_beat", "timeout_s": 2.0}, timeout_s=60.0)
print("watched", flush=True)
while True:
    live.beat()
    time.sleep(0.05)
"""


# The master is dead


@pytest.mark.slow
@pytest.mark.parametrize(
    ("watchdog", "exchange"),
    [*((watchdog, "native") for watchdog in WATCHDOGS), ("consumer heartbeat", "python-can")],
)
def test_master_that_is_killed(start: Start, tmp_path: Path, watchdog: str, exchange: str) -> None:
    _, code = WATCHDOGS[watchdog]
    with walled(start, tmp_path, watchdog, exchange) as (master, witness, folder):
        master.kill()
        assert master.wait(PATIENCE_S) == -signal.SIGKILL
        wait_for(lambda: witness.emergencies() == [code])
        witness.assert_drive_gives_nothing()
        last = [data for can_id, data in witness.frames if can_id == RPDO1][-1]
        # It was not the master that took the torque away.
        assert rpdo(last)[0] == ENABLE_OPERATION
        assert rpdo(last)[1] != 0
        assert (SYNC, b"") not in witness.frames[-3:]
    # The record is complete all the same, up to the last cycle.
    wait_for(lambda: complete(folder))
    record = Record(folder)
    assert record.column("j").tolist() == list(range(len(record.cycles)))
    assert struct.pack("<h", record.column("torque_cmd_per_mille")[-1]) == last[2:]


def complete(folder: Path) -> bool:
    """Return True once the writer has converted its stream to Parquet."""
    names = {path.name for path in folder.iterdir()}
    return (
        names >= {"bus.log", "signals.parquet"}
        and stream_of(folder / "signals.parquet").name not in names
    )


@pytest.mark.slow
@pytest.mark.parametrize("watchdog", WATCHDOGS)
def test_master_that_stands_still_for_longer_than_the_watchdog(
    start: Start, tmp_path: Path, watchdog: str
) -> None:
    _, code = WATCHDOGS[watchdog]
    with walled(start, tmp_path, watchdog) as (master, witness, folder):
        master.send_signal(signal.SIGSTOP)
        wait_for(lambda: witness.emergencies() == [code])
        witness.assert_drive_gives_nothing()
        seen = len(witness.frames)
        master.send_signal(signal.SIGCONT)
        _, errors = master.communicate(timeout=PATIENCE_S)
        witness.assert_drive_gives_nothing()
        after = [rpdo(data) for can_id, data in witness.frames[seen:] if can_id == RPDO1]
    assert master.returncode == 1
    (line,) = errors.splitlines()
    every = "" if watchdog == "RPDO event timer" else r" for a frame every 16\d ms"
    assert re.search(
        rf"EMCY {code:#x} \(.*\), register 0x\d\d; the master had stood still for [\d.]+ s, the "
        rf"drive's watchdog \({watchdog}\) waits 50\d ms{every}$",
        line,
    )
    # The answer to the TPDO before the pause may still go out, to a drive that is disabled.
    assert all(torque == 0 for _, torque in after[1:])
    assert Record(folder).summary["trips"] == [line.removeprefix("canwall: ")]


# The record's writer is dead


@pytest.mark.slow
def test_writer_that_is_killed_ends_the_wall(start: Start, tmp_path: Path) -> None:
    with walled(start, tmp_path) as (master, witness, folder):
        (writer,) = Path(f"/proc/{master.pid}/task/{master.pid}/children").read_text().split()
        subprocess.run(["kill", "-KILL", writer], check=True)
        _, errors = master.communicate(timeout=PATIENCE_S)  # by itself
        witness.assert_drive_gives_nothing()
    assert master.returncode == 1
    reason = "the writer of the record has died"
    told = f"canwall: {folder}: the record is incomplete: {reason}"
    picture = f"canwall: {folder}: the picture is missing: {reason}"
    assert set(errors.splitlines()) in ({told}, {told, picture})


# The law fails


@pytest.mark.slow
@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("return math.nan", "gave a force that is not a number"),
        (
            "return wall.memory[int(1e6 * wall.y_sample)]",
            "raised IndexError: index is out of bounds (failing.py, line 5)",
        ),
        ('raise ValueError("no")', "raised ValueError: no (failing.py, line 5)"),
    ],
)
@pytest.mark.parametrize("exchange", ["python-can", "native"])
def test_law_that_fails_in_the_contact(
    tmp_path: Path, body: str, words: str, exchange: str
) -> None:
    file = tmp_path / "failing.py"
    file.write_text(
        "import math\n\ndef failing(wall):\n    if wall.y_sample < -0.002:\n        "
        f"{body}\n    return -wall.stiffness * wall.y_sample\n"
    )
    folder = tmp_path / "run"
    configuration = config_file(
        tmp_path / "c.toml", {'exchange = "auto" ': f'exchange = "{exchange}" '}
    )
    done = command(
        "run", configuration, "--law", f"{file}:failing", "--duration", 1, "--output", folder
    )
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.endswith(f"law {file}:failing {words}")
    record = Record(folder)
    trip = record.summary["trip_cycle"]
    torques = record.column("torque_cmd_per_mille")
    assert torques[trip - 1] != 0
    assert not torques[trip:].any()
    assert record.column("phase")[trip] == Phase.RENDERING
    assert int(record.column("statusword")[-1]) & 0x6F == 0x40


# The law does not return

HANGING = """def hanging(wall):
    while {condition}:
        pass
    return -wall.stiffness * wall.y_sample
"""


def hanging_law(tmp_path: Path, condition: str) -> str:
    file = tmp_path / "law.py"
    file.write_text(HANGING.format(condition=condition))
    return f"{file}:hanging"


@pytest.mark.slow
@pytest.mark.parametrize("exchange", ["python-can", "native"])
def test_law_that_does_not_return(tmp_path: Path, exchange: str) -> None:
    law = hanging_law(tmp_path, "wall.y < 0.0")
    file = config_file(tmp_path / "c.toml", {'exchange = "auto" ': f'exchange = "{exchange}" '})
    folder = tmp_path / "run"
    done = command("run", file, "--law", law, "--duration", 2, "--output", folder)
    (line,) = done.stderr.splitlines()
    assert re.search(rf"cycle \d+ \(0\.\d+ s\): law {law} has not returned for [\d.]+ s$", line)
    assert done.returncode == 1
    record = Record(folder)
    assert record.summary["trips"] == [line.removeprefix("canwall: ")]
    assert record.summary["trip_cycle"] == len(record.column("j"))
    assert (folder / "trip.csv").exists()
    last = [bytes(frame.data) for frame in record.frames if frame.arbitration_id == RPDO1][-1]
    assert rpdo(last) == (0x00, 0)
    # The embedded drive has heard of it.
    answers = [bytes(f.data) for f in record.frames if f.arbitration_id == SDO_ANSWER]
    states = [data[4] for data in answers if data[1:4] == b"\x41\x60\x00"]
    assert states[-1] & 0x6F == 0x40


@pytest.mark.slow
def test_law_that_does_not_return_from_its_first_call(tmp_path: Path) -> None:
    law = hanging_law(tmp_path, "wall.y < 1e9")
    done = command("run", "--law", law, "--duration", 2, "--output", tmp_path / "run")
    assert (done.returncode, len(done.stderr.splitlines())) == (1, 1)
    assert f"law {law} has not returned for" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("exchange", ["python-can", "native"])
def test_law_that_does_not_return_in_real_time(start: Start, tmp_path: Path, exchange: str) -> None:
    law = hanging_law(tmp_path, "wall.y < -0.02")
    with walled(start, tmp_path, exchange=exchange, law=law, waits=False) as (master, witness, _):
        _, errors = master.communicate(timeout=PATIENCE_S)
        witness.assert_drive_gives_nothing()
    assert master.returncode == 1
    assert f"law {law} has not returned for" in errors


IMPATIENT = """
import signal, sys
from canwall import cli
from canwall.cycle.loop import Loop

law_at_work = Loop.law_at_work

def signals(self):
    if found := law_at_work(self):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)
    return found

Loop.law_at_work = signals
sys.argv = ["canwall", *sys.argv[1:]]
cli.main()
"""


@pytest.mark.slow
def test_signals_while_a_law_does_not_return(tmp_path: Path) -> None:
    law, folder = hanging_law(tmp_path, "wall.y < 0.0"), tmp_path / "run"
    done = python("-c", IMPATIENT, "run", "--law", law, "--duration", 2, "--output", folder)
    assert done.returncode == 1
    assert f"law {law} has not returned for" in done.stderr
    assert len(Record(folder).summary["trips"]) == 1


# Signals while the run is being completed


TAIL = """
import signal, sys
from pathlib import Path
import canwall
from canwall import cli
from canwall.run import running

noisy, package = {noisy!r}, str(Path(canwall.__file__).parent)

def signals(frame, event, argument):
    if event == "call" and frame.f_code.co_filename.startswith(package):
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGINT)

def before(module, name):
    function = getattr(module, name)
    def noisily(*args, **kwargs):
        if name == noisy:
            sys.setprofile(signals)
        return function(*args, **kwargs)
    setattr(module, name, noisily)

for name in ("_render", "write_result"):
    before(running, name)
sys.argv = ["canwall", *sys.argv[1:]]
cli.main()
"""


@pytest.mark.slow
@pytest.mark.parametrize("noisy", ["_render", "write_result"])
def test_signals_at_every_call_until_all_is_told(tmp_path: Path, noisy: str) -> None:
    law = tmp_path / "failing.py"
    law.write_text(
        "import math\n\ndef failing(wall):\n    if wall.y_sample < -0.002:\n        "
        "return math.nan\n    return -wall.stiffness * wall.y_sample\n"
    )
    folder = tmp_path / "run"
    done = python(
        "-c", TAIL.format(noisy=noisy), "run", "--law", f"{law}:failing", "--duration", 2,
        "--output", folder,
    )  # fmt: skip
    record = Record(folder)
    assert "Traceback" not in done.stderr
    assert done.returncode in (1, 130)
    assert "the picture is missing: given up" in done.stderr
    assert not list(folder.glob(".*"))
    assert f"record: {folder}" in done.stdout
    for trip in record.summary["trips"]:
        assert trip in done.stderr
    if noisy == "write_result":
        assert done.returncode == 1
        assert len(record.summary["trips"]) == 1
        assert (folder / "trip.csv").exists()
