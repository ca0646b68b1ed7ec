"""Drives that are not as their file says: what is optional is passed over, the rest is said."""

from pathlib import Path

import pytest
from rig import Rig, RigFactory, eds_with, lack, settings_with

from canwall.drive import DriveError
from canwall.eds import load_eds

VENDOR_EDS = Path(__file__).parents[3] / "shared" / "vendor-eds"
NO_OBJECT, NO_SUBINDEX = 0x06020000, 0x06090011


@pytest.fixture
def rig(make_rig: RigFactory) -> Rig:
    return make_rig(settings_with({"drive.wait_s": 0.0}))


def test_objects_that_the_drive_does_not_have(rig: Rig) -> None:
    rig.tampering.aborts |= {(0x60E0, 0): NO_OBJECT, (0x1400, 5): NO_SUBINDEX}
    setup = rig.set_up()
    assert setup.watchdog.kind == "consumer heartbeat"
    assert setup.watchdog.passed_over == ("RPDO event timer: no 0x1400:05",)
    assert setup.notes[0] == (
        "0x60E0:00, 0x1400:05 in drive.eds, but not in the drive: file and drive differ; "
        "passed over"
    )


@pytest.mark.slow
def test_every_object_that_is_asked_for_is_optional(make_rig: RigFactory) -> None:
    """Or the key that settles it is said."""
    first = make_rig()
    first.set_up()
    asked = list(first.node._asked)
    assert len(asked) > 20
    for key in asked:
        rig = make_rig()
        rig.tampering.aborts[key] = NO_SUBINDEX if key[1] else NO_OBJECT
        name = f"0x{key[0]:04X}:{key[1]:02X}"
        try:
            said = " ".join(rig.set_up().notes)
        except DriveError as error:
            said = str(error)
            assert "give drive." in said, name
        assert f"{name} in drive.eds, but not in the drive" in said


def test_object_that_is_needed(rig: Rig) -> None:
    rig.tampering.aborts[(0x6061, 0)] = NO_OBJECT
    with pytest.raises(DriveError, match=r"0x6061.*; drive\.eds has it: is it this drive's file"):
        rig.set_up()


def test_refusal_for_another_reason_is_not_absence(rig: Rig) -> None:
    rig.tampering.aborts[(0x6502, 0)] = 0x08000022
    with pytest.raises(DriveError, match=r"reading 0x6502:00 failed"):
        rig.set_up()


def test_values_of_a_dcf_for_objects_that_are_not_there(
    make_rig: RigFactory, tmp_path: Path
) -> None:
    dcf = eds_with(tmp_path / "drive.dcf", {("605A", "DefaultValue"): "2\nParameterValue=6"})
    rig = make_rig(settings_with({"drive.eds": str(dcf), "drive.download_dcf": True}))
    rig.tampering.aborts[(0x605A, 0)] = NO_OBJECT
    assert "0x605A:00 in drive.eds, but not in the drive" in rig.set_up().notes[0]


@pytest.mark.parametrize(
    "file", ["nanotec_C5-E-2-09.eds", "technosoft_iPOS.D.v1.04.eds", "elmo_gold.dcf"]
)
def test_file_of_another_drive(make_rig: RigFactory, file: str) -> None:
    """Whatever fails, or does not: that it is another drive's file is said."""
    if not (VENDOR_EDS / file).is_file():
        pytest.skip(f"{VENDOR_EDS} has no {file}")
    rig = make_rig()
    rig.tampering.lies[(0x1018, 1)] = 0x2FE
    rig.node.dictionary = load_eds(VENDOR_EDS / file, 5)
    try:
        said = " ".join(rig.set_up().notes)
    except DriveError as error:
        said = str(error)
    assert "vendor-ID 0x2fe, but " in said
    assert "in drive.eds: is it this drive's file?" in said


def test_what_the_configuration_lacks_is_said_together(rig: Rig) -> None:
    lack(rig, 0x6076, 0x608F, 0x1400, 0x1016, 0x100C)
    with pytest.raises(DriveError) as refused:
        rig.set_up()
    text = str(refused.value)
    for key in ("drive.rated_torque_nm", "drive.counts_per_rev", "--accept-no-watchdog"):
        assert key in text
    assert "\n" not in text


# PDOs


def parameters(rig: Rig) -> list[int]:
    """COB-ID, type and mapping of the first PDOs."""
    return [
        rig.node.read(index + offset, subindex)
        for index in (0x1400, 0x1800)
        for offset, subindices in ((0, (1, 2)), (0x200, range(9)))
        for subindex in subindices
    ]


def test_empty_pdos_that_begin_valid_are_put_back(make_rig: RigFactory, tmp_path: Path) -> None:
    """As Elmo's Whistle has them."""
    empty = {(f"{index}sub0", "DefaultValue"): "0" for index in ("1600", "1A00")}
    eds = eds_with(tmp_path / "empty.eds", empty)
    rig = make_rig(settings_with({"drive.eds": str(eds)}))
    before = parameters(rig)
    assert not before[0] >> 31
    rig.set_up()
    assert parameters(rig) != before
    assert rig.node.restore() == []
    assert parameters(rig) == before


def test_mapping_beside_fixed_identifiers(make_rig: RigFactory, tmp_path: Path) -> None:
    """As Elmo's SimplIQ has it: no PDO can be switched off, but each can be mapped."""
    fixed = {(f"{index}sub1", "AccessType"): "ro" for index in ("1400", "1800")}
    eds = eds_with(tmp_path / "fixed.eds", fixed)
    rig = make_rig(settings_with({"drive.eds": str(eds)}))
    before = parameters(rig)
    setup = rig.set_up()
    assert [field.index for field in setup.tpdo.fields] == [0x6064, 0x6041, 0x6077]
    assert [field.index for field in setup.rpdo.fields] == [0x6040, 0x6071]
    assert setup.watchdog.kind == "RPDO event timer"
    assert setup.notes == ()
    assert rig.node.restore() == []
    assert parameters(rig) == before
