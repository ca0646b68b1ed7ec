"""The EDS of the drive, and what happens with files that are none."""

from configparser import RawConfigParser
from pathlib import Path

import canopen
import pytest
from simdrive_bench import EDS, NODE_ID, PERIOD_S, Bench, RecordingMotion

from canwall.config import Drive, Simulation
from canwall.eds import DictionaryError
from canwall.simdrive import Dictionary, ServoDrive, make_drive


def sections() -> RawConfigParser:
    parser = RawConfigParser()
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    parser.read(EDS)
    return parser


def test_lists_name_exactly_the_objects_described() -> None:
    eds = sections()
    listed: list[int] = []
    for name in ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects"):
        count = int(eds[name]["SupportedObjects"])
        assert set(eds[name]) == {"SupportedObjects", *(str(n) for n in range(1, count + 1))}
        listed += [int(eds[name][str(n)], 16) for n in range(1, count + 1)]
    described = [int(name, 16) for name in eds.sections() if len(name) == 4]
    assert sorted(listed) == sorted(described)
    assert len(set(listed)) == len(listed)


def test_sub_numbers_are_right() -> None:
    eds = sections()
    for name in (name for name in eds.sections() if len(name) == 4):
        subs = [sub for sub in eds.sections() if sub.startswith(f"{name}sub")]
        assert int(eds[name].get("SubNumber", "0")) == len(subs)


def test_all_that_the_eds_lists_is_on_the_bus(bench: Bench) -> None:
    od = canopen.import_od(str(EDS), NODE_ID)
    expected_misses = {(0x1003, subindex) for subindex in range(1, 9)}  # no error yet
    no_numbers = {0x1008, 0x1009, 0x100A, 0x2100}
    for item in od.values():
        variables = item.values() if hasattr(item, "subindices") else [item]
        for variable in variables:
            key = (variable.index, variable.subindex)
            if variable.index < 0x1000 or variable.index in no_numbers or key in expected_misses:
                continue
            if variable.access_type == "wo":
                continue
            bench.read(*key)


def test_node_id_goes_into_the_cob_ids(bench: Bench) -> None:
    assert bench.read(0x1014) == 0x85
    assert bench.read(0x1200, 1) == 0x605
    assert bench.read(0x1801, 1) == 0x40000285


def test_parameter_value_of_a_dcf_is_the_power_on_value(tmp_path: Path) -> None:
    dcf = tmp_path / "drive.dcf"
    text = EDS.read_text()
    dcf.write_text(text.replace("DefaultValue=3000\n", "DefaultValue=3000\nParameterValue=1500\n"))
    assert Bench(dcf).read(0x6072) == 1500


def edited(directory: Path, old: str, new: str) -> Path:
    text = EDS.read_text()
    assert old in text
    path = directory / "edited.eds"
    path.write_text(text.replace(old, new, 1))
    return path


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("[6064]", "[5064]", "object 0x6064:00 position actual value: missing"),
        ("[6040]", "[5040]", "object 0x6040:00 controlword: missing"),
        ("[6041]", "[5041]", "object 0x6041:00 statusword: missing"),
        (
            "[6071]\nParameterName=Target torque\nObjectType=0x7\nDataType=0x0003",
            "[6071]\nParameterName=Target torque\nObjectType=0x7\nDataType=0x0004",
            "object 0x6071:00 target torque: data type is not 0x0003",
        ),
        ("[1400sub1]", "[1400sub9]", "object 0x1400:01 missing"),
        ("DefaultValue=0x60410010", "DefaultValue=0x60410009", "object 0x1A00:00 maps"),
        (
            "[1017]\nParameterName=Producer heartbeat time\nObjectType=0x7\nDataType=0x0006",
            "[1017]\nParameterName=Producer heartbeat time\nObjectType=0x7\nDataType=0x0009",
            "object 0x1017:00 not an integer",
        ),
        ("ParameterName=Device type\n", "", "not a readable EDS or DCF: No option"),
        ("[1018]", "[1018", "not a readable EDS or DCF"),
        ("[FileInfo]", "", "not a readable EDS or DCF: File contains no section headers"),
    ],
)
def test_bad_file(tmp_path: Path, old: str, new: str, reason: str) -> None:
    path = edited(tmp_path, old, new)
    with pytest.raises(DictionaryError) as refused:
        ServoDrive(Dictionary.load(path, NODE_ID), NODE_ID, RecordingMotion(), PERIOD_S)
    message = str(refused.value)
    assert message.startswith(f"{path}: {reason}")
    assert "\n" not in message


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("0x6076", "simulation.rated_torque_nm"),
        ("0x608F:01", "simulation.counts_per_rev"),
        ("0x6091:01", "drive.gear_ratio"),
    ],
)
def test_scale_of_zero_names_the_key(name: str, key: str) -> None:
    settings = Drive(node_id=NODE_ID, eds=EDS)
    with pytest.raises(DictionaryError, match=f"{name}.* cannot be 0.*{key}"):
        make_drive(settings, Simulation(objects={name: 0}), PERIOD_S)


def test_missing_file(tmp_path: Path) -> None:
    path = tmp_path / "none.eds"
    with pytest.raises(DictionaryError, match="no such EDS"):
        Dictionary.load(path, NODE_ID)


def test_other_format(tmp_path: Path) -> None:
    path = tmp_path / "drive.xml"
    path.write_text("<eds/>")
    with pytest.raises(
        DictionaryError, match="not a readable EDS or DCF: File contains no section headers"
    ):
        Dictionary.load(path, NODE_ID)


def test_file_in_another_encoding(tmp_path: Path) -> None:
    path = tmp_path / "latin.eds"
    path.write_bytes(EDS.read_bytes().replace(b"in mN m.", b"in mN\xb7m."))
    assert Bench(path).read(0x1000) == 0x00020192


def test_negative_default_as_vendors_write_it(tmp_path: Path) -> None:
    old = "[6071]\nParameterName=Target torque\nObjectType=0x7\nDataType=0x0003\nAccessType=rww\n"
    path = edited(tmp_path, old + "DefaultValue=0", old + "DefaultValue=0xFFFE")
    assert Bench(path).read(0x6071, signed=True) == -2


@pytest.mark.parametrize("node_id", [0, 128])
def test_node_id_out_of_range(node_id: int) -> None:
    with pytest.raises(ValueError, match="not in 1 to 127"):
        Dictionary.load(EDS, node_id)


def test_drive_refuses_the_dictionary_of_another_node() -> None:
    with pytest.raises(ValueError, match="node-ID 6, but 5"):
        ServoDrive(Dictionary.load(EDS, 5), 6, RecordingMotion(), PERIOD_S)


@pytest.mark.parametrize("period_s", [0.0, -0.001, float("nan")])
def test_drive_refuses_a_period_that_is_none(period_s: float) -> None:
    with pytest.raises(ValueError, match="not positive"):
        ServoDrive(Dictionary.load(EDS, 5), 5, RecordingMotion(), period_s)
