"""Masters that are killed, stopped or asked to end at any instant, with a witness on the bus.

Master, drive and witness are three processes on unixcan, in real time. The witness hears what is on
the bus and asks the drive; it does not ask the master.
"""

import math
import random
import signal
import struct
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import numpy as np
from commands import COMMAND, ON_A_BUSY_MACHINE, PATIENCE_S, config_file
from fuzzing import FoundError
from rig import RPDO1, TPDO1, eds_without
from test_ways_out import EMCY, WATCHDOGS, Witness, rpdo

from canwall import config

#: Objects without which each watchdog is the strongest one that is left.
SIGNALS = {"SIGKILL": signal.SIGKILL, "SIGSTOP": signal.SIGSTOP, "SIGTERM": signal.SIGTERM}
#: Longest time from the start of a master, and from its first torque, to the signal [s].
_FROM_START_S, _IN_CONTACT_S = 3.0, 1.0
#: Bounds of the histograms [ms].
BINS_MS = (0, 5, 10, 20, 50, 100, 200, 300, 400, 450, 500, 550, 600, 1000, 10_000)
_WATCHDOG_S = 0.5
_TPDO = struct.Struct("<iHh")


@dataclass(frozen=True)
class Turn:
    """One master and its end.

    Attributes:
        watchdog: of the drive.
        name: of the signal.
        phase: what the master was doing by the last frames before it.
        time_ms: from the signal in contact to the drive's end: a TPDO without a torque and out of
            OPERATION ENABLED, or the EMCY of its watchdog, from which on it gives none (0x6007).
    """

    watchdog: str
    name: str
    phase: str
    time_ms: float | None


def turns(
    seed: int,
    number: int,
    popen: Callable[..., "subprocess.Popen[str]"] = subprocess.Popen,
    tell: Callable[[int], None] = lambda done: None,
) -> list[Turn]:
    """Kill so many masters.

    Args:
        seed: of watchdogs, signals and instants.
        number: of masters.
        popen: starts a program.
        tell: called with the turns so far.

    Raises:
        FoundError: If a drive had a torque without a master, or was left enabled.
    """
    chance = random.Random(seed)
    cases = [(watchdog, name) for watchdog in WATCHDOGS for name in SIGNALS]
    chance.shuffle(cases)
    found = []
    for k in range(number):
        watchdog, name = cases[k % len(cases)]
        in_contact = chance.random() < 0.7
        wait_s = chance.uniform(0.0, _IN_CONTACT_S if in_contact else _FROM_START_S)
        what = f"seed {seed}, turn {k}: {name}, {watchdog}, {wait_s:.3f} s"
        what += " after the first torque" if in_contact else " after the start"
        try:
            found.append(_turn(watchdog, name, in_contact, wait_s, popen))
        except AssertionError as error:
            raise FoundError(f"{what}: {error}") from error
        tell(k + 1)
    return found


def _turn(
    watchdog: str,
    name: str,
    in_contact: bool,
    wait_s: float,
    popen: Callable[..., "subprocess.Popen[str]"],
) -> Turn:
    with tempfile.TemporaryDirectory(prefix="canwall-search-") as temporary:
        folder = Path(temporary)
        file = _configuration(folder, watchdog)
        with (
            _program(popen, "drive", file, "--real-time") as drive,
            _program(popen, "run", file, "--output", folder / "run", begun=False) as master,
        ):
            del drive
            witness = _Stamped(folder / "bus")
            try:
                if in_contact:
                    # A first start compiles for as long as it takes.
                    while not witness.torque_is_on() and master.poll() is None:
                        time.sleep(0.01)
                time.sleep(wait_s)
                before = len(witness.frames)
                witness.sent_s = time.time()
                master.send_signal(SIGNALS[name])
                phase = _phase(witness.frames[:before])
                if name == "SIGTERM":
                    master.wait(PATIENCE_S)
                _wait_until_silent(witness)
                statusword, torque = witness.read(0x6041), witness.read(0x6077)
                if torque or statusword & 0x6F == 0x27:
                    raise AssertionError(f"statusword {statusword:#06x}, {torque} per mille")
                if name == "SIGSTOP":  # what it still has to say has to be harmless
                    master.send_signal(signal.SIGCONT)
                    if phase in ("setting up", "enabling"):  # it has lost nothing, and may go on
                        master.send_signal(signal.SIGTERM)
                    master.wait(PATIENCE_S)
                    torque = witness.read(0x6077)
                    if torque or witness.read(0x6041) & 0x6F == 0x27:
                        raise AssertionError(f"after SIGCONT: {torque} per mille")
            finally:
                witness.close()
    time_ms = None
    if phase == "in contact":
        if witness.off_s is None:
            raise AssertionError("the drive did not say that it ended the torque")
        time_ms = (witness.off_s - witness.sent_s) * 1e3
    return Turn(watchdog, name, phase, time_ms)


def _phase(frames: list[tuple[int, bytes]]) -> str:
    """Return what a master was doing, by its last frames."""
    sent = [rpdo(data) for can_id, data in frames if can_id == RPDO1]
    if not sent:
        return "setting up"
    controlword, torque = sent[-1]
    if controlword == 0x0F:
        return "in contact" if torque else "free"
    return "leaving" if (0x0F in {word for word, _ in sent}) else "enabling"


class _Stamped(Witness):
    """A witness that notes when the drive's torque ended."""

    sent_s = math.inf
    off_s: float | None = None

    def on_message_received(self, msg: can.Message) -> None:
        super().on_message_received(msg)
        if self.off_s is None and msg.timestamp >= self.sent_s and _is_off(msg):
            self.off_s = msg.timestamp


def _is_off(msg: can.Message) -> bool:
    if msg.arbitration_id == TPDO1 and len(msg.data) == _TPDO.size:
        _, statusword, torque = _TPDO.unpack(msg.data)
        return statusword & 0x6F != 0x27 and torque == 0
    return msg.arbitration_id == EMCY


def _wait_until_silent(witness: Witness) -> None:
    """Wait until nothing was on the bus for longer than the watchdog waits."""
    while True:
        seen = len(witness.frames)
        time.sleep(1.5 * _WATCHDOG_S)
        if len(witness.frames) == seen:
            return


def _configuration(folder: Path, watchdog: str) -> Path:
    missing, _ = WATCHDOGS[watchdog]
    eds = eds_without(folder / "drive.eds", *missing)
    changes = ON_A_BUSY_MACHINE | {
        "press_s = 0.5": "press_s = 3000.0",
        "strikes = 4\n": "strikes = 1\n",
        "interval_s = 1.0": "interval_s = 4000.0",
        "duration_s = 4.2\n": "",
        'channel = "/tmp/canwall.sock"': f'channel = "{folder}/bus"',
    }
    file = config_file(folder / "c.toml", changes, config.shipped("config/unixcan.toml"))
    shipped = str(config.shipped("eds/canwall-drive.eds"))
    file.write_text(file.read_text().replace(shipped, str(eds)))
    return file


@contextmanager
def _program(
    popen: Callable[..., "subprocess.Popen[str]"],
    command: str,
    file: Path,
    *arguments: object,
    begun: bool = True,
) -> "Iterator[subprocess.Popen[str]]":
    """`canwall COMMAND FILE ARGUMENTS`, ended with the block; begun: it has said a line."""
    words = [COMMAND, command, str(file), *map(str, arguments)]
    with popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            if begun and process.stdout is not None:
                process.stdout.readline()
            yield process
        finally:
            process.kill()


def histograms(found: list[Turn]) -> dict[str, Any]:
    """Return the times to zero torque in contact, by watchdog and signal [ms]."""
    result: dict[str, Any] = {}
    for watchdog in WATCHDOGS:
        for name in SIGNALS:
            times = [
                turn.time_ms
                for turn in found
                if (turn.watchdog, turn.name) == (watchdog, name) and turn.time_ms is not None
            ]
            if times:
                result[f"{name}, {watchdog}"] = {
                    "turns": len(times),
                    "median_ms": round(float(np.median(times)), 1),
                    "longest_ms": round(max(times), 1),
                    "histogram": np.histogram(times, BINS_MS)[0].tolist(),
                }
    return result
