"""The CiA 402 state machine as tables, and against the simulated drive over a bus."""

import pytest
from rig import Rig, RigFactory

from canwall.drive import Controlword, DriveState, controlword_up, state_of

# Statusword (CiA 402-2, table of states; x: any), state, and the next controlword up.
TABLE = """
xxxx xxxx x0xx 0000 | NOT READY TO SWITCH ON | 0x00
xxxx xxxx x1xx 0000 | SWITCH ON DISABLED     | 0x06
xxxx xxxx x01x 0001 | READY TO SWITCH ON     | 0x07
xxxx xxxx x01x 0011 | SWITCHED ON            | 0x0F
xxxx xxxx x01x 0111 | OPERATION ENABLED      | 0x0F
xxxx xxxx x00x 0111 | QUICK STOP ACTIVE      | 0x00
xxxx xxxx x0xx 1111 | FAULT REACTION ACTIVE  | 0x00
xxxx xxxx x0xx 1000 | FAULT                  | 0x80
"""
ROWS = [[cell.strip() for cell in line.split("|")] for line in TABLE.strip().splitlines()]


def matches(statusword: int, pattern: str) -> bool:
    bits = f"{statusword:016b}"
    return all(p in ("x", b) for p, b in zip(pattern.replace(" ", ""), bits, strict=True))


def test_every_statusword_is_the_state_of_its_pattern() -> None:
    for statusword in range(1 << 10):  # the masks end at bit 6
        named = [name for pattern, name, _ in ROWS if matches(statusword, pattern)]
        # Patterns exclude one another; what none has is no state of CiA 402.
        assert str(state_of(statusword)) == (named[0] if named else "NOT READY TO SWITCH ON")
        assert len(named) <= 1


@pytest.mark.parametrize(("name", "up"), [row[1:] for row in ROWS])
def test_next_controlword(name: str, up: str) -> None:
    state = DriveState[name.replace(" ", "_")]
    assert controlword_up(state, previous=0x00) == int(up, 16)


def test_fault_reset_is_a_rising_edge() -> None:
    first = controlword_up(DriveState.FAULT, previous=0x0F)
    second = controlword_up(DriveState.FAULT, previous=first)
    third = controlword_up(DriveState.FAULT, previous=second)
    assert (first, second, third) == (0x80, 0x00, 0x80)


# From each state that a drive stays in: how a test gets it there (controlwords over SDO, or an
# NMT command), and what the master sends on the way up.
WAYS_UP = {
    "SWITCH ON DISABLED": ("", "06 07 0F"),
    "READY TO SWITCH ON": ("06", "07 0F"),
    "SWITCHED ON": ("06 07", "0F"),
    "OPERATION ENABLED": ("06 07 0F", ""),
    "QUICK STOP ACTIVE": ("06 07 0F 02", "00 06 07 0F"),
    "FAULT": ("06 07 0F PRE-OPERATIONAL", "80 06 07 0F"),
}


def state(rig: Rig) -> str:
    return str(state_of(rig.node.read(0x6041)))


def bring_into(rig: Rig, name: str) -> None:
    rig.node.write(0x605A, 0, 6)  # stay in QUICK STOP ACTIVE
    for event in WAYS_UP[name][0].split():
        if event.isalnum():
            rig.node.write(0x6040, 0, int(event, 16))
        else:
            rig.node.command(event)
            while "REACTION" in state(rig):
                pass
    assert state(rig) == name


@pytest.mark.parametrize("name", WAYS_UP)
def test_up_from_every_state(make_rig: RigFactory, name: str) -> None:
    rig = make_rig()
    rig.set_up()
    rig.node.write(0x6007, 0, 1)  # what aborts the connection is a fault
    bring_into(rig, name)
    sent: list[int] = []
    previous = 0x0F  # the master knows nothing of what others sent
    while state(rig) != "OPERATION ENABLED":
        previous = controlword_up(state_of(rig.node.read(0x6041)), previous)
        rig.node.write(0x6040, 0, previous)
        sent.append(previous)
        assert len(sent) < 10
    assert sent == [int(word, 16) for word in WAYS_UP[name][1].split()]


@pytest.mark.parametrize("name", [name for name in WAYS_UP if name != "FAULT"])
def test_down_from_every_state(make_rig: RigFactory, name: str) -> None:
    rig = make_rig()
    rig.set_up()
    bring_into(rig, name)
    rig.node.write(0x6040, 0, Controlword.DISABLE_VOLTAGE)
    assert state(rig) == "SWITCH ON DISABLED"
