"""`canwall` in processes of its own, and what its runs leave behind."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import can
import numpy as np
import pyarrow as pa
import pytest
from fork_server import COMMAND, ForkedPopen
from numpy.typing import NDArray
from rig import RPDO1, SIM_CONFIG, SYNC, TPDO1

from canwall import config
from canwall.record import read_signals

PATIENCE_S = 60.0

#: Changes of config/unixcan.toml for a run in real time that does not end because the machine has
#: other things to do: frames may be missing or late for long, and the torque only falls meanwhile.
#: (A law that goes on at predicted positions for so long swings by itself.)
ON_A_BUSY_MACHINE = {
    "cycle_s = 0.001": 'cycle_s = 0.004\npace = "real_time"',
    "wait_s = 5.0": "wait_s = 20.0\nwatchdog_s = 0.5",
    "hold_cycles = 2": "hold_cycles = 0",
    "ramp_cycles = 10": "ramp_cycles = 1000\nlate_cycles = 0",
    "stiffness_nm_per_rad = 50.0": "stiffness_nm_per_rad = 2.0",
    # Of a simulation that caught up in one step, the positions say nothing about the speed.
    "speed_rad_s = 60.0": "speed_rad_s = 600.0",
}

#: Changes for a wall so much softer than its hand that lost samples do not make it swing.
SOFT_WALL = {
    "stiffness_nm_per_rad = 50.0": "stiffness_nm_per_rad = 0.5",
    'law = "mean_force"': 'law = "standard"',
    "cap = 0.8": "cap = 0",
}

#: What a run of config/sim.toml or its like says of the strikes on the plain wall.
GUARD_SAID = (
    r"canwall: guard: the wall buzzed (?:once|\d+ times), first at \d+\.\d+ s; guard\.action = .*\n"
)

#: What a run says that was stopped by a signal.
STOPPED_SAID = "canwall: interrupted; the drive is disabled\n"

Start: TypeAlias = Callable[..., "subprocess.Popen[str]"]
"""Starts a program that is ended with the test: arguments of its command line."""


def command(*arguments: object, cwd: Path | None = None) -> "subprocess.CompletedProcess[str]":
    """Run `canwall ARGUMENTS` in a forked process, see `fork_server`."""
    return _forked([COMMAND, *map(str, arguments)], cwd)


def python(*arguments: object, cwd: Path | None = None) -> "subprocess.CompletedProcess[str]":
    """Run `python ARGUMENTS` in a forked process."""
    return _forked([sys.executable, *map(str, arguments)], cwd)


def call(*arguments: object) -> Any:
    """Call `canwall ARGUMENTS` in this process; return its exit code."""
    from canwall import cli  # not in an emulated guest, where it takes seconds

    words = sys.argv
    try:
        sys.argv = ["canwall", *map(str, arguments)]
        with pytest.raises(SystemExit) as ended:
            cli.main()
    finally:
        sys.argv = words
    return ended.value.code


def _forked(words: list[str], cwd: Path | None) -> "subprocess.CompletedProcess[str]":
    pipe = subprocess.PIPE
    with ForkedPopen[str](words, stdout=pipe, stderr=pipe, text=True, cwd=cwd) as process:
        try:
            out, errors = process.communicate(timeout=PATIENCE_S)
        except BaseException:
            process.kill()
            raise
    return subprocess.CompletedProcess(words, process.returncode, out, errors)


def installed_command(
    *arguments: object, cwd: Path | None = None
) -> "subprocess.CompletedProcess[str]":
    """Run `canwall ARGUMENTS` as from a shell, its start included."""
    return subprocess.run(
        [COMMAND, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        cwd=cwd,
        check=False,
    )


def config_file(
    path: Path, changes: dict[str, str] | None = None, source: Path = SIM_CONFIG
) -> Path:
    """A copy of a configuration with other text in places, its EDS by its full path."""
    text = source.read_text()
    eds = str(config.shipped("eds/canwall-drive.eds"))
    for old, new in {'"../eds/canwall-drive.eds"': f'"{eds}"', **(changes or {})}.items():
        assert old in text or new in text, old
        text = text.replace(old, new)
    path.write_text(text)
    return path


@dataclass(frozen=True)
class Record:
    """A run's folder, read."""

    folder: Path

    @cached_property
    def signals(self) -> pa.Table:
        return read_signals(self.folder / "signals.parquet")

    def column(self, name: str) -> NDArray[Any]:
        column: NDArray[Any] = self.signals[name].to_numpy()
        return column

    @cached_property
    def summary(self) -> dict[str, Any]:
        content: dict[str, Any] = json.loads((self.folder / "summary.json").read_text())
        return content

    @cached_property
    def frames(self) -> list[can.Message]:
        return read_log(self.folder / "bus.log")

    @cached_property
    def cycles(self) -> list[tuple[bytes | None, bytes]]:
        """Data of TPDO (None: missing) and RPDO of each SYNC, as bus.log has them."""
        cycles: list[tuple[bytes | None, bytes]] = []
        tpdo: bytes | None = None
        for frame in self.frames:
            if frame.arbitration_id == SYNC:
                tpdo = None
            elif frame.arbitration_id == TPDO1:
                tpdo = bytes(frame.data)
            elif frame.arbitration_id == RPDO1:
                cycles.append((tpdo, bytes(frame.data)))
        return cycles


def read_log(path: Path) -> list[can.Message]:
    with can.LogReader(path) as reader:
        return list(reader)


def same_signals(one: Record, other: Record, rows: int | None = None) -> bool:
    """Return True if the (first) rows of two runs are equal bit by bit, apart from timing."""
    columns = [n for n in one.signals.column_names if n not in ("sync_interval_s", "latency_s")]
    a, b = (record.signals.select(columns).slice(0, rows) for record in (one, other))
    for name in columns:
        left, right = a[name].to_numpy(), b[name].to_numpy()
        if not np.array_equal(left, right):
            return False
    return bool(a.schema.equals(b.schema))


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def torque_is_on(bus_log: Path, above: int = 16) -> bool:
    """Return True once the log has an RPDO with a torque of the wall, above some ‰.

    A probe has 8 ‰, and up to 63 ‰ where a hand that is not known comes fast.
    """
    sent = (bytes.fromhex(word[8:12].decode()) for word in _enabling_rpdos(bus_log))
    return any(abs(int.from_bytes(torque, "little", signed=True)) > above for torque in sent)


def is_enabled(bus_log: Path) -> bool:
    """Return True once the log has an RPDO that keeps the drive enabled."""
    return bool(_enabling_rpdos(bus_log))


def _enabling_rpdos(bus_log: Path) -> list[bytes]:
    """The last RPDOs of the log with the controlword of OPERATION ENABLED."""
    if not bus_log.exists():
        return []
    with bus_log.open("rb") as file:
        file.seek(max(0, os.path.getsize(bus_log) - 4000))
        words = [line.split()[2] for line in file.read().splitlines()[1:-1]]
    return [word for word in words if word.startswith(b"205#0F00")]
