"""Drives whose PDOs cannot be set up freely: used as they are, or what is missing is said."""

import pytest
from rig import Rig, RigFactory, settings_with

from canwall.drive import DriveError, Field

READ_ONLY = 0x06010002
INVALID = 1 << 31


@pytest.fixture
def rig(make_rig: RigFactory) -> Rig:
    return make_rig(settings_with({"drive.wait_s": 0.0}))


def map_pdo(rig: Rig, communication: int, *entries: int) -> None:
    node, mapping = rig.node, communication + 0x200
    cob_id = node.read(communication, 1)
    node.write(communication, 1, cob_id | INVALID)
    node.write(mapping, 0, 0)
    for place, entry in enumerate(entries, start=1):
        node.write(mapping, place, entry, size=4)
    node.write(mapping, 0, len(entries))
    node.write(communication, 1, cob_id & ~INVALID)


def fix(rig: Rig, first: int) -> None:
    """From now on no mapping of this direction can be written."""
    for index in range(first, first + 8):
        for subindex in range(9):
            rig.tampering.read_only[(index, subindex)] = READ_ONLY


def test_fixed_tpdo_that_carries_enough_is_used(rig: Rig) -> None:
    map_pdo(rig, 0x1801, 0x60410010, 0x60640020)
    fix(rig, 0x1A00)
    setup = rig.set_up()
    assert setup.tpdo.cob_id == 0x285
    assert setup.tpdo.field(0x6064) == Field(0x6064, 0, 16, 32)
    assert setup.tpdo.field(0x6077) is None
    assert rig.node.read(0x1801, 2) == 1
    assert any("0x1801 is used as the drive has it" in note for note in setup.notes)


def test_fixed_tpdo_that_lacks_the_position(rig: Rig) -> None:
    for communication in (0x1800, 0x1801, 0x1802, 0x1803):
        map_pdo(rig, communication, 0x60410010)
    fix(rig, 0x1A00)
    with pytest.raises(DriveError, match=r"no TPDO .* carries 0x6064 and 0x6041: .* lacks 0x6064"):
        rig.set_up()


def test_fixed_rpdo_repeats_what_else_it_carries(rig: Rig) -> None:
    map_pdo(rig, 0x1400, 0x60400010, 0x60600008, 0x60710010, 0x60720010)
    fix(rig, 0x1600)
    setup = rig.set_up()
    limit = rig.node.read(0x6072)
    assert setup.rpdo.field(0x6071) == Field(0x6071, 0, 24, 16)
    assert setup.rpdo.length == 7
    # Zero for the mode would end torque control, and zero for the limit the torque.
    assert setup.rpdo.constant == 10 << 16 | limit << 40


def test_constant_up_to_the_last_bit(rig: Rig) -> None:
    rig.tampering.lies[(0x60E1, 0)] = 0xFFFF
    map_pdo(rig, 0x1400, 0x60400010, 0x60710010, 0x60600008, 0x00050008, 0x60E10010)
    fix(rig, 0x1600)
    setup = rig.set_up()
    data = setup.rpdo.constant.to_bytes(8, "little", signed=True)
    assert data == b"\0\0\0\0\x0a\0\xff\xff"


def test_fixed_tpdo_that_cannot_follow_the_sync(rig: Rig) -> None:
    map_pdo(rig, 0x1800, 0x60640020, 0x60410010)
    fix(rig, 0x1A00)
    rig.tampering.read_only[(0x1800, 2)] = READ_ONLY
    with pytest.raises(DriveError, match="writing 0x1 to 0x1800:02 failed"):
        rig.set_up()


def test_optional_object_that_the_drive_does_not_map(rig: Rig) -> None:
    rig.tampering.read_only[(0x1A00, 3)] = 0x06040041
    setup = rig.set_up()
    assert [field.index for field in setup.tpdo.fields] == [0x6064, 0x6041]
    assert any("mapped less than there is room for" in note for note in setup.notes)


def test_inhibit_time_that_cannot_be_written(rig: Rig) -> None:
    rig.node.write(0x1800, 1, 0xC0000185)
    rig.node.write(0x1800, 3, 300)
    rig.tampering.read_only[(0x1800, 3)] = READ_ONLY
    setup = rig.set_up()
    (note,) = setup.notes
    assert "0x1800:03: the inhibit time stays at 30 ms" in note
    assert setup.tpdo.cob_id == 0x185


def test_inhibit_time_of_zero_need_not_be_writable(rig: Rig) -> None:
    rig.tampering.read_only[(0x1800, 3)] = READ_ONLY
    assert rig.set_up().notes == ()


def test_immediate_torque(make_rig: RigFactory) -> None:
    rig = make_rig(settings_with({"drive.torque_pdo": "immediate"}))
    setup = rig.set_up()
    assert rig.node.read(0x1400, 2) == 255
    assert setup.synchronous is False


@pytest.mark.parametrize(("wanted", "found", "other"), [("sync", 255, "immediate")])
def test_effect_that_the_drive_refuses_names_the_key(
    make_rig: RigFactory, wanted: str, found: int, other: str
) -> None:
    rig = make_rig(settings_with({"drive.torque_pdo": wanted}))
    rig.node.write(0x1400, 2, found)
    rig.tampering.read_only[(0x1400, 2)] = READ_ONLY
    with pytest.raises(DriveError, match=f'drive.torque_pdo = "{other}"'):
        rig.set_up()


def test_fixed_type_that_suits_is_left(rig: Rig) -> None:
    rig.node.write(0x1400, 2, 0)
    rig.tampering.read_only[(0x1400, 2)] = READ_ONLY
    assert rig.set_up().synchronous
    assert rig.node.read(0x1400, 2) == 0


@pytest.mark.parametrize(
    ("cob_id", "said"), [(0x20000185, "a 29-bit identifier"), (0x40000000, "has no identifier")]
)
def test_identifiers_that_will_not_do(rig: Rig, cob_id: int, said: str) -> None:
    map_pdo(rig, 0x1800, 0x60640020, 0x60410010)
    fix(rig, 0x1A00)
    rig.tampering.read_only[(0x1800, 1)] = READ_ONLY
    rig.tampering.lies[(0x1800, 1)] = cob_id
    with pytest.raises(DriveError, match=said):
        rig.set_up()
