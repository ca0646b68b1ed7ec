"""Store and restore parameters (0x1010, 0x1011), across resets and restarts."""

from pathlib import Path

import pytest
from canopen import SdoAbortedError
from simdrive_bench import EDS, RESET_COMMUNICATION, RESET_NODE, START, Bench, eds_with

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


@pytest.mark.parametrize(
    "text",
    ["", "{}", '{"node_id": null, "identity": [0, 1, 65536], "objects": {"1017:00": "00"}}',
     '{"node_id": null, "identity": [0, 1, 65536], "objects": {"2999:00": "00"}}',
     '{"node_id": null, "identity": [0, 1, 65536], "objects": {"6041:00": "0000"}}',
     '{"node_id": null, "identity": [1, 1, 65536], "objects": {}}'],
)  # fmt: skip
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


def test_path_is_relative_to_the_configuration(tmp_path: Path) -> None:
    text = config.shipped("config/sim.toml").read_text()
    path = tmp_path / "sim.toml"
    path.write_text(text.replace("\n[simulation]", '\n[simulation]\nstore = "stored.json"', 1))
    simulation = config.load(path).simulation
    assert simulation is not None
    assert simulation.store == tmp_path / "stored.json"
