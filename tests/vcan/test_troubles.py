"""Interfaces that go down, queues that fill up, and error frames, in the middle of a run."""

import re
import struct

from commands import Record
from rig import SYNC
from socketcan import UNTIL_STOPPED, Bench, Canwall, ip, is_disabled, run_with_torque, tc, wait_for

#: SYNCs of a rate that an emulated processor keeps, and a wall that bears it.
_SLOW = {
    "cycle_s = 0.001": 'cycle_s = 0.05\npace = "real_time"',
    "wait_s = 5.0": "wait_s = 60.0\nwatchdog_s = 2.0",
    "stiffness_nm_per_rad = 50.0": "stiffness_nm_per_rad = 0.5",
    "hold_cycles = 2": "hold_cycles = 100",
    "ramp_cycles = 10": "ramp_cycles = 1000\nstuck_rad = 0.0",
    'law = "half_sample"': 'law = "standard"',
    **UNTIL_STOPPED,
}


def _assert_told_in_lines(run: Canwall) -> None:
    assert run.errors
    assert all(line.startswith("canwall: ") for line in run.errors), run.errors


def test_interface_down_and_up(bench: Bench) -> None:
    configuration = bench.config(_SLOW)
    drive = bench.drive(configuration)
    run = run_with_torque(bench, bench.folder / "run", configuration)
    ip("link", "set", "vcan0", "down")
    try:
        assert run.wait() == 1
    finally:
        ip("link", "set", "vcan0", "up")
    _assert_told_in_lines(run)
    assert "the bus failed" in run.errors[0]
    assert re.search("[Nn]etwork is down|interface is down", run.errors[0])
    # Nobody could tell the drive: its watchdog did.
    bus = bench.bus()
    wait_for(lambda: is_disabled(bus))
    assert "the bus is gone" in drive.out
    assert "the bus is back" in drive.out
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
        assert run.wait() == 1
    finally:
        tc("qdisc", "del", "dev", "vcan0", "root")
    _assert_told_in_lines(run)
    assert "the bus failed" in run.errors[0]
    assert re.search("transmit (queue stays|buffer) full", run.errors[0])
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
    assert "the adapter is bus-off" in line
    record = Record(folder)
    assert record.summary["error_frames"] == 3
    errors = [n for n, frame in enumerate(record.frames) if frame.is_error_frame]
    assert len(errors) == 3
    between = record.frames[errors[0] : errors[2]]
    assert any(frame.arbitration_id == SYNC for frame in between), "the first ones end nothing"
    assert struct.unpack("<Hh", record.cycles[-1][1]) == (0, 0)
    assert is_disabled(bench.bus())
