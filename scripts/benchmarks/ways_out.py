"""Time until the torque of a dead or dying master is gone, on unixcan and in real time."""

import signal
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can

from canwall import config

_COMMAND = str(Path(sys.executable).with_name("canwall"))
_RPDO, _TPDO, _EMCY = 0x205, 0x185, 0x085
_PATIENCE_S = 60.0
#: After this long without a frame nothing more will come.
_SILENCE_S = 5.0
_REPEATS = 3
_ATTEMPTS = 10
#: Without a torque for this long, the wall is not rendered any more.
_QUIET_S = 0.05
#: A hand that stays on the wall; default limits and watchdog time but for a machine that is busy.
_CHANGES = {
    "cycle_s = 0.001": 'cycle_s = 0.001\npace = "real_time"',
    "hold_cycles = 2": "hold_cycles = 100",
    "stiffness_nm_per_rad = 50.0": "stiffness_nm_per_rad = 2.0",
    "press_s = 0.5": "press_s = 3000.0",
    "strikes = 4\n": "strikes = 1\n",
    "interval_s = 1.0": "interval_s = 4000.0",
    "duration_s = 4.2\n": "",
}
#: The stronger watchdogs that the dictionary lacks.
_WATCHDOGS = {
    "rpdo_event_timer": (),
    "consumer_heartbeat": ("1400sub5",),
    "life_guarding": ("1400sub5", "1016", "1016sub0", "1016sub1", "1016sub2", "1016sub3"),
}


def ways_out() -> dict[str, Any]:
    """Milliseconds from the signal to the last RPDO with a torque, and to the drive's own end.

    The drive's end: the first TPDO that shows neither OPERATION ENABLED nor a torque, or the EMCY
    of its watchdog (100 ms, then 0x6007 = 2, disable voltage: no torque from there on). Medians
    and the longest. drive_after_last_rpdo: the watchdog's own time.
    """
    result: dict[str, Any] = {"repeats": _REPEATS}
    for name, number in (("ctrl_c", signal.SIGINT), ("sigterm", signal.SIGTERM)):
        result[name] = _summary([_measured((), number) for _ in range(_REPEATS)])
    for watchdog, missing in _WATCHDOGS.items():
        for name, number in (("sigkill", signal.SIGKILL), ("sigstop", signal.SIGSTOP)):
            turns = [_measured(missing, number) for _ in range(_REPEATS)]
            result[f"{name}, {watchdog}"] = _summary(turns)
    return result


def _summary(turns: list[tuple[float, float, float]]) -> dict[str, Any]:
    names = ("last_rpdo_with_torque_ms", "drive_without_torque_ms", "drive_after_last_rpdo_ms")
    return {
        name: {"median": round(statistics.median(times), 1), "longest": round(max(times), 1)}
        for name, times in zip(names, zip(*turns, strict=True), strict=True)
    }


def _measured(missing: tuple[str, ...], number: int) -> tuple[float, float, float]:
    """A turn that nothing else has disturbed: on a busy machine the watchdog may bite before."""
    for _ in range(_ATTEMPTS):
        try:
            return _turn(missing, number)
        except RuntimeError as error:
            print(f"bench: ways_out: once more: {error}", file=sys.stderr)
    raise RuntimeError(f"the machine is too busy: no turn of {_ATTEMPTS} was undisturbed")


def _turn(missing: tuple[str, ...], number: int) -> tuple[float, float, float]:
    with tempfile.TemporaryDirectory() as folder:
        file = _configuration(Path(folder), missing)
        with (
            _running("drive", file, "--real-time") as drive,
            can.Bus(interface="unixcan", channel=f"{folder}/bus") as bus,
            _running("run", file, "--output", Path(folder) / "run") as master,
        ):
            frames = _Frames(bus)
            frames.begin()
            frames.until(lambda f: f.arbitration_id == _RPDO and _torque(f) != 0)
            frames.pass_time(0.3)
            if time.time() - (frames.last_torque_s or 0.0) > _QUIET_S:
                raise RuntimeError("the wall was given up before the signal")
            sent_s = time.time()
            master.send_signal(number)
            end_s: float | None = None
            while end_s is None:
                frame = frames.next()
                if frame.timestamp < sent_s:
                    continue
                if frame.arbitration_id == _EMCY or _is_off(frame):
                    end_s = frame.timestamp
            last_s = frames.last_torque_s
            if number == signal.SIGSTOP:
                master.kill()
            master.wait(_PATIENCE_S)
            drive.send_signal(signal.SIGINT)
    assert last_s is not None
    return (
        max(0.0, (last_s - sent_s) * 1e3),
        (end_s - sent_s) * 1e3,
        (end_s - last_s) * 1e3,
    )


class _Frames:
    """Frames on the bus, and the time of the last RPDO with a torque."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self.last_torque_s: float | None = None

    def next(self) -> can.Message:
        """The next frame. Raises RuntimeError if none comes."""
        frame = self._bus.recv(_SILENCE_S)
        if frame is None:
            raise RuntimeError("nothing is on the bus")
        if frame.arbitration_id == _RPDO and _torque(frame):
            self.last_torque_s = frame.timestamp
        return frame

    def begin(self) -> None:
        """Wait for the first frame: a program takes its time to start."""
        if self._bus.recv(_PATIENCE_S) is None:
            raise RuntimeError("nothing is on the bus")

    def until(self, found: Callable[[can.Message], bool]) -> None:
        """Go on to such a frame."""
        while not found(self.next()):
            pass

    def pass_time(self, duration_s: float) -> None:
        """Go on for so long."""
        end = time.time() + duration_s
        self.until(lambda frame: frame.timestamp >= end)


def _torque(rpdo: can.Message) -> int:
    return int(struct.unpack_from("<h", rpdo.data, 2)[0])


def _is_off(frame: can.Message) -> bool:
    if frame.arbitration_id != _TPDO:
        return False
    _, statusword, torque = struct.unpack("<iHh", frame.data)
    return statusword & 0x6F != 0x27 and torque == 0


def _configuration(folder: Path, missing: tuple[str, ...]) -> Path:
    kept, keep = [], True
    for line in config.shipped("eds/canwall-drive.eds").read_text().splitlines():
        if line.startswith("["):
            keep = line.strip("[]") not in missing
        if keep:
            kept.append(line)
    eds = folder / "drive.eds"
    eds.write_text("\n".join(kept))
    text = config.shipped("config/unixcan.toml").read_text()
    changes = _CHANGES | {
        '"../eds/canwall-drive.eds"': f'"{eds}"',
        "/tmp/canwall.sock": f"{folder}/bus",
    }
    for old, new in changes.items():
        if old not in text:
            raise RuntimeError(f"config/unixcan.toml has no {old!r}")
        text = text.replace(old, new)
    file = folder / "c.toml"
    file.write_text(text)
    return file


@contextmanager
def _running(command: str, file: Path, *arguments: object) -> "Iterator[subprocess.Popen[str]]":
    """`canwall COMMAND FILE ARGUMENTS`, ended with the block; a drive is on its bus already."""
    process = subprocess.Popen(
        [_COMMAND, command, str(file), *map(str, arguments)], stdout=subprocess.PIPE, text=True
    )
    try:
        if command == "drive" and process.stdout is not None:
            process.stdout.readline()
        yield process
    finally:
        try:
            process.wait(_PATIENCE_S if command == "drive" else 10.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()
