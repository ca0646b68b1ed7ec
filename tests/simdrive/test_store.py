"""Store and restore parameters (0x1010, 0x1011), across resets and restarts."""

import struct
from pathlib import Path

import pytest
from canopen import SdoAbortedError
from simdrive_bench import (
    CONTROLWORD,
    EDS,
    NO_RTR,
    NOT_VALID,
    RESET_COMMUNICATION,
    RESET_NODE,
    START,
    Bench,
    eds_with,
)

from canwall import config
from canwall.eds import DictionaryError

SAVE = int.from_bytes(b"save", "little")
LOAD = int.from_bytes(b"load", "little")
ALL, COMMUNICATION, APPLICATION = 1, 2, 3


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "stored.json"


def changed(file: Path | None = None, eds: Path = EDS) -> Bench:
    bench = Bench(eds, file)
    bench.write(0x1017, 0, 50, 2)
    bench.write(0x6072, 0, 1500, 2)
    return bench


def values(bench: Bench) -> tuple[int, int]:
    return bench.read(0x1017), bench.read(0x6072)


@pytest.mark.parametrize(
    ("group", "expected"),
    [(ALL, (50, 1500)), (COMMUNICATION, (50, 3000)), (APPLICATION, (0, 1500))],
)
def test_stored_values_survive_a_restart(file: Path, group: int, expected: tuple[int, int]) -> None:
    bench = changed(file)
    bench.write(0x1010, group, SAVE, 4)
    bench.write(0x6072, 0, 7, 2)
    bench.nmt(RESET_NODE)
    assert values(bench) == expected
    assert values(Bench(store=file)) == expected


def test_without_a_file_they_survive_resets() -> None:
    bench = changed()
    bench.write(0x1010, ALL, SAVE, 4)
    bench.write(0x1017, 0, 7, 2)
    bench.write(0x6072, 0, 7, 2)
    bench.nmt(RESET_COMMUNICATION)
    assert values(bench) == (50, 7)
    bench.nmt(RESET_NODE)
    assert values(bench) == (50, 1500)


def test_restored_defaults_hold_from_the_next_reset_on(file: Path) -> None:
    bench = changed(file)
    bench.write(0x1010, ALL, SAVE, 4)
    bench.write(0x1011, COMMUNICATION, LOAD, 4)
    assert values(bench) == (50, 1500)
    bench.nmt(RESET_NODE)
    assert values(bench) == (0, 1500)
    bench.write(0x1011, ALL, LOAD, 4)
    assert values(Bench(store=file)) == (0, 3000)


@pytest.mark.parametrize("index", [0x1010, 0x1011])
def test_what_is_read(bench: Bench, index: int) -> None:
    bench.write(index, ALL, SAVE if index == 0x1010 else LOAD, 4)
    assert [bench.read(index, n) for n in range(4)] == [3, 1, 1, 1]


@pytest.mark.parametrize(("index", "signature"), [(0x1010, LOAD), (0x1011, SAVE), (0x1010, 1)])
def test_wrong_signature(file: Path, index: int, signature: int) -> None:
    bench = changed(file)
    with pytest.raises(SdoAbortedError, match="08000020"):
        bench.write(index, ALL, signature, 4)
    assert not file.exists()


def test_file_that_cannot_be_written(tmp_path: Path) -> None:
    bench = changed(tmp_path / "none" / "stored.json")
    with pytest.raises(SdoAbortedError, match="06060000"):
        bench.write(0x1010, ALL, SAVE, 4)
    bench.nmt(RESET_NODE)
    assert values(bench) == (0, 3000)


def test_nothing_moves_by_itself_after_power_on(file: Path) -> None:
    bench = Bench(store=file)
    bench.enable()
    bench.write(0x6071, 0, 900, 2)
    bench.write(0x1010, ALL, SAVE, 4)
    after = Bench(store=file)
    after.nmt(START)
    after.tick()
    after.sync()
    assert (after.read(0x6040), after.read(0x6071), after.read(0x6041)) == (0, 0, 0x0250)
    assert after.read(0x6060) == 10


def test_pdos_are_stored(file: Path) -> None:
    bench = Bench(store=file)
    bench.configure_cycle()
    bench.write(0x1010, COMMUNICATION, SAVE, 4)
    after = Bench(store=file)
    after.nmt(START)
    after.tick()
    after.command(0x06)
    assert after.cycle()[0] == 0x0231


def stored(**changes: str) -> str:
    """Return the text of a file, some of it changed."""
    content = {
        "identity": "[0, 1, 65536]",
        "node_id": "null",
        "stored_by_node": "5",
        "objects": "{}",
    } | changes
    return "{" + ", ".join(f'"{key}": {value}' for key, value in content.items()) + "}"


def test_file_without_changes_is_one(file: Path) -> None:
    file.write_text(stored())
    assert values(Bench(store=file)) == (0, 3000)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{}",
        stored(objects='{"1017:00": "00"}'),
        stored(objects='{"2999:00": "00"}'),
        stored(objects='{"6041:00": "0000"}'),
        stored(objects='{"1017": "0000"}'),
        stored(objects='{"1017:00": "xx"}'),
        stored(identity="[1, 1, 65536]"),
        stored(node_id="128"),
        stored(node_id='"5"'),
        stored(stored_by_node="255"),
    ],
)
def test_file_of_something_else(file: Path, text: str) -> None:
    file.write_text(text)
    with pytest.raises(DictionaryError, match=f"^{file}: .*; remove it"):
        Bench(store=file)


def test_manufacturer_parameters(tmp_path: Path, file: Path) -> None:
    more = eds_with(
        tmp_path,
        "[1010sub4]\nParameterName=Save others\nDataType=7\nAccessType=rw\n"
        "[2000]\nParameterName=Other\nDataType=7\nAccessType=rw\n",
    )
    bench = changed(file, more)
    bench.write(0x2000, 0, 9, 4)
    bench.write(0x1010, 4, SAVE, 4)
    assert bench.read(0x1010, 4) == 1
    after = Bench(more, file)
    assert (after.read(0x2000), *values(after)) == (9, 0, 3000)


@pytest.mark.parametrize("in_a_file", [True, False])
def test_stored_cob_ids_and_another_node_id(file: Path, in_a_file: bool) -> None:
    """The predefined identifiers are those of the node; the others those of whoever chose them."""
    bench = Bench(store=file if in_a_file else None)
    bench.configure_pdo(0x1402, 0x185, 1, [CONTROLWORD])  # what another node sends
    bench.write(0x1800, 1, NOT_VALID | NO_RTR | 0x185, 4)
    bench.write(0x1801, 1, NOT_VALID | 0x1E5, 4)
    bench.write(0x1014, 0, NOT_VALID | 0x85, 4)
    bench.write(0x6072, 0, 1500, 2)
    bench.write(0x1010, ALL, SAVE, 4)
    for request in (b"\x04\x01", b"\x11\x09", b"\x17"):
        bench.give(0x7E5, request.ljust(8, b"\0"))
    bench.nmt(RESET_NODE)
    assert bench.sent[-1] == (0x709, b"\0")
    if in_a_file:
        bench = Bench(store=file, node_id=9)

    def read(index: int, subindex: int) -> int:
        request = struct.pack("<BHB4x", 0x40, index, subindex)
        ((can_id, answer),) = bench.give(0x609, request)
        assert (can_id, answer[0]) == (0x589, 0x43)
        return int.from_bytes(answer[4:], "little")

    assert read(0x1800, 1) == NOT_VALID | NO_RTR | 0x189
    assert read(0x1801, 1) == NOT_VALID | 0x1E5
    assert read(0x1402, 1) == 0x185
    assert read(0x1403, 1) == NOT_VALID | 0x509
    assert read(0x1014, 0) == NOT_VALID | 0x89
    assert read(0x1200, 1) == 0x609
    back = Bench(store=file if in_a_file else None)
    if in_a_file:
        assert back.read(0x1800, 1) == NOT_VALID | NO_RTR | 0x185
        assert back.read(0x6072) == 1500


def test_path_is_relative_to_the_configuration(tmp_path: Path) -> None:
    text = config.shipped("config/sim.toml").read_text()
    path = tmp_path / "sim.toml"
    path.write_text(text.replace("\n[simulation]", '\n[simulation]\nstore = "stored.json"', 1))
    simulation = config.load(path).simulation
    assert simulation is not None
    assert simulation.store == tmp_path / "stored.json"
