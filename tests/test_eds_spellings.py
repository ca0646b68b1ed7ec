"""EDS and DCF as CiA 306 allows them and as vendors write them."""

from pathlib import Path

import pytest
from canopen.objectdictionary import ODVariable

from canwall.eds import load_eds

NODE_ID = 5


def described(directory: Path, text: str | bytes) -> dict[tuple[int, int], ODVariable]:
    """Return what is in a dictionary, by index and sub-index."""
    path = directory / "some.eds"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    variables: list[ODVariable] = []
    for item in load_eds(path, NODE_ID).values():
        variables += [item] if isinstance(item, ODVariable) else item.subindices.values()
    return {(variable.index, variable.subindex): variable for variable in variables}


def variable(index: str, *lines: str, data_type: int = 7) -> str:
    head = ("ParameterName=Some", f"DataType=0x{data_type:04X}", "AccessType=rw")
    return "\n".join((f"[{index}]", *head, *lines)) + "\n"


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("$NODEID+0x200", 0x205),
        ("$NODEID + 0x200", 0x205),
        ("0x200+$NODEID", 0x205),
        ("0x200 + $NodeID", 0x205),
        ("$nodeid+0x40000180", 0x40000185),
        ("NODEID+0x200", 0x205),
        ("$NODEID", 5),
        ("0X80", 0x80),
        ("017", 0o17),
        ("0", 0),
        ("00", 0),
        ("0x10 ; of the vendor", 0x10),
    ],
)
@pytest.mark.parametrize("key", ["DefaultValue", "defaultvalue", "DEFAULTVALUE"])
def test_number(tmp_path: Path, key: str, text: str, value: int) -> None:
    assert described(tmp_path, variable("2000", f"{key}={text}"))[0x2000, 0].default == value


def test_limits_and_parameter_value(tmp_path: Path) -> None:
    lines = ("LowLimit=$NODEID", "HighLimit=$NODEID+0x10", "ParameterValue=$NODEID+1")
    found = described(tmp_path, variable("2000", *lines))[0x2000, 0]
    assert (found.min, found.max, found.value) == (5, 0x15, 6)


def test_text_is_left_alone(tmp_path: Path) -> None:
    text = variable("2000", "DefaultValue=007+$NODEID", data_type=9)
    assert described(tmp_path, text)[0x2000, 0].default == "007+$NODEID"


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"\r"])
@pytest.mark.parametrize("start", [b"", b"\xef\xbb\xbf"])
def test_line_ends_and_byte_order_mark(tmp_path: Path, start: bytes, end: bytes) -> None:
    text = variable("2000", "DefaultValue=7").encode().replace(b"\n", end)
    assert described(tmp_path, start + text)[0x2000, 0].default == 7


def test_other_encoding(tmp_path: Path) -> None:
    text = variable("2000", "DefaultValue=7").replace("Some", "Gr\xf6\xdfe \x85 \x94")
    found = described(tmp_path, text.encode("latin-1"))[0x2000, 0]
    assert (found.name, found.default) == ("Gr\xf6\xdfe \x85 \x94", 7)


@pytest.mark.parametrize(
    "section",
    [
        "[Comments]\nLines=\n",
        "[Comments]\nLines=2\nLine1=One\n",
        "[DummyUsage]\nDummy0002=1\n",
        "[DUMMYUSAGE]\ndummy0002=1\n",
        "[DeviceInfo]\nVendorNumber=\nNrOfRXPDO=\n",
        "[DeviceComissioning]\nBaudrate=\n",
        "[2001]\nParameterName=Twice\nDataType=7\nAccessType=ro\nAccessType=rw\n",
    ],
)
def test_sections_that_the_parser_stumbles_over(tmp_path: Path, section: str) -> None:
    found = described(tmp_path, section + variable("2000", "DefaultValue=7", "PDOMapping="))
    assert found[0x2000, 0].default == 7
    assert ((2, 0) in found) == ("0002" in section)


def test_indented_lines(tmp_path: Path) -> None:
    text = variable("2000", "  DefaultValue=7", "\tPDOMapping=1")
    assert described(tmp_path, text)[0x2000, 0].pdo_mappable


def test_sub_indices_in_any_order_and_spelling(tmp_path: Path) -> None:
    text = variable("20absub1", "DefaultValue=1") + variable("20ABSUB0a", "DefaultValue=10")
    text += "[20Ab]\nParameterName=Record\nObjectType=0x9\nSubNumber=2\n"
    found = described(tmp_path, text)
    assert {key: found[key].default for key in found} == {(0x20AB, 1): 1, (0x20AB, 10): 10}


def test_compact_array(tmp_path: Path) -> None:
    lines = ("ObjectType=0x8", "CompactSubObj=3", "DefaultValue=4", "PDOMapping=1")
    text = variable("2000", *lines)
    text += "[2000Name]\nNrOfEntries=1\n2=Second\n[2000Value]\nNrOfEntries=1\n3=$NODEID+1\n"
    found = described(tmp_path, text)
    assert list(found) == [(0x2000, 0), (0x2000, 1), (0x2000, 2), (0x2000, 3)]
    assert found[0x2000, 0].default == 3
    assert [found[0x2000, n].default for n in (1, 2, 3)] == [4, 4, 4]
    assert [found[0x2000, n].value for n in (1, 2, 3)] == [None, None, 6]
    assert [found[0x2000, n].name for n in (1, 2, 3)] == ["Some 1", "Second", "Some 3"]
    assert all(found[0x2000, n].pdo_mappable for n in (1, 2, 3))


def test_array_that_is_not_compact(tmp_path: Path) -> None:
    text = "[2000]\nParameterName=A\nObjectType=8\nSubNumber=2\nCompactSubObj=0\n"
    text += variable("2000sub0", "DefaultValue=1") + variable("2000sub1", "DefaultValue=9")
    found = described(tmp_path, text)
    assert [found[key].default for key in found] == [1, 9]


def test_domain_needs_no_data_type(tmp_path: Path) -> None:
    found = described(tmp_path, "[2000]\nParameterName=Program\nObjectType=0x2\n")
    assert (found[0x2000, 0].data_type, found[0x2000, 0].access_type) == (0x0F, "rw")
