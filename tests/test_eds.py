"""Object dictionaries from files: the project's own, vendors', and what is none."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canwall.config import shipped
from canwall.eds import DictionaryError, load_eds
from canwall.errors import InputError

BOUNDED = settings(derandomize=True, deadline=None, max_examples=60)

OWN = shipped("eds/canwall-drive.eds")
VENDORS = Path(__file__).resolve().parents[2] / "shared" / "vendor-eds"

#: Objects needed to render a wall on a CiA 402 drive in cyclic synchronous torque mode.
WALL_OBJECTS = (0x6040, 0x6041, 0x6060, 0x6061, 0x6064, 0x6071, 0x6077)

#: Files of real devices, and what they lack.
VENDORS_FILES = {
    "elmo_gold.dcf": "",
    "faulhaber_605.3150.71-A.eds": "0x6071, 0x6077",  # a drive without a torque mode
    "ingenia_eve-net-c_1.8.1.eds": "",
    "maxon_epos4_0x1018.eds": "",
    "nanotec_C5-E-2-09.eds": "",
    "technosoft_iPOS.D.v1.04.eds": "",
    "canopennode_demoDevice.eds": ", ".join(f"0x{index:04X}" for index in WALL_OBJECTS),
}


def refused(path: Path, *required: int) -> str:
    with pytest.raises(DictionaryError) as caught:
        load_eds(path, 5, required)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    assert isinstance(caught.value, InputError)
    return message.removeprefix(f"{path}: ")


def without(text: str, index: int) -> str:
    """An EDS with one object's sections and its line in the lists of objects taken out."""
    kept, keep = [], True
    for line in text.splitlines():
        if line.startswith("["):
            keep = not line.upper().startswith(f"[{index:04X}")
        if keep and not line.upper().replace(" ", "").endswith(f"=0X{index:04X}"):
            kept.append(line)
    return "\n".join(kept)


def test_own_dictionary() -> None:
    dictionary = load_eds(OWN, 5, WALL_OBJECTS)
    assert dictionary[0x6071].name.lower() == "target torque"
    assert dictionary[0x6064].data_type == 0x0004  # INTEGER32
    # $NODEID is reckoned in.
    assert dictionary[0x1400][1].default & 0x7F == 5


def test_a_missing_file(tmp_path: Path) -> None:
    told = "no such EDS or DCF; correct drive.eds, or give --eds to a command that has it"
    assert refused(tmp_path / "no.eds") == refused(tmp_path) == told


@pytest.mark.parametrize(
    "content",
    [
        b"\x7fELF\x02\x01\x01\x00\x00\x00\x00",
        b"position,torque\n1,2\n",
        b"[FileInfo]\nFileName=x.eds\n[FileInfo]\nFileName=y.eds\n",
        b"[1000]\nParameterName=a\nObjectType=nonsense\n",
        b"[6064]\nno equals sign here",
    ],
)
def test_what_is_no_dictionary(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "drive.eds"
    path.write_bytes(content)
    message = refused(path, *WALL_OBJECTS)
    assert message.startswith(("not a readable EDS or DCF: ", "lacks object 0x6040"))


@pytest.mark.parametrize("name", ["drive.txt", "drive"])
def test_a_file_of_another_kind(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(OWN.read_bytes())
    assert refused(path).startswith("not a readable EDS or DCF: ")


@pytest.mark.slow
@BOUNDED
@given(st.binary(max_size=200) | st.text(max_size=200).map(lambda text: text.encode()))
def test_any_bytes(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.eds"
    path.write_bytes(content)
    refused(path, 0x6064)


@pytest.mark.parametrize("index", [0x6064, 0x6071])
def test_a_drive_without_what_a_wall_needs(tmp_path: Path, index: int) -> None:
    path = tmp_path / "drive.eds"
    path.write_text(without(OWN.read_text(encoding="utf-8"), index), encoding="utf-8")
    expected = f"lacks object 0x{index:04X}; this drive cannot render a wall"
    assert refused(path, *WALL_OBJECTS) == expected
    assert index not in load_eds(path, 5)


def test_all_that_lacks_is_named(tmp_path: Path) -> None:
    path = tmp_path / "drive.eds"
    text = without(without(OWN.read_text(encoding="utf-8"), 0x6064), 0x6041)
    path.write_text(text, encoding="utf-8")
    message = refused(path, *WALL_OBJECTS)
    assert message.startswith("lacks object 0x6041, 0x6064; ")


@pytest.mark.parametrize(("name", "lacking"), VENDORS_FILES.items())
def test_vendors_files(name: str, lacking: str) -> None:
    path = VENDORS / name
    if not path.is_file():
        pytest.skip("the vendors' dictionaries are not beside this checkout")
    if lacking:
        expected = f"lacks object {lacking}; this drive cannot render a wall"
        assert refused(path, *WALL_OBJECTS) == expected
    else:
        dictionary = load_eds(path, 7, WALL_OBJECTS)
        assert dictionary[0x6064].data_type == 0x0004  # INTEGER32
        assert dictionary[0x6071].data_type == 0x0003  # INTEGER16


def test_a_file_in_another_encoding(tmp_path: Path) -> None:
    path = tmp_path / "drive.eds"
    text = OWN.read_text(encoding="utf-8")
    text = text.replace("CreatedBy=", "CreatedBy=Jürgen Groß, ")
    path.write_bytes(text.encode("latin-1", errors="replace"))
    assert b"J\xfcrgen" in path.read_bytes()
    assert 0x6064 in load_eds(path, 5, WALL_OBJECTS)
