"""Torque mode that the master chooses, and the reason it gives."""

import pytest
from rig import Rig, RigFactory, settings_with

from canwall.drive import DriveError

CST, PT = 10, 4
VALUE_RANGE = 0x06090030


def rig_with(make_rig: RigFactory, mode: str = "auto", supported: int | None = None) -> Rig:
    rig = make_rig(settings_with({"drive.mode": mode, "drive.wait_s": 0.0}))
    if supported is not None:
        rig.tampering.lies[(0x6502, 0)] = supported
    return rig


@pytest.mark.parametrize(
    ("wanted", "supported", "mode", "why"),
    [
        ("auto", 0x208, CST, "0x6502 = 0x208 lists it"),
        ("auto", 0x200, CST, "0x6502 = 0x200 lists it"),
        ("auto", 0x008, PT, "0x6502 = 0x8 lists it, and not cyclic synchronous torque"),
        (
            "auto",
            0x1F0065,
            CST,
            "0x6502 = 0x1f0065 lists no torque mode, yet the drive accepted it",
        ),
        ("cst", 0x008, CST, 'drive.mode = "cst"; 0x6502 = 0x8 does not list it, yet the drive'),
        ("pt", 0x208, PT, 'drive.mode = "pt"; 0x6502 = 0x208 lists it'),
    ],
)
def test_mode_and_why(
    make_rig: RigFactory, wanted: str, supported: int | None, mode: int, why: str
) -> None:
    rig = rig_with(make_rig, wanted, supported)
    setup = rig.set_up()
    assert setup.mode is not None
    assert why in str(setup.mode)
    assert setup.mode.number == rig.node.read(0x6060) == rig.node.read(0x6061) == mode


def test_without_0x6502_the_mode_is_tried(make_rig: RigFactory) -> None:
    rig = rig_with(make_rig)
    del rig.node.dictionary[0x6502]
    setup = rig.set_up()
    assert "there is no 0x6502; the drive accepted the mode when it was tried" in str(setup.mode)


def test_mode_that_is_listed_but_does_not_come_leaves_profile_torque(make_rig: RigFactory) -> None:
    rig = rig_with(make_rig)
    process = rig.tampering.drive.process

    def refusing(can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        if can_id == 0x605 and data[:5] == b"\x2f\x60\x60\x00\x0a":
            return [(0x585, b"\x80\x60\x60\x00" + VALUE_RANGE.to_bytes(4, "little"))]
        return process(can_id, data)

    rig.tampering.drive.process = refusing  # type: ignore[method-assign]
    setup = rig.set_up()
    assert setup.mode is not None
    assert setup.mode.number == PT
    assert "writing 0xa to 0x6060:00 failed" in str(setup.mode)


def test_no_torque_mode_at_all(make_rig: RigFactory) -> None:
    rig = rig_with(make_rig)
    rig.tampering.aborts[(0x6060, 0)] = VALUE_RANGE
    with pytest.raises(DriveError, match="no torque mode, so this drive cannot render a wall"):
        rig.set_up()


def test_profile_torque_needs_a_slope(make_rig: RigFactory) -> None:
    rig = rig_with(make_rig, "pt", supported=0x65)
    del rig.node.dictionary[0x6087]
    with pytest.raises(DriveError, match=r'needs 0x6087.*drive\.mode = "pt".*try "auto"'):
        rig.set_up()


def test_slope_is_the_greatest_and_put_back(make_rig: RigFactory) -> None:
    rig = rig_with(make_rig, "pt")
    before = rig.node.read(0x6087)
    rig.set_up()
    assert rig.node.read(0x6087) == 0xFFFF_FFFF
    assert rig.node.restore() == []
    assert rig.node.read(0x6087) == before


def test_slope_as_great_as_the_dictionary_allows(make_rig: RigFactory) -> None:
    rig = rig_with(make_rig, "pt")
    rig.node.dictionary[0x6087].max = 10_000_000
    rig.set_up()
    assert rig.node.read(0x6087) == 10_000_000


def test_slope_that_is_refused_is_tried_lower(make_rig: RigFactory) -> None:
    rig = rig_with(make_rig, "pt")
    process = rig.tampering.drive.process

    def refusing(can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        slope = int.from_bytes(data[4:8], "little")
        if can_id == 0x605 and data[:4] == b"\x23\x87\x60\x00" and slope > 50_000_000:
            return [(0x585, b"\x80\x87\x60\x00" + VALUE_RANGE.to_bytes(4, "little"))]
        return process(can_id, data)

    rig.tampering.drive.process = refusing  # type: ignore[method-assign]
    rig.set_up()
    assert rig.node.read(0x6087) == 10_000_000


def test_halt_of_a_predecessor_is_cleared_before_the_mode_changes(make_rig: RigFactory) -> None:
    rig = rig_with(make_rig)
    rig.node.write(0x6040, 0, 0x0106)
    rig.set_up()
    writes = [(bytes(d[1:4]), d[4:6]) for i, d in rig.frames if i == 0x605 and d[0] >> 5 == 1]
    controlword = writes.index((b"\x40\x60\x00", b"\x00\x00"))
    mode = next(k for k, (key, _) in enumerate(writes) if key == b"\x60\x60\x00")
    assert controlword < mode
    assert rig.node.read(0x6040) == 0
