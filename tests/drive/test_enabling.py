"""Enabling from every state, faults that return, and what is said when it does not come about."""

import pytest
import rig as rigs
from rig import Rig, RigFactory, settings_with

from canwall.cycle import Loop, WallGivenUpError
from canwall.drive import DriveError, DriveState, Enabling, disable, state_of, status_text

HALT = 1 << 8
FAULT, SWITCH_ON_DISABLED, ENABLED = 0x0218, 0x0250, 0x0237
STARTS = {
    "SWITCH ON DISABLED": [],
    "READY TO SWITCH ON": [0x06],
    "SWITCHED ON": [0x06, 0x07],
    "OPERATION ENABLED": [0x06, 0x07, 0x0F],
    "with HALT": [0x06, 0x07, 0x0F | HALT],
}


@pytest.fixture
def rig(make_rig: RigFactory) -> Rig:
    return make_rig(settings_with({"drive.wait_s": 0.0}))


def loop_of(rig: Rig) -> Loop:
    return Loop(rigs.Loop(rig).exchange)


@pytest.mark.parametrize("start", STARTS)
def test_from_every_state_that_a_predecessor_has_left(rig: Rig, start: str) -> None:
    rig.node.write(0x6060, 0, 4)
    for word in STARTS[start]:
        rig.node.write(0x6040, 0, word)
    rig.node.write(0x6071, 0, 300)
    loop = loop_of(rig)
    assert state_of(rig.node.read(0x6041)) is DriveState.SWITCH_ON_DISABLED
    loop.enable()
    assert state_of(rig.node.read(0x6041)) is DriveState.OPERATION_ENABLED
    assert rig.node.read(0x6040) == 0x0F
    assert rig.node.read(0x6077) == rig.node.read(0x6071) == 0
    assert loop.leave()
    assert state_of(rig.node.read(0x6041)) is DriveState.SWITCH_ON_DISABLED


def test_from_fault(rig: Rig) -> None:
    loop = loop_of(rig)
    loop.enable()
    rig.node.write(0x6007, 0, 1)
    rig.node.command("PRE-OPERATIONAL")
    while state_of(rig.node.read(0x6041)) is not DriveState.FAULT:
        pass
    disable(rig.node)  # the fault stays: its reset belongs to enabling
    assert state_of(rig.node.read(0x6041)) is DriveState.FAULT
    rig.node.command("OPERATIONAL")
    loop.enable()


def test_fault_that_returns_is_given_up() -> None:
    enabling = Enabling()
    words = []
    while not enabling.gave_up:
        words += [enabling.next(FAULT), enabling.next(SWITCH_ON_DISABLED)]
        assert len(words) < 20
    assert words == [0x80, 0x06] * 4


def test_fault_that_goes_is_not() -> None:
    enabling = Enabling()
    words = [enabling.next(word) for word in (FAULT, FAULT, FAULT, SWITCH_ON_DISABLED, ENABLED)]
    # A reset acts by its edge.
    assert words == [0x80, 0x00, 0x80, 0x06, 0x0F]
    assert not enabling.gave_up


def faulty(rig: Rig, statuswords: list[int]) -> None:
    """The drive's TPDOs show these statuswords in turn."""
    out = rig.tampering._out
    shown = [0]

    def lying(frames: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
        result = []
        for can_id, data in out(frames):
            if can_id == 0x185:
                word = statuswords[shown[0] % len(statuswords)]
                shown[0] += 1
                data = data[:4] + word.to_bytes(2, "little") + data[6:]
            result.append((can_id, data))
        return result

    rig.tampering._out = lying  # type: ignore[method-assign]


def test_fault_that_returns_on_the_bus(rig: Rig) -> None:
    loop = loop_of(rig)
    faulty(rig, [FAULT, SWITCH_ON_DISABLED])
    with pytest.raises(WallGivenUpError, match="the fault comes back after every reset"):
        loop.enable()


def test_state_that_stays_is_named_with_its_bits(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    loop = loop_of(rig)
    monkeypatch.setattr("canwall.cycle.loop._ENABLE_CYCLES", 20)
    faulty(rig, [0x0A31])
    with pytest.raises(
        WallGivenUpError, match=r"READY TO SWITCH ON.*0x0a31: voltage enabled, remote, int"
    ):
        loop.enable()


def test_drive_that_stays_enabled(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("canwall.drive.setup._DISABLING_S", 0.0)
    rig.tampering.lies[(0x6041, 0)] = 0x0237
    with pytest.raises(DriveError, match="node 5 stays in OPERATION ENABLED"):
        rig.set_up()


def test_target_torque_that_is_not_zeroed(rig: Rig) -> None:
    rig.tampering.lies[(0x6071, 0)] = 5
    with pytest.raises(DriveError, match="0x6071:00: wrote 0x0, the drive keeps 0x5"):
        rig.set_up()


@pytest.mark.parametrize(
    ("statusword", "text"),
    [
        (0x0000, "NOT READY TO SWITCH ON (statusword 0x0000)"),
        (0x02D0, "SWITCH ON DISABLED (statusword 0x02d0: voltage enabled, warning, remote)"),
        (
            0x1637,
            "OPERATION ENABLED (statusword 0x1637: voltage enabled, remote, target reached, "
            "bit 12)",
        ),
    ],
)
def test_status_in_words(statusword: int, text: str) -> None:
    assert status_text(statusword) == text
