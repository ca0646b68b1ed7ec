"""The machine's set-up for real time: what is granted is given back, what is not is said."""

import os
import sys
from pathlib import Path

import pytest

from canwall.cycle import machine
from canwall.cycle.machine import real_time_machine


def state() -> tuple[object, ...]:
    locked = next(
        line for line in Path("/proc/self/status").read_text().splitlines() if "VmLck" in line
    )
    return (
        locked,
        os.sched_getscheduler(0),
        os.sched_getaffinity(0),
        sys.getswitchinterval(),
        len(os.listdir("/proc/self/fd")),
    )


def test_all_is_put_back() -> None:
    before = state()
    processor = min(os.sched_getaffinity(0))
    with real_time_machine(processor) as granted:
        assert set(granted) == {"scheduling", "memory", "wake_up", "processor"}
        assert granted["processor"] == f"number {processor}"
        assert os.sched_getaffinity(0) == {processor}
        assert sys.getswitchinterval() <= 1e-4
        locked = granted["memory"] == "locked"
        assert (state()[0] != before[0]) == locked
        # Who is started meanwhile has no such priority.
        if granted["scheduling"].startswith("SCHED_FIFO"):
            assert os.sched_getscheduler(0) & os.SCHED_RESET_ON_FORK
    assert state() == before


def test_what_is_not_granted_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    class Refuses:
        def mlockall(self, flags: int) -> int:
            return -1

    monkeypatch.setattr(machine.ctypes, "CDLL", lambda name, use_errno: Refuses())
    monkeypatch.setattr(machine, "_WAKE_UP", tmp_path / "missing" / "cpu_dma_latency")
    with real_time_machine(processor=4095) as granted:
        assert "'@realtime - memlock unlimited'" in granted["memory"]
        assert "No such file" in granted["wake_up"]
        assert "bus.processor = 4095" in granted["processor"]
