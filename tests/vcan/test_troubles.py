"""Interfaces that go down, queues that fill up, and error frames, in the middle of a run."""

import errno
import struct

from commands import Record
from rig import SYNC
from socketcan import (
    SLOW,
    UNTIL_STOPPED,
    Bench,
    Canwall,
    ip,
    is_disabled,
    run_with_torque,
    tc,
    wait_for,
)

from canwall.bus import reason

_SLOW = SLOW | UNTIL_STOPPED


def _assert_told(run: Canwall, what: str) -> None:
    """Assert that the run reports what failed and what that means, in one line each."""
    assert run.wait() == 1
    assert len(run.errors) == 2, run.errors
    failed, left = run.errors
    assert failed == f"canwall: the bus failed: {what}"
    assert left.startswith("canwall: the drive did not confirm that it is disabled (node 5: ")
    assert left.endswith(": switch it off before you touch it")


def test_interface_down_and_up(bench: Bench) -> None:
    configuration = bench.config(_SLOW)
    drive = bench.drive(configuration)
    run = run_with_torque(bench, bench.folder / "run", configuration)
    ip("link", "set", "vcan0", "down")
    try:
        _assert_told(run, "vcan0 is down; as root: ip link set vcan0 up")
        none = bench.canwall("run", configuration, "--output", bench.folder / "none")
        assert none.wait() == 1
        assert none.errors == ["canwall: vcan0 is down; as root: ip link set vcan0 up"]
    finally:
        ip("link", "set", "vcan0", "up")
    # Nobody could tell the drive: its watchdog did.
    bus = bench.bus()
    wait_for(lambda: is_disabled(bus))
    assert "the bus is gone" in drive.out
    wait_for(lambda: "the bus is back" in drive.out)
    again = bench.canwall("run", configuration, "--duration", 1, "--output", bench.folder / "2")
    assert (again.wait(), again.errors) == (0, [])
    assert drive.interrupt() == 0


def test_transmit_queue_that_stays_full(bench: Bench) -> None:
    configuration = bench.config(_SLOW)
    drive = bench.drive(configuration)
    run = run_with_torque(bench, bench.folder / "run", configuration)
    # Room for one frame, which does not leave.
    tc("qdisc", "add", "dev", "vcan0", "root", "netem", "delay", "100s", "limit", "1")
    try:
        _assert_told(run, reason(errno.ENOBUFS, "vcan0"))
    finally:
        tc("qdisc", "del", "dev", "vcan0", "root")
    bus = bench.bus()
    wait_for(lambda: is_disabled(bus))
    assert drive.interrupt() == 0


def test_error_frames(bench: Bench) -> None:
    configuration = bench.config(UNTIL_STOPPED)
    bench.drive(configuration)
    folder = bench.folder / "run"
    run = run_with_torque(bench, folder, configuration)
    # linux/can/error.h: the controller is error-passive (twice), then bus-off.
    bench.start("cansend", "vcan0", "20000004#0030000000000000").wait()
    bench.start("cansend", "vcan0", "20000004#0030000000000000").wait()
    bench.start("cansend", "vcan0", "20000040#0000000000000000").wait()
    assert run.wait() == 1
    (line,) = run.errors
    assert line.endswith("the adapter is bus-off: look at bit rate, cable and termination")
    record = Record(folder)
    assert record.summary["error_frames"] == 3
    errors = [n for n, frame in enumerate(record.frames) if frame.is_error_frame]
    assert len(errors) == 3
    between = record.frames[errors[0] : errors[2]]
    assert any(frame.arbitration_id == SYNC for frame in between), "the first ones end nothing"
    assert struct.unpack("<Hh", record.cycles[-1][1]) == (0, 0)
    assert is_disabled(bench.bus())
