"""Identity of the drive, compared with its dictionary."""

import pytest
from rig import Rig, RigFactory, settings_with

from canwall.drive import DriveError


@pytest.fixture
def rig(make_rig: RigFactory) -> Rig:
    return make_rig(settings_with({"drive.wait_s": 0.0}))


def test_no_drive(rig: Rig) -> None:
    rig.tampering.lies[(0x1000, 0)] = 0x000F0191
    with pytest.raises(DriveError, match="0x1000 = 0xf0191: device profile 401, not the 402"):
        rig.set_up()


def test_no_profile_is_a_note(rig: Rig) -> None:
    rig.tampering.lies[(0x1000, 0)] = 0
    assert "0x1000 names no device profile" in rig.set_up().notes[0]


@pytest.mark.parametrize(("part", "name"), [(1, "vendor-ID"), (2, "product code")])
def test_dictionary_of_another(rig: Rig, part: int, name: str) -> None:
    rig.node.dictionary[0x1018][part].default = 0x9A
    rig.tampering.lies[(0x1018, part)] = 0xFB
    assert f"{name} 0xfb, but 0x9a in drive.eds" in rig.set_up().notes[0]


def test_identity_is_kept(rig: Rig) -> None:
    identity = rig.set_up().identity
    assert identity is not None
    assert identity.numbers == {i: rig.node.read(0x1018, i) for i in (1, 2, 3, 4)}


def test_text_has_no_control_characters(rig: Rig) -> None:
    rig.tampering.invented[0x1008, 0] = int.from_bytes(b"a\n\x1bb", "little")
    assert rig.node.read_text(0x1008) == "a??b"
