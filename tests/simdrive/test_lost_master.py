"""The cases of lost_master_cases.txt, on our dictionary and on every vendor's that offers them."""

import re
import struct
from pathlib import Path
from typing import NamedTuple

import pytest
from canopen.profiles.p402 import State402
from simdrive_bench import (
    ACTUAL_TORQUE,
    CONTROLWORD,
    EMCY,
    HEARTBEAT,
    NODE_ID,
    NOT_VALID,
    PRE_OPERATIONAL,
    RESET_NODE,
    RPDO,
    SDO_REQUEST,
    START,
    STATUSWORD,
    TARGET_TORQUE,
    TPDO,
)
from vendors import DICTIONARIES, SIMULATION, ConfiguredBench, path_of

from canwall.eds import load_eds

MASTER = 1
TICK_S = 0.001
TORQUE = 30
PATIENCE_S = 6.0
"""A slow-down gives up before."""

WATCHDOGS = {
    "rpdo": (0x1400, 5),
    "heartbeat": (0x1016, 1),
    "guarding": (0x100C, 0),
    "sync": (0x1006, 0),
}
"""The object without which a dictionary does not offer it."""

#: Those that each dictionary offers, and True if it has the error behaviour.
OFFERED = {
    "canwall-drive.eds": ("rpdo heartbeat guarding sync", True),
    "maxon_epos4_0x1018.eds": ("heartbeat", True),
    "elmo_gold.dcf": ("sync", True),  # 0x1016 has a HighLimit with no room for a node-ID
    "nanotec_C5-E-2-09.eds": ("heartbeat guarding sync", True),
    "technosoft_iPOS.D.v1.04.eds": ("guarding sync", False),
    "ingenia_eve-net-c_1.8.1.eds": ("rpdo guarding", False),
}


class Case(NamedTuple):
    watchdog: str
    option: str
    behaviour: str
    after_ms: str
    emcy: str
    at_once: str
    in_the_end: str
    torque: str
    nmt: str


def cases() -> list[Case]:
    text = Path(__file__).with_name("lost_master_cases.txt").read_text()
    lines = (line for line in text.splitlines() if line and not line.startswith("#"))
    rows = [Case(*re.split(r" {2,}", line)) for line in lines]
    return [row._replace(behaviour=value) for row in rows for value in row.behaviour.split(",")]


def state_name(statusword: int) -> str:
    """Return the state as canopen's master reads it."""
    (name,) = [name for name, (mask, bits) in State402.SW_MASK.items() if statusword & mask == bits]
    return str(name)


class LostMaster:
    """A drive with a watchdog, and a master that enables it and dies."""

    def __init__(self, bench: ConfiguredBench) -> None:
        self.bench = bench
        od = load_eds(bench.path, NODE_ID)
        self._variable = od.get_variable

    def has(self, index: int, subindex: int = 0) -> bool:
        return self._variable(index, subindex) is not None

    def offered(self) -> set[str]:
        """Return the watchdogs of the dictionary that can be set up as the cases want it."""
        found = {name for name, key in WATCHDOGS.items() if self.has(*key)}
        if "heartbeat" in found and (self._variable(0x1016, 1).max or MASTER << 16) < MASTER << 16:
            found.remove("heartbeat")
        return found

    def live(self, case: Case) -> None:
        """Enable the drive, with its torque on, and give the last sign of life."""
        bench = self.bench
        bench.nmt(RESET_NODE)
        bench.tick(TICK_S)
        for index, value, size in (
            (0x6007, int(case.option), 2),
            (0x605A, 2, 2),
            (0x605E, 2, 2),
            (0x1017, 0, 2),
        ):
            if self.has(index):
                bench.write(index, 0, value, size)
        if self.has(0x6073) and bench.read(0x6073) < 10 * TORQUE:
            bench.write(0x6073, 0, 1000, 2)
        if self.has(0x1029, 1):
            bench.write(0x1029, 1, int(case.behaviour), 1)
        bench.write(0x6060, 0, 10, 1)
        for index in (0x1401, 0x1402, 0x1403, 0x1801, 0x1802, 0x1803):
            if self.has(index, 1):
                bench.write(index, 1, bench.read(index, 1) | NOT_VALID, 4)
        self.configure(0x1400, RPDO[1], [CONTROLWORD, TARGET_TORQUE], 255)
        self.configure(0x1800, TPDO[1], [STATUSWORD, ACTUAL_TORQUE], 1)
        self.watch(case.watchdog)
        bench.nmt(START)
        bench.sync()
        for controlword in (0x06, 0x07, 0x0F):
            bench.give(RPDO[1], struct.pack("<Hh", controlword, TORQUE))
        bench.sync()
        bench.give(0x700 + MASTER, b"\x05")
        bench.request(HEARTBEAT)
        bench.sent.clear()

    def configure(self, index: int, cob_id: int, mapping: list[int], kind: int) -> None:
        bench = self.bench
        bench.write(index, 1, cob_id | NOT_VALID, 4)
        bench.write(index + 0x200, 0, 0, 1)
        for place, mapped in enumerate(mapping, start=1):
            bench.write(index + 0x200, place, mapped, 4)
        bench.write(index + 0x200, 0, len(mapping), 1)
        bench.write(index, 2, kind, 1)
        bench.write(index, 1, cob_id, 4)

    def watch(self, watchdog: str) -> None:
        bench = self.bench
        if watchdog == "rpdo":
            bench.write(0x1400, 5, 20, 2)
        elif watchdog == "heartbeat":
            bench.write(0x1016, 1, MASTER << 16 | 100, 4)
        elif watchdog == "guarding":
            bench.write(0x100C, 0, 50, 2)
            bench.write(0x100D, 0, 2, 1)
        else:
            bench.write(0x1006, 0, 10_000, 4)

    def die(self, case: Case) -> None:
        """Let time pass, and see that the drive does what the case says, when it says it."""
        bench = self.bench
        for _ in range(int(case.after_ms) - 1):
            bench.tick(TICK_S)
        assert bench.emergencies() == []
        assert self.state() == "OPERATION ENABLED"
        assert bench.read(0x6077, signed=True) == TORQUE
        bench.tick(TICK_S)
        ((_, told),) = [frame for frame in bench.sent if frame[0] == EMCY]
        assert f"{struct.unpack_from('<H', told)[0]:04X}" == case.emcy
        nmt = self.nmt_state()
        assert nmt == case.nmt
        if nmt != "STOPPED":
            assert self.state() == case.at_once
        for _ in range(round(PATIENCE_S / TICK_S)):
            bench.tick(TICK_S)
        assert len(bench.emergencies()) == 1
        assert self.nmt_state() == case.nmt
        if nmt == "STOPPED":
            bench.nmt(PRE_OPERATIONAL)  # where it may be asked
        assert self.state() == case.in_the_end
        assert bench.read(0x6077, signed=True) == (TORQUE if case.torque == "on" else 0)

    def state(self) -> str:
        return state_name(self.bench.read(0x6041))

    def nmt_state(self) -> str:
        """Return the NMT state by what there is: PDOs and SDOs, or SDOs, or neither."""
        if not self.bench.give(SDO_REQUEST, b"\x40\x00\x10\x00\x00\x00\x00\x00"):
            return "STOPPED"
        return "OPERATIONAL" if self.bench.request(TPDO[1]) else "PRE-OPERATIONAL"


def test_what_is_offered() -> None:
    assert set(OFFERED) == set(DICTIONARIES)
    assert {case.watchdog for case in cases()} == set(WATCHDOGS)
    assert len(cases()) == 4 * 4 * 3


@pytest.mark.slow
@pytest.mark.parametrize("file", DICTIONARIES)
def test_dead_master(file: str) -> None:
    # Time goes on without SYNCs.
    bench = ConfiguredBench(path_of(file), SIMULATION.model_copy(update={"real_time": True}))
    lost = LostMaster(bench)
    watchdogs, has_behaviour = OFFERED[file]
    assert lost.offered() == set(watchdogs.split())
    assert lost.has(0x1029, 1) == has_behaviour
    for case in cases():
        # Without 0x1029, CiA 301 has the node go to PRE-OPERATIONAL.
        possible = has_behaviour or case.behaviour == "0"
        if case.watchdog in watchdogs.split() and possible:
            lost.live(case)
            try:
                lost.die(case)
            except AssertionError as failure:
                raise AssertionError(f"{file}, {case}: {failure}") from failure
