"""The cases of fault_cases.txt: every fault of the simulated drive, and what the master does."""

import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from canopen.profiles.p402 import State402
from commands import Record, config_file
from rig import IDEAL_CONFIG, SDO_REQUEST, SYNC

from canwall import cli, simdrive
from canwall.config import Settings
from canwall.cycle import exchange as exchange_module
from canwall.faults import KINDS
from canwall.record import Phase, Recorder
from canwall.run import buses

CASES = Path(__file__).with_name("fault_cases.txt")
DOCUMENT = Path(__file__).parents[2] / "docs" / "ways_out.md"
#: SYNC with which the fault begins: while the drive is enabled, before the handle reaches the wall,
#: as it goes in, while the hand rests on it.
WHEN = {"enabling": 1, "moving": 230, "hitting": 262, "resting": 500}
DURATION_S = 1.0
RIDES = "rides through"


class Case(NamedTuple):
    fault: str
    when: str
    message: str
    commanded: str
    drive: str
    state: str
    exit_code: str

    @property
    def at(self) -> int:
        return WHEN[self.when]

    @property
    def toml(self) -> str:
        kind, *keys = self.fault.split()
        lines = [f'kind = "{kind}"', f"at_sync = {self.at}"]
        for key in keys:
            name, value = key.split("=")
            lines.append(f"{name} = " + (f'"{value}"' if value.isalpha() else value))
        return "\n".join(["", "[[simulation.fault]]", *lines, ""])


def cases() -> list[Case]:
    lines = [line for line in CASES.read_text().splitlines() if line and line[0] != "#"]
    return [Case(*re.split(r" {2,}", line)) for line in lines]


class Witness:
    """Reads torque and state from the drive itself, past the faults of its frames."""

    def __init__(self, drive: simdrive.FaultyDrive) -> None:
        self._drive = drive.drive
        self._process = drive.process
        drive.process = self._noted  # type: ignore[method-assign]
        #: 0x6077 at each SYNC.
        self.torques: list[int] = []

    def _noted(self, can_id: int, data: bytes) -> list[simdrive.Frame]:
        frames = self._process(can_id, data)
        if can_id == SYNC and len(data) == 0:
            self.torques.append(self.torque())
        return frames

    def torque(self) -> int:
        return self._read(0x6077, "<h")

    def state(self) -> str:
        word = self._read(0x6041, "<H")
        states = State402.SW_MASK.items()
        return next(name for name, (mask, value) in states if word & mask == value)

    def _read(self, index: int, form: str) -> int:
        for _, data in self._drive.process(SDO_REQUEST, struct.pack("<BHB4x", 0x40, index, 0)):
            if data[0] >> 5 == 2:
                return int(struct.unpack_from(form, data, 4)[0])
        return 0  # without supply


@pytest.fixture
def witnesses(monkeypatch: pytest.MonkeyPatch) -> list[Witness]:
    """One witness for each simulated drive that is made."""
    found: list[Witness] = []
    make = buses.make_simulated_drive

    def watched(settings: Settings) -> simdrive.FaultyDrive:
        drive = make(settings)
        found.append(Witness(drive))
        return drive

    monkeypatch.setattr(buses, "make_simulated_drive", watched)
    monkeypatch.setattr(Recorder, "draw", lambda recorder, given_up: [])
    monkeypatch.setattr(exchange_module, "_SIMULATED_TIMEOUT_S", 0.02)
    monkeypatch.setattr(exchange_module, "_MISSING_TIMEOUT_S", 0.002)
    return found


def run_with(folder: Path, toml: str, exchange: str) -> int:
    """Run `canwall run` in this process; return its exit code."""
    changes = {
        "[bus]\n": f'[bus]\nexchange = "{exchange}"\n',
        "duration_s = 4.2": f"duration_s = {DURATION_S}",
        'law = "standard"\n': 'law = "half_sample"\n',
    }
    file = config_file(folder / "c.toml", changes, IDEAL_CONFIG)
    text = file.read_text().split("[[schedule]]")[0]
    file.write_text(text + toml)
    arguments = ["run", str(file), "--output", str(folder / "run")]
    return cli.guarded(lambda: cli.app(arguments, standalone_mode=False))


def cycles_with(torque: "np.ndarray[tuple[int], np.dtype[np.int64]]", at: int) -> int:
    """Return the cycles from the SYNC of the fault until the torque is zero for good."""
    last = np.flatnonzero(torque[at:])
    return int(last[-1]) + 1 if len(last) else 0


def found_case(
    case: Case, folder: Path, witnesses: list[Witness], errors: Callable[[], str], exchange: str
) -> Case:
    """Play the case; return it with what the master and the drive did."""
    code = run_with(folder, case.toml, exchange)
    said = [line.removeprefix("canwall: ") for line in errors().splitlines()]
    record = Record(folder / "run")
    assert_whole(record, said if code else [])
    (witness,) = witnesses
    message, commanded, drive = RIDES, "-", "-"
    if not code:
        message = "; ".join([RIDES, *said])
    else:
        message = "; then: ".join(re.sub(r"^cycle \d+ \([\d.]+ s\): ", "", line) for line in said)
        rendering = np.where(record.column("phase") == Phase.RENDERING, 1, 0)
        sent = record.column("torque_cmd_per_mille").astype(int)
        assert not sent[rendering == 0].any()
        commanded = str(cycles_with(sent, case.at))
        drive = str(cycles_with(np.array(witness.torques), case.at))
        if record.summary["trip_cycle"] is not None:
            assert not sent[record.summary["trip_cycle"] :].any()
    assert witness.torque() == 0
    return case._replace(
        message=message,
        commanded=commanded,
        drive=drive,
        state=witness.state(),
        exit_code=str(code),
    )


def assert_whole(record: Record, said: list[str]) -> None:
    """Assert that every cycle, every frame and what ended the run are in the record."""
    j = record.column("j")
    assert j.tolist() == list(range(record.summary["cycles"]))
    rpdos = [struct.unpack("<Hh", rpdo) for _, rpdo in record.cycles]
    assert [word for word, _ in rpdos] == record.column("controlword").tolist()
    assert [torque for _, torque in rpdos] == record.column("torque_cmd_per_mille").tolist()
    assert record.summary["trips"] == said
    assert (record.folder / "trip.csv").exists() == (record.summary["trip_cycle"] is not None)


def played() -> list[tuple[Case, str]]:
    """Every case on sockets; over python-can every fault once, when it begins last.

    Both have the same rules of a cycle. What only python-can may get wrong is how frames come and
    go, and that does not depend on when a fault begins.
    """
    last = {case.fault: case for case in cases()}
    return [
        *((case, "native") for case in cases()),
        *((case, "python-can") for case in last.values()),
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "exchange"),
    played(),
    ids=lambda given: given if isinstance(given, str) else f"{given.fault}, {given.when}",
)
def test_case(
    case: Case,
    exchange: str,
    tmp_path: Path,
    witnesses: list[Witness],
    capfd: pytest.CaptureFixture[str],
) -> None:
    found = found_case(case, tmp_path, witnesses, lambda: capfd.readouterr().err, exchange)
    pattern = ".+".join(map(re.escape, case.message.split("…")))
    assert re.fullmatch(pattern, found.message), found.message
    for most, cycles in ((case.commanded, found.commanded), (case.drive, found.drive)):
        assert most == cycles or int(cycles) <= int(most), found
    assert (found.state, found.exit_code) == (case.state, case.exit_code)


def test_every_fault_at_every_time() -> None:
    named = {(case.fault.split()[0], case.when) for case in cases()}
    assert named >= {(kind, when) for kind in KINDS for when in ("enabling", "moving", "resting")}


def table() -> str:
    """Return the cases as docs/ways_out.md has them."""
    lines = [
        "| fault | when | what the master does or says | torque commanded [cycles] | at the drive "
        "[cycles] | drive in the end | exit code |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [f"| `{case.fault}` | " + " | ".join(case[1:]) + " |" for case in cases()]
    return "\n".join(lines)


def test_document_has_these_cases() -> None:
    assert table() in DOCUMENT.read_text()
