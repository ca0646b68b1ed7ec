"""Values of a DCF, written to the drive only when asked."""

from pathlib import Path

import pytest
from rig import SIM_CONFIG, Rig, RigFactory, settings_with

from canwall.config import ConfigError

EDS = SIM_CONFIG.parent.parent / "eds" / "canwall-drive.eds"


@pytest.fixture
def dcf(tmp_path: Path) -> Path:
    """Our drive's EDS with values for 0x6072, a PDO, the target torque and what is read only."""
    lines = []
    for line in EDS.read_text().splitlines():
        lines.append(line)
        for section, value in (("[6072]", 1234), ("[1800sub3]", 77), ("[6071]", 99), ("[6077]", 3)):
            if line == section:
                lines.append(f"ParameterValue={value}")
    path = tmp_path / "drive.dcf"
    path.write_text("\n".join(lines))
    return path


def rig_with(make_rig: RigFactory, dcf: Path, download: bool) -> Rig:
    rig = make_rig(settings_with({"drive.eds": str(dcf), "drive.download_dcf": download}))
    rig.node.write(0x6072, 0, 2500)
    return rig


def test_not_unless_asked(make_rig: RigFactory, dcf: Path) -> None:
    rig = rig_with(make_rig, dcf, download=False)
    rig.set_up()
    assert rig.node.read(0x6072) == 2500


def test_download_and_back(make_rig: RigFactory, dcf: Path) -> None:
    rig = rig_with(make_rig, dcf, download=True)
    setup = rig.set_up()
    assert rig.node.read(0x6072) == 1234
    # Torque limits that the file has set count, and its PDOs and targets do not.
    assert setup.torque_limit_nm == pytest.approx(1.234 * 0.637)
    assert rig.node.read(0x1800, 3) == 0
    assert rig.node.read(0x6071) == 0
    written = {
        data[1:4]
        for can_id, data in rig.frames
        if can_id == 0x605 and data[0] >> 5 == 1 and data[4] == 99
    }
    assert b"\x71\x60\x00" not in written
    assert rig.node.restore() == []
    assert rig.node.read(0x6072) == 2500


@pytest.mark.parametrize("name", ["6072", "0x6072:", "0x60720010", "max_torque"])
def test_parameter_that_names_no_object(name: str) -> None:
    with pytest.raises(ConfigError, match=r"drive.parameters: .* is not an object"):
        settings_with({"drive.parameters": {name: 1}})


def test_parameter_that_has_no_room(make_rig: RigFactory) -> None:
    rig = make_rig(settings_with({"drive.parameters": {"0x6072": 70000}}))
    with pytest.raises(Exception, match=r"drive\.parameters: 0x6072:00: 0x11170 does not fit"):
        rig.set_up()


def test_parameter_that_cannot_be_negative(make_rig: RigFactory) -> None:
    """As a number without a sign -7 is a limit of 65 times the rated torque."""
    rig = make_rig(settings_with({"drive.parameters": {"0x6072": -7}}))
    before = rig.node.read(0x6072)
    with pytest.raises(Exception, match=r"drive\.parameters: 0x6072:00: cannot be negative, as -7"):
        rig.set_up()
    assert rig.node.read(0x6072) == before
