"""The cases of state_machine_cases.txt, and what belongs to the states beside the statusword."""

import re
from pathlib import Path
from typing import NamedTuple

import pytest
from canopen import SdoAbortedError
from canopen.profiles.p402 import State402
from simdrive_bench import (
    PRE_OPERATIONAL,
    RESET_COMMUNICATION,
    RESET_NODE,
    START,
    STOP,
    Bench,
)

NMT_EVENTS = {
    "pre-op": PRE_OPERATIONAL,
    "stop": STOP,
    "reset-node": RESET_NODE,
    "reset-comm": RESET_COMMUNICATION,
}
WAY = {
    "NOT READY TO SWITCH ON": "",
    "SWITCH ON DISABLED": "wait",
    "READY TO SWITCH ON": "wait 0006",
    "SWITCHED ON": "wait 0006 0007",
    "OPERATION ENABLED": "wait 0006 0007 000F",
    "QUICK STOP ACTIVE": "wait 0006 0007 000F 0002",
    "FAULT REACTION ACTIVE": "wait 0006 0007 000F pre-op",
    "FAULT": "wait 0006 0007 000F pre-op wait",
}
OPTION_SIZE = 2


class Case(NamedTuple):
    before: str
    options: str
    events: str
    after: str
    statusword: str
    transition: str


def cases() -> list[Case]:
    text = Path(__file__).with_name("state_machine_cases.txt").read_text()
    rows = (line for line in text.splitlines() if line and not line.startswith("#"))
    return [Case(*re.split(r" {2,}", row)) for row in rows]


def happen(bench: Bench, events: str) -> None:
    for event in events.split():
        if event == "wait":
            bench.tick()
        elif event in NMT_EVENTS:
            bench.nmt(NMT_EVENTS[event])
        elif event.startswith("mode"):
            bench.write(0x6060, 0, int(event.removeprefix("mode")), 1)
        else:
            bench.write(0x6040, 0, int(event, 16), 2)


def state_name(statusword: int) -> str:
    """Return the state as canopen's master reads it."""
    (name,) = [name for name, (mask, bits) in State402.SW_MASK.items() if statusword & mask == bits]
    return str(name)


@pytest.mark.parametrize("case", cases(), ids=lambda case: f"{case.before}: {case.events}")
def test_case(bench: Bench, case: Case) -> None:
    bench.write(0x6060, 0, 10, 1)
    bench.nmt(START)
    for option in case.options.strip("-").split():
        index, value = option.split("=")
        bench.write(int(index, 16), 0, int(value), OPTION_SIZE)
    happen(bench, WAY[case.before])
    assert state_name(bench.read(0x6041)) == case.before

    happen(bench, case.events if case.events != "-" else "")

    statusword = bench.read(0x6041)
    assert state_name(statusword) == case.after
    assert f"{statusword:04X}" == case.statusword


def test_cases_reach_every_state() -> None:
    assert {case.after for case in cases()} == set(State402.SW_MASK)


@pytest.mark.parametrize(
    ("index", "served"),
    [
        (0x605A, {0, 1, 2, 3, 5, 6, 7}),
        (0x605B, {0, 1}),
        (0x605C, {0, 1}),
        (0x605E, {0, 1, 2, 3}),
        (0x6007, {0, 1, 2, 3}),
    ],
)
def test_option_codes_take_what_they_serve(bench: Bench, index: int, served: set[int]) -> None:
    for value in range(-2, 9):
        if value in served:
            bench.write(index, 0, value, OPTION_SIZE)
            assert bench.read(index, signed=True) == value
        else:
            with pytest.raises(SdoAbortedError, match="06090030"):
                bench.write(index, 0, value, OPTION_SIZE)


def test_mode_of_operation(bench: Bench) -> None:
    assert bench.read(0x6502) == 1 << 9 | 1 << 5 | 1 << 3
    assert bench.read(0x6061) == 0
    bench.write(0x6060, 0, 10, 1)
    assert bench.read(0x6061) == 10
    for mode in (-1, 1, 3, 5, 7, 8, 9, 11):
        with pytest.raises(SdoAbortedError, match="06090030"):
            bench.write(0x6060, 0, mode, 1)
    assert bench.read(0x6061) == 10


def test_fault_shows_in_error_objects_until_reset(bench: Bench) -> None:
    bench.enable()
    bench.nmt(PRE_OPERATIONAL)
    bench.tick()
    assert bench.read(0x603F) == 0x8100
    assert bench.read(0x1001) == 0x11
    assert bench.read(0x1003, 1) & 0xFFFF == 0x8100
    bench.write(0x6040, 0, 0x80, 2)
    assert bench.read(0x603F) == 0
    assert bench.read(0x1001) == 0
    assert bench.emergencies() == [(0x8100, 0x11), (0x0000, 0x00)]


def test_fault_outlives_a_reset_of_the_communication(bench: Bench) -> None:
    bench.enable()
    bench.nmt(PRE_OPERATIONAL)
    bench.tick()
    bench.nmt(RESET_COMMUNICATION)
    assert bench.read(0x1001) == 0x11
    assert bench.read(0x603F) == 0x8100
    bench.nmt(RESET_NODE)
    assert bench.read(0x1001) == 0
    assert bench.read(0x603F) == 0


def test_drive_enabled_over_sdo_stays_so_when_the_node_is_started(bench: Bench) -> None:
    bench.write(0x6060, 0, 10, 1)
    happen(bench, WAY["OPERATION ENABLED"])
    bench.nmt(START)
    assert bench.read(0x6041) == 0x1237


def test_automatic_transitions_need_no_tick_where_there_is_sync(bench: Bench) -> None:
    bench.sync()
    assert bench.read(0x6041) == 0x0250
