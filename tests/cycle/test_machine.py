"""The machine's set-up for real time: what is granted is given back, what is not is said."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from canwall import realtime
from canwall.cycle import Grant, machine
from canwall.cycle.machine import real_time_machine
from canwall.realtime import real_time_priority


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
        assert granted["processor"].found == f"number {processor}"
        assert os.sched_getaffinity(0) == {processor}
        assert sys.getswitchinterval() <= 1e-4
        locked = granted["memory"].found == "locked"
        assert (state()[0] != before[0]) == locked
        # Who is started meanwhile has no such priority.
        if granted["scheduling"].found.startswith("SCHED_FIFO"):
            assert os.sched_getscheduler(0) & os.SCHED_RESET_ON_FORK
    assert state() == before


def test_what_is_not_granted_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    class Refuses:
        def mlockall(self, flags: int) -> int:
            return -1

    asked: list[int] = []

    def refuse(pid: int, policy: int, parameters: os.sched_param) -> None:
        asked.append(parameters.sched_priority)
        raise PermissionError

    monkeypatch.setattr(machine.ctypes, "CDLL", lambda name, use_errno: Refuses())
    monkeypatch.setattr(machine, "_WAKE_UP", tmp_path / "missing" / "cpu_dma_latency")
    monkeypatch.setattr(realtime.os, "sched_setscheduler", refuse)
    monkeypatch.setattr(realtime.getpass, "getuser", lambda: "someone")
    with real_time_machine(processor=4095) as granted:
        assert granted["scheduling"].found == "no real-time priority"
        assert granted["scheduling"].advice.endswith(": someone - rtprio 46")
        assert granted["memory"].advice.endswith(": someone - memlock unlimited")
        assert "No such file" in granted["wake_up"].found
        assert granted["wake_up"].advice == ""
        assert "bus.processor = 4095" in granted["processor"].found
    assert asked[0] == 45


def test_file_that_may_not_be_written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(machine, "_WAKE_UP", tmp_path)  # not even root writes to a folder
    with real_time_machine() as granted:
        assert "Is a directory" in granted["wake_up"].found
        assert 'KERNEL=="cpu_dma_latency", GROUP="realtime"' in granted["wake_up"].advice


#: For processes of their own: what takes root's privileges from them.
UNPRIVILEGED = """
import ctypes, json, os, resource
from canwall.cycle import real_time_machine, real_time_priority
def give_up_privileges():
    # capset(2), version 3: no effective, permitted or inheritable capability is left.
    header, data = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
    assert ctypes.CDLL(None).capset(header, data) == 0
"""


def of_process(program: str) -> Any:
    """Run a program in a process of its own and return its JSON output."""
    done = subprocess.run(
        [sys.executable, "-c", UNPRIVILEGED + program],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stderr == ""
    return json.loads(done.stdout)


@pytest.mark.slow
def test_user_without_privileges() -> None:
    granted = of_process(
        """
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))
give_up_privileges()
with real_time_machine() as granted:
    print(json.dumps(granted))
"""
    )
    scheduling, memory = Grant(*granted["scheduling"]), Grant(*granted["memory"])
    assert scheduling.found == "no real-time priority"
    assert scheduling.advice.endswith(" - rtprio 46")
    assert memory.found.startswith("not locked (")
    assert memory.advice.endswith(" - memlock unlimited")


def test_user_who_may_have_less_of_a_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[int] = []

    def up_to_20(pid: int, policy: int, parameters: os.sched_param) -> None:
        if parameters.sched_priority > 20:
            raise PermissionError
        taken.append(parameters.sched_priority)

    monkeypatch.setattr(realtime.os, "sched_setscheduler", up_to_20)
    monkeypatch.setattr(realtime.resource, "getrlimit", lambda which: (20, 20))
    with real_time_priority() as granted:
        assert granted.found == "SCHED_FIFO, priority 20"
        assert granted.advice.endswith(" - rtprio 46")
    assert taken == [20, os.sched_getparam(0).sched_priority]


@pytest.mark.slow
def test_priority_is_given_back_without_privileges() -> None:
    """Only root takes back that children start without the priority."""
    with real_time_priority() as granted:
        pass
    if not granted.found.startswith("SCHED_FIFO"):
        pytest.skip("no real-time priority here")
    policy = of_process(
        """
with real_time_priority():
    give_up_privileges()
print(json.dumps(os.sched_getscheduler(0)))
"""
    )
    assert policy == os.SCHED_OTHER | os.SCHED_RESET_ON_FORK
