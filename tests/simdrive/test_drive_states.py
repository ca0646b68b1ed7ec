"""The cases of state_machine_cases.txt, and what belongs to the states beside the statusword."""

import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pytest
from bus_bench import PERIOD_S, RATED_NM, BusBench
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
SUPPLIES = {
    "sto": ("sto", True),
    "sto-off": ("sto", False),
    "undervoltage": ("undervoltage", True),
    "voltage": ("undervoltage", False),
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
STANDSTILL_RAD_S = 0.105
COUNTS_PER_RAD = 131072 / 6.283185307179586
BRAKED_BY_NOW = 200


class Case(NamedTuple):
    before: str
    speed: str
    options: str
    events: str
    after: str
    statusword: str
    transition: str
    meanwhile: str
    braking: str


class Moment(NamedTuple):
    """State of the drive when it answered a SYNC."""

    state: str
    speed: float
    demand: int


def cases() -> list[Case]:
    text = Path(__file__).with_name("state_machine_cases.txt").read_text()
    rows = (line for line in text.splitlines() if line and not line.startswith("#"))
    return [Case(*re.split(r" {2,}", row)) for row in rows]


def state_name(statusword: int) -> str:
    """Return the state as canopen's master reads it."""
    (name,) = [name for name, (mask, bits) in State402.SW_MASK.items() if statusword & mask == bits]
    return str(name)


def set_option(bench: BusBench, option: str) -> None:
    """Write an object, e.g. "6007=2"."""
    index, value = option.split("=")
    bench.write(int(index, 16), int(value))


def happen(bench: BusBench, events: str, braking: str = "-") -> list[Moment]:
    """Let the events come; return the braking SYNC by SYNC, if there was one."""
    moments: list[Moment] = []
    for event in events.split():
        if event == "wait":
            bench.wait()
        elif event == "sync":
            bench.sync()
        elif event == "brake":
            moments = brake(bench, braking)
        elif event in NMT_EVENTS:
            bench.nmt(NMT_EVENTS[event])
        elif event in SUPPLIES:
            name, active = SUPPLIES[event]
            getattr(bench.drive._pds, name)(active)
        elif "=" in event:
            set_option(bench, event)
        elif event.startswith("mode"):
            bench.write(0x6060, int(event.removeprefix("mode")))
        elif event.startswith("t"):
            bench.write(0x6071, int(event.removeprefix("t")))
        else:
            bench.write(0x6040, int(event, 16))
    return moments


def brake(bench: BusBench, how: str) -> list[Moment]:
    moments: list[Moment] = []
    over = False
    while not over:
        bench.sync()
        state = state_name(bench.read(0x6041))
        moments.append(Moment(state, bench.flywheel.speed_rad_s, bench.read(0x6074)))
        if how == "free":
            over = len(moments) == 3
        elif how == "6087":
            over = moments[-1].demand == 0
        else:
            over = abs(moments[-1].speed) < STANDSTILL_RAD_S
        assert len(moments) < BRAKED_BY_NOW
    bench.sync()
    return moments


def check_braking(bench: BusBench, case: Case, moments: list[Moment]) -> None:
    speeds = [moment.speed for moment in moments]
    demands = [moment.demand for moment in moments]
    if case.braking == "free":
        assert not any(demands)
        assert len(set(speeds)) == 1
        assert speeds[0] != 0.0
        return
    if case.braking == "6087":
        step = round(bench.read(0x6087) * PERIOD_S)
        assert demands == list(range(demands[0], -1, -step)), "evenly to zero"
        assert demands[0] == 300 - step
        moving = moments
    else:
        limit_rad_s2 = bench.read(0x6072) / 1000 * RATED_NM / bench.flywheel.inertia_kg_m2
        rate = (
            limit_rad_s2
            if case.braking == "limit"
            else bench.read(int(case.braking, 16)) / COUNTS_PER_RAD
        )
        # Its last steps take as much of the velocity as there is; 1/1000 of the torque is 1 %.
        steady = [speed for speed in speeds if abs(speed) > 6.0]
        assert len(steady) > 2
        falls = [abs(a) - abs(b) for a, b in pairwise(steady)]
        assert falls == pytest.approx([rate * PERIOD_S] * len(falls), rel=0.02)
        duration = abs(speeds[0]) / rate
        standing = next(i for i, speed in enumerate(speeds) if abs(speed) < STANDSTILL_RAD_S)
        assert duration <= (standing + 1) * PERIOD_S <= duration + 12 * PERIOD_S
        moving = moments[:standing]
    assert {moment.state for moment in moving} == {case.meanwhile}


@pytest.fixture
def bus_bench() -> Iterator[BusBench]:
    bench = BusBench()
    yield bench
    bench.close()


@pytest.mark.parametrize(
    "case", cases(), ids=lambda case: f"{case.before}: {case.options} {case.events}"
)
def test_case(bus_bench: BusBench, case: Case) -> None:
    bench = bus_bench
    bench.write(0x6060, 10)
    bench.nmt(START)
    for option in case.options.strip("-").split():
        set_option(bench, option)
    happen(bench, WAY[case.before])
    assert state_name(bench.read(0x6041)) == case.before
    if case.braking != "-" or float(case.speed):
        bench.sync()  # time begins with the first one
        bench.flywheel.speed_rad_s = float(case.speed)

    moments = happen(bench, case.events if case.events != "-" else "", case.braking)

    statusword = bench.read(0x6041)
    assert state_name(statusword) == case.after
    assert f"{statusword:04X}" == case.statusword
    if case.braking != "-":
        check_braking(bench, case, moments)


def test_cases_reach_every_state_and_take_every_transition() -> None:
    assert {case.after for case in cases()} == set(State402.SW_MASK)
    taken = {int(n) for case in cases() for n in re.findall(r"\d+", case.transition)}
    assert taken == set(range(17))


@pytest.mark.parametrize(
    ("index", "served"),
    [
        (0x605A, {0, 1, 2, 3, 5, 6, 7}),
        (0x605B, {0, 1}),
        (0x605C, {0, 1}),
        (0x605D, {1, 2, 3}),
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
    bench.tick()
    for controlword in (0x06, 0x07, 0x0F):
        bench.write(0x6040, 0, controlword, 2)
    bench.nmt(START)
    assert bench.read(0x6041) == 0x1237


def test_automatic_transitions_need_no_tick_where_there_is_sync(bench: Bench) -> None:
    bench.sync()
    assert bench.read(0x6041) == 0x0250
