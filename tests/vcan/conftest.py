"""A bench on vcan0 for each test, and the runs that several of them look at."""

import functools
import os
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import main_job
import pytest
from commands import Record
from rig import SIM_CONFIG
from socketcan import (
    PATIENCE_S,
    Bench,
    Canwall,
    has_socketcan,
    is_up,
    light,
    long_ears,
    wait_for,
)

from canwall import config
from canwall.run import run
from canwall.simdrive import load_compiled_code

EXCHANGES = ("native", "python-can")

_WHY_NOT = (
    "the kernel has no SocketCAN (PF_CAN); scripts/vcan-guest python -m pytest tests/vcan"
    if not has_socketcan()
    else "no vcan0; as root: ip link add vcan0 type vcan; ip link set vcan0 up"
    if not is_up("vcan0")
    else ""
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    here = Path(__file__).parent
    for item in items:
        if here in item.path.parents:
            item.add_marker(pytest.mark.timeout(2 * PATIENCE_S))
            if _WHY_NOT:
                item.add_marker(pytest.mark.skip(reason=_WHY_NOT))


@pytest.fixture(scope="session", autouse=True)
def loaded(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Have what is needed loaded here, so that every process forked from this one has it.

    It takes an emulated processor seconds, which the first TPDO would come too late by.
    """
    if not _WHY_NOT:
        # Of a drive in a process of its own as well, which is ready once it has all of it.
        for real_time in (False, True):
            load_compiled_code(real_time)
        with light():
            settings = config.load(SIM_CONFIG, {"run.duration_s": 0.3})
            run(settings, tmp_path_factory.mktemp("loaded") / "run")


@pytest.fixture(scope="session", params=EXCHANGES)
def exchange(request: pytest.FixtureRequest) -> str:
    """`[bus] exchange`: each of them in turn."""
    return str(request.param)


@pytest.fixture
def bench(tmp_path: Path, exchange: str) -> Iterator[Bench]:
    bench = Bench(tmp_path, exchange)
    yield bench
    bench.close()


@dataclass(frozen=True)
class Strikes:
    """The main job on vcan0, and what was beside it."""

    record: Record
    out: str
    candump: Path
    second_master: Canwall
    folder_of_the_second: Path


@pytest.fixture(scope="session")
def strikes_by(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Strikes]:
    """The strikes by an exchange, run once."""
    return functools.cache(lambda exchange: _strike(tmp_path_factory.mktemp("strikes"), exchange))


@pytest.fixture(scope="session")
def strikes(strikes_by: Callable[[str], Strikes], exchange: str) -> Strikes:
    return strikes_by(exchange)


def _strike(folder: Path, exchange: str) -> Strikes:
    """Two strikes; candump, a load from cangen, cansend, other nodes, a second master beside."""
    with closing(Bench(folder, exchange)) as bench:
        configuration = bench.config(main_job.CHANGES)
        drive = bench.drive(configuration)
        candump = folder / "candump.log"
        # Simulated time goes faster than an emulated guest's candump gets to run.
        dump = bench.start("candump", "-L", "-r", "4194304", "vcan0", output=candump)
        # As anything else on a bus: identifiers that are nobody's here, data at random.
        bench.start("cangen", "vcan0", "-g", "10", "-I", "7A0", "-L", "8", "-D", "r")
        bench.other_nodes()
        run = bench.canwall("run", configuration, "--output", folder / "run")
        with long_ears():
            second = bench.canwall("run", bench.config(), "--output", folder / "second")
        wait_for(lambda: b" 080#" in candump.read_bytes() or not run.running)
        bench.start("cansend", "vcan0", "605#4018100100000000").wait()
        assert second.wait() == 1, second.errors
        assert run.wait() == 0, run.errors
        assert run.errors == []
        dump.terminate()
        dump.wait()
        assert drive.interrupt() == 0
    return Strikes(Record(folder / "run"), run.out, candump, second, folder / "second")


@pytest.fixture(scope="session")
def embedded(tmp_path_factory: pytest.TempPathFactory) -> Record:
    """The main job with the drive on the bus inside the program."""
    given = os.environ.get("CANWALL_EMBEDDED_RECORD")
    if given:
        return Record(Path(given))
    folder = tmp_path_factory.mktemp("embedded") / "run"
    with light():
        main_job.run_embedded(folder)
    return Record(folder)
