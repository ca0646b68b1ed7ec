"""`canwall` in processes of its own on SocketCAN, can-utils beside it, and where they meet."""

import contextlib
import multiprocessing
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import can
import numpy as np
import pytest
from commands import (
    GUARD_SAID,
    ON_A_BUSY_MACHINE,
    SOFT_WALL,
    Record,
    config_file,
    torque_is_on,
)
from other_nodes import OtherNodes

import canwall.cycle.way_out
import canwall.drive.other_masters
import canwall.record.recorder
import canwall.record.writer
from canwall import cli, config
from canwall.drive import DriveState, state_of

VCAN_CONFIG = config.shipped("config/vcan.toml")

#: A guest under emulation, on a machine that has other things to do, takes its time.
PATIENCE_S = 400.0

#: Changes of config/vcan.toml: SYNCs of a rate that an emulated processor keeps beside whatever
#: else its machine does, and a wall that bears it.
SLOW = (
    ON_A_BUSY_MACHINE
    | SOFT_WALL
    | {
        "cycle_s = 0.001": 'cycle_s = 0.1\npace = "real_time"',
        "wait_s = 5.0": "wait_s = 60.0\nwatchdog_s = 5.0\nsdo_timeout_s = 2.0",
        "ramp_cycles = 10": "ramp_cycles = 1000\nstuck_rad = 0.0\nlate_cycles = 0",
    }
)

#: A hand that leans on the wall, until the run ends by itself.
UNTIL_STOPPED = {"rest_rad = 0.1": "rest_rad = -0.1", "duration_s = 4.2": ""}

_SDO_REQUEST, _SDO_ANSWER, _STATUSWORD = 0x605, 0x585, b"\x40\x41\x60\x00\0\0\0\0"


def has_socketcan() -> bool:
    """Return True if this kernel has PF_CAN."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return True


def is_up(interface: str) -> bool:
    with contextlib.suppress(OSError), can.Bus(interface="socketcan", channel=interface):
        return True
    return False


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def first_difference(one: Sequence[object], other: Sequence[object]) -> tuple[object, ...] | None:
    """Return the first difference of two sequences (else of their lengths), None if they are equal.

    pytest would lay thousands of frames side by side, for minutes.
    """
    for n, pair in enumerate(zip(one, other, strict=False)):
        if pair[0] != pair[1]:
            return n, *pair
    return None if len(one) == len(other) else (len(one), len(other))


def assert_same_run(one: Record, other: Record, cycles: int | None = None) -> None:
    """Compare the (first) cycles of two runs, one of which may be another processor's.

    They are equal bit by bit on the bus; what is computed beside, but for rounding.
    """
    assert first_difference(one.cycles[:cycles], other.cycles[:cycles]) is None
    assert one.signals.schema.equals(other.signals.schema)
    for name in set(one.signals.column_names) - {"sync_interval_s", "latency_s"}:
        left, right = (record.column(name)[:cycles] for record in (one, other))
        if left.dtype.kind == "f":
            np.testing.assert_allclose(left, right, rtol=1e-9, atol=1e-9, err_msg=name)
        else:
            assert np.array_equal(left, right), name


@contextlib.contextmanager
def _fork_is_safe() -> Iterator[None]:
    """Python 3.12 and newer warn of forking where libraries have threads. Theirs are idle."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        yield


class Canwall:
    """`canwall ARGUMENTS` in a process of its own.

    It is forked from this one, which has loaded already what takes an emulated processor twenty
    seconds to load.
    """

    def __init__(self, folder: Path, *arguments: object) -> None:
        folder.mkdir()
        self._out, self._err = folder / "out.txt", folder / "err.txt"
        words = [str(word) for word in arguments]
        fork = multiprocessing.get_context("fork")
        self._process = fork.Process(target=_main, args=(words, self._out, self._err))
        with _fork_is_safe():
            self._process.start()

    @property
    def out(self) -> str:
        return self._out.read_text() if self._out.exists() else ""

    @property
    def errors(self) -> list[str]:
        """Lines of its standard error, without what the guard says of the plain wall."""
        said = self._err.read_text() if self._err.exists() else ""
        return re.sub(GUARD_SAID, "", said).splitlines()

    @property
    def running(self) -> bool:
        return self._process.is_alive()

    def wait(self) -> int:
        """Its exit code."""
        self._process.join(PATIENCE_S)
        assert self._process.exitcode is not None, "still runs"
        return self._process.exitcode

    def interrupt(self) -> int:
        """End it as Ctrl-C does."""
        self.send(signal.SIGINT)
        return self.wait()

    def send(self, number: signal.Signals) -> None:
        """Send it a signal."""
        assert self._process.pid is not None
        os.kill(self._process.pid, number)

    def kill(self) -> None:
        self._process.kill()
        self._process.join()


def _main(words: list[str], out: Path, err: Path) -> None:
    for descriptor, path in ((1, out), (2, err)):
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(file, descriptor)
    sys.stdout = open(1, "w", buffering=1, closefd=False)  # noqa: SIM115 (until the process ends)
    sys.stderr = open(2, "w", buffering=1, closefd=False)  # noqa: SIM115
    sys.argv = ["canwall", *words]
    with light():
        cli.main()


@contextlib.contextmanager
def light() -> Iterator[None]:
    """Runs of this process are not drawn, and the writer of their record is forked as well.

    Neither has to do with the bus, and each takes an emulated processor ten seconds. One that its
    machine has no time for pauses for seconds, which is no call that hangs.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(canwall.record.Recorder, "draw", lambda recorder, given_up: [])
        patch.setattr(canwall.record.writer, "_prepare_to_draw", lambda ended: None)
        patch.setattr(canwall.record.recorder.subprocess, "Popen", _ForkedWriter)
        patch.setattr(canwall.cycle.way_out, "_STANDSTILL_S", 60.0)
        yield


@contextlib.contextmanager
def long_ears() -> Iterator[None]:
    """Processes that begin meanwhile listen for another master until there is one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(canwall.drive.other_masters, "_LISTEN_S", PATIENCE_S)
        yield


class _ForkedWriter:
    """Stand-in for the `subprocess.Popen` of the writer, as far as the record uses it."""

    def __init__(self, command: list[str], **_: object) -> None:
        assert command[1:4] == ["-P", "-m", "canwall.record.writer"]
        its_input, ours = os.pipe()
        theirs, its_output = os.pipe()
        self.stdin = open(ours, "wb", buffering=0)  # noqa: SIM115 (closed by __exit__)
        self.stdout = open(theirs, "rb", buffering=0)  # noqa: SIM115
        with _fork_is_safe():
            self._pid = os.fork()
        if self._pid == 0:
            os.setsid()
            os.dup2(its_input, 0)
            os.dup2(its_output, 1)
            for descriptor in (its_input, ours, theirs, its_output):
                os.close(descriptor)
            sys.argv = command[3:]
            sys.stdin, sys.stdout = open(0), open(1, "w")  # noqa: SIM115 (until the process ends)
            try:
                canwall.record.writer.main()
            finally:
                os._exit(0)
        os.close(its_input)
        os.close(its_output)

    def __enter__(self) -> "_ForkedWriter":
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.stdin.close()
        self.stdout.close()
        os.waitpid(self._pid, 0)

    def kill(self) -> None:
        os.kill(self._pid, signal.SIGKILL)


class Bench:
    """Programs on an interface, ended with the test."""

    def __init__(self, folder: Path, exchange: str, interface: str = "vcan0") -> None:
        self.folder, self.exchange, self.interface = folder, exchange, interface
        self._stack = contextlib.ExitStack()
        self._started = 0

    def close(self) -> None:
        self._stack.close()

    def config(self, changes: dict[str, str] | None = None) -> Path:
        """config/vcan.toml with the exchange of this bench, and other text in places."""
        self._started += 1
        with_exchange = {"[drive]\n": f'exchange = "{self.exchange}"\n[drive]\n', **(changes or {})}
        return config_file(self.folder / f"{self._started}.toml", with_exchange, VCAN_CONFIG)

    def canwall(self, *arguments: object) -> Canwall:
        self._started += 1
        folder = self.folder / f"canwall{self._started}"
        program = Canwall(folder, *arguments)
        self._stack.callback(program.kill)
        return program

    def drive(self, configuration: Path = VCAN_CONFIG) -> Canwall:
        """A simulated drive that hears what is on the bus."""
        drive = self.canwall("drive", configuration)
        wait_for(lambda: "simulated drive, node 5, on socketcan" in drive.out)
        return drive

    def start(self, *command: object, output: Path | None = None) -> "subprocess.Popen[bytes]":
        """One of can-utils, in the background."""
        words = [str(word) for word in command]
        if shutil.which(words[0]) is None:
            pytest.skip(f"{words[0]} is not installed (Debian: can-utils)")
        with contextlib.ExitStack() as files:
            stdout = (
                subprocess.DEVNULL if output is None else files.enter_context(output.open("wb"))
            )
            program = subprocess.Popen(words, stdout=stdout)
        self._stack.enter_context(program)
        self._stack.callback(program.kill)
        return program

    def other_nodes(self) -> None:
        """Other nodes, which answer to a SYNC now and then: an emulated processor is slow."""
        self._stack.enter_context(OtherNodes(self.bus(), every=10))

    def bus(self) -> can.BusABC:
        """A socket of the test's own on the interface."""
        bus = can.Bus(interface="socketcan", channel=self.interface)
        self._stack.callback(bus.shutdown)
        return bus


def run_with_torque(bench: Bench, folder: Path, configuration: Path) -> Canwall:
    """`canwall run` that renders the wall, and commands a torque by now."""
    run = bench.canwall("run", configuration, "--output", folder)
    wait_for(lambda: torque_is_on(folder / "bus.log") or not run.running)
    assert run.running, run.errors
    return run


def statusword(bus: can.BusABC) -> int | None:
    """The drive's statusword over SDO; None where there is no answer."""
    with contextlib.suppress(can.CanError):
        while bus.recv(0) is not None:
            pass
        bus.send(can.Message(arbitration_id=_SDO_REQUEST, data=_STATUSWORD, is_extended_id=False))
        for message in _frames(bus, 2.0):
            if message.arbitration_id == _SDO_ANSWER and message.data[:4] == b"\x4b\x41\x60\x00":
                return int.from_bytes(message.data[4:6], "little")
    return None


def is_disabled(bus: can.BusABC) -> bool:
    """Return True if the drive reports a state without torque."""
    word = statusword(bus)
    return word is not None and state_of(word) in (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT)


def _frames(bus: can.BusABC, seconds: float) -> Iterator[can.Message]:
    deadline = time.monotonic() + seconds
    while (remaining := deadline - time.monotonic()) > 0.0:
        message = bus.recv(remaining)
        if message is not None:
            yield message


def ip(*arguments: object) -> None:
    """`ip ARGUMENTS`, which takes root; the test is skipped where it is not allowed."""
    _as_root("ip", *arguments)


def tc(*arguments: object) -> None:
    """`tc ARGUMENTS`, likewise."""
    _as_root("tc", *arguments)


def _as_root(*command: object) -> None:
    words = [str(word) for word in command]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if "not permitted" in done.stderr:
        pytest.skip(f"{' '.join(words)} takes root: run scripts/test as root, or in a guest")
    assert done.returncode == 0, done.stderr
