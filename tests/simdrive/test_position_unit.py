"""Position in the units of the factor group: 0x608F, 0x6091, 0x6092 and 0x60A8 (CiA 402-2)."""

import math
from pathlib import Path

import pytest
from rig import eds_without

from canwall.simdrive.communication.dictionary import Dictionary
from canwall.simdrive.profile.position_unit import PositionUnit
from canwall.simdrive.state import DriveRecord

PAIR = """[{index:X}]
ParameterName=x
ObjectType=0x8
SubNumber=3
[{index:X}sub0]
ParameterName=n
DataType=0x0005
AccessType=ro
DefaultValue=2
[{index:X}sub1]
ParameterName=a
DataType=0x0007
AccessType=rw
DefaultValue={numerator}
[{index:X}sub2]
ParameterName=b
DataType=0x0007
AccessType=rw
DefaultValue={denominator}
"""


def dictionary(path: Path, si_unit: int, **pairs: tuple[int, int]) -> Dictionary:
    """Our drive's dictionary with other factors."""
    eds_without(path, "608F", "6091")
    text = path.read_text() + "\n"
    for name, (numerator, denominator) in pairs.items():
        index = int(name.removeprefix("x"), 16)
        text += PAIR.format(index=index, numerator=numerator, denominator=denominator)
    text += f"[60A8]\nParameterName=u\nDataType=0x0007\nAccessType=rw\nDefaultValue={si_unit}\n"
    path.write_text(text)
    return Dictionary.load(path, 5)


@pytest.mark.parametrize(
    ("si_unit", "factors", "per_increment"),
    [
        (0x00B50000, {"x608F": (4096, 1)}, 1.0),
        (0, {"x608F": (4096, 1)}, 1.0),
        (0xFF410000, {"x608F": (4096, 1)}, 3600 / 4096),
        (0xFD100000, {"x608F": (4096, 1)}, 2000.0 * math.pi / 4096),
        (0x00B40000, {"x608F": (4096, 1)}, 1 / 4096),
        (0xFF410000, {"x608F": (4096, 2), "x6091": (5, 1)}, 3600 / (2048 * 5)),
        (0, {"x608F": (4096, 1), "x6092": (360, 2)}, 180 / 4096),
        (0, {"x608F": (4096, 1), "x6091": (3, 1), "x6092": (360, 1)}, 360 / (3 * 4096)),
        (0, {"x608F": (1, 1), "x6092": (360, 1)}, 1.0),
        (0xFF410000, {"x608F": (1, 1)}, 1.0),
        (0, {"x608F": (0, 1), "x6092": (360, 1)}, 1.0),
    ],
)
def test_units_per_increment(
    tmp_path: Path, si_unit: int, factors: dict[str, tuple[int, int]], per_increment: float
) -> None:
    unit = PositionUnit(dictionary(tmp_path / "x.eds", si_unit, **factors), DriveRecord())
    unit.refresh()
    assert unit.per_increment == pytest.approx(per_increment)


def test_a_write_takes_effect_at_once(tmp_path: Path) -> None:
    entries = dictionary(tmp_path / "x.eds", 0xFF410000, x608F=(4096, 1))
    unit = PositionUnit(entries, DriveRecord())
    unit.refresh()
    entries[0x60A8, 0].write(0x00B50000)
    assert unit.per_increment == 1.0
