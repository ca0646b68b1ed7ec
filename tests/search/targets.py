"""What comes from outside, as bytes: each target takes any and ends in order, or with one line.

A target raises what is a finding: what `guarded` would let through as a traceback, a line that is
none, or something that was read although it is not what was written.
"""

import functools
import hmac
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from unittest.mock import patch

import numpy as np
from adversary import Act, Duel, Master, acts, fast_duels
from hypothesis import given, settings
from matplotlib.backends.backend_agg import FigureCanvasAgg
from rig import eds_without
from simdrive_bench import EDS, PERIOD_S
from test_any_frames import Event, Fuzzed, event_lists, without_enabling

import canwall.cli.ending
import canwall.simdrive.communication.dictionary as drive_dictionary
from canwall import config
from canwall.cli import guarded
from canwall.cli.sweep import console, plot
from canwall.drive import REQUIRED_OBJECTS
from canwall.eds import load_eds
from canwall.errors import InputError
from canwall.run import run as run_wall
from canwall.simdrive import make_drive
from canwall.sweep.journal import Journal

#: Longest line about bad input.
_LINE = 1000


@dataclass(frozen=True)
class Target:
    """Something to be given bytes.

    Attributes:
        take: takes any bytes; what it raises is a finding.
        modules: beginnings of the names of the modules whose branches guide the fuzzer.
        seeds: contents that are in order, to begin with.
        context: what holds while it is fuzzed.
        longest: largest input [bytes].
    """

    take: Callable[[bytes], None]
    modules: tuple[str, ...]
    seeds: Callable[[], list[bytes]] = field(default=lambda: [b"\0" * 64])
    context: Callable[[], AbstractContextManager[None]] = nullcontext
    longest: int = 4096


def in_order(command: Callable[[], object]) -> bool:
    """Return whether a command succeeded; it has one line about what is wrong otherwise."""
    lines: list[str] = []
    with patch.object(canwall.cli.ending, "say", lines.append):
        code = guarded(command)
    if code == 0:
        return True
    (line,) = lines
    if "\n" in line or len(line) > _LINE:
        raise AssertionError(f"not one line: {line!r}")
    return False


# Frames


@settings(database=None)
@given(events=event_lists)
def _drive(events: list[Event]) -> None:
    bench = Fuzzed(EDS)
    bench.happen(events)
    for can_id, data in bench.sent:
        assert 0 < can_id <= 0x7FF
        assert len(data) <= 8
    assert bench.answers_a_valid_request()


@settings(database=None)
@given(events=event_lists)
def _drive_that_nobody_enables(events: list[Event]) -> None:
    bench = Fuzzed(EDS)
    bench.happen([without_enabling(event) for event in events])
    for _ in range(3):
        bench.sync()
    assert not any(call[1] for call in bench.motion.calls if call[0] == "advance")


@settings(database=None)
@given(planned=acts())
def _master(planned: list[Act]) -> None:
    duel = Duel()
    try:
        duel.adversary.plan(planned)
        Master(duel, cycles=100).run()
        duel.settle()
    finally:
        duel.close()


@contextmanager
def _one_dictionary() -> Iterator[None]:
    load = functools.cache(drive_dictionary.load_eds)
    with patch.object(drive_dictionary, "load_eds", load):
        yield


def _frames_into_drive(data: bytes) -> None:
    one = _drive if data[:1] < b"\x80" else _drive_that_nobody_enables
    one.hypothesis.fuzz_one_input(data[1:])  # type: ignore[attr-defined]


def _frames_into_master(data: bytes) -> None:
    _master.hypothesis.fuzz_one_input(data)  # type: ignore[attr-defined]


# Files


@functools.cache
def _folder() -> Path:
    """Return a folder for what this process writes."""
    folder = tempfile.TemporaryDirectory(prefix="canwall-search-")
    _kept.append(folder)
    return Path(folder.name)


_kept: list["tempfile.TemporaryDirectory[str]"] = []


def _dictionary(data: bytes) -> None:
    file = _folder() / "drive.eds"
    file.write_bytes(data)
    in_order(lambda: load_eds(file, 5, REQUIRED_OBJECTS) and None)
    given = config.load(config.shipped("config/sim.toml"))
    drive = given.drive.model_copy(update={"eds": file})
    assert given.simulation is not None

    def live() -> None:
        device = make_drive(drive, given.simulation, PERIOD_S)
        device.boot()
        device.tick(0.01)
        device.process(0x080, b"")
        device.process(0x605, bytes.fromhex("40 4160 00 00000000"))

    in_order(live)


def _dictionaries() -> list[bytes]:
    file = _folder() / "less.eds"
    kept = {0x1000, 0x1001, 0x1018, *REQUIRED_OBJECTS, 0x6061, 0x6077, 0x6076, 0x608F}
    names = [line.strip("[]") for line in EDS.read_text().splitlines() if line.startswith("[")]
    objects = {name for name in names if "sub" not in name and len(name) == 4}
    eds_without(file, *(name for name in objects if int(name, 16) not in kept))
    return [file.read_bytes(), EDS.read_bytes()[:4000]]


def _configuration(data: bytes) -> None:
    file = _folder() / "c.toml"
    file.write_bytes(data)
    found: list[config.Settings] = []
    if in_order(lambda: found.append(config.load(file))):
        again = _folder() / "again.toml"
        again.write_text(found[0].to_toml(), encoding="utf-8")
        assert config.load(again) == found[0], "what a run keeps of it is something else"


def _configurations() -> list[bytes]:
    folder = config.shipped("config")
    return [file.read_bytes() for file in sorted(folder.glob("*.toml"))]


#: The files of a record, by the first byte of an input, and its folder.
_RECORD = ("signals.parquet", "summary.json", "config.toml", "bus.log", "signals.arrows")


@functools.cache
def _recorded() -> Path:
    """Return the folder of a run with a contact, to be copied."""
    folder = _folder() / "recorded"
    duration = {"run.duration_s": 0.5}
    settings = config.load(config.shipped("config/sim.toml"), duration)
    run_wall(settings, folder)
    return folder


def _record(data: bytes) -> None:
    name, content = _RECORD[data[0] % len(_RECORD) if data else 0], data[1:]
    folder = _folder() / "run"
    shutil.copytree(_recorded(), folder)
    try:
        if name == "signals.arrows":  # of a run that was cut off
            (folder / "signals.parquet").unlink()
            (folder / "summary.json").unlink()
        (folder / name).write_bytes(content)
        in_order(lambda: plot(folder))
    finally:
        shutil.rmtree(folder)


def _records() -> list[bytes]:
    import io

    import pyarrow as pa

    from canwall.record import read_signals

    signals = read_signals(_recorded() / "signals.parquet")
    stream = io.BytesIO()
    with pa.ipc.new_stream(stream, signals.schema) as writer:
        writer.write_table(signals.slice(0, 200), max_chunksize=50)
    contents = {"signals.arrows": stream.getvalue()}
    contents |= {
        name: (_recorded() / name).read_bytes() for name in _RECORD if name not in contents
    }
    return [bytes([k]) + contents[name] for k, name in enumerate(_RECORD)]


@contextmanager
def _pictures_not_painted() -> Iterator[None]:
    console.quiet = True
    with patch.object(FigureCanvasAgg, "print_png", lambda *given, **more: None):
        yield
    console.quiet = False


_PIECE = np.dtype([("limit", "f8"), ("chatter", "?"), ("cycles", "i8")])
_PLAN = '{"axes": {"stiffness": [1.0, 2.0, 3.0]}}'


def _piece(number: int) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    return np.array([(number + 0.5, True, 1000 + number)] * 4, _PIECE)


class _Unseen:
    """A checksum whose comparison a fuzzer does not see: it would write that of its own piece."""

    def __init__(self, digest: str) -> None:
        self._digest = digest.encode()

    def encode(self) -> "_Unseen":
        return self

    def __eq__(self, other: object) -> bool:
        return isinstance(other, bytes) and hmac.compare_digest(self._digest, other)


_digest_of = Journal._digest


def _unseen_digest(journal: Journal, number: int, data: bytes) -> _Unseen:
    return _Unseen(_digest_of(journal, number, data))


@patch.object(Journal, "_digest", _unseen_digest)
def _journal(data: bytes) -> None:
    result = _folder() / "a.nc"
    partial = _folder() / "a.nc.partial"
    partial.write_bytes(data)
    try:
        journal = Journal(result, _PLAN, resume=True)
        try:
            for number in journal.done():
                piece = journal.get(number, _PIECE)
                assert 0 <= number < 3, f"piece {number} of 3"
                assert piece.tobytes() == _piece(number).tobytes(), "not what was written"
        finally:
            journal.close()
    except InputError:
        pass
    finally:
        for file in _folder().glob("a.nc*"):
            file.unlink()


def _journals() -> list[bytes]:
    result = _folder() / "seed.nc"
    journal = Journal(result, _PLAN, resume=False)
    for number in range(3):
        journal.put(number, _piece(number))
    journal.close()
    content = journal.path.read_bytes()
    journal.path.unlink()
    return [content]


TARGETS = {
    "frames into the drive": Target(
        _frames_into_drive, ("canwall.simdrive",), context=_one_dictionary
    ),
    "frames into the master": Target(
        _frames_into_master, ("canwall.drive", "canwall.cycle", "canopen"), context=fast_duels
    ),
    "dictionaries": Target(
        _dictionary,
        ("canwall.eds", "canopen.objectdictionary", "canwall.simdrive"),
        _dictionaries,
        longest=8192,
    ),
    "configurations": Target(
        _configuration, ("canwall.config", "tomllib"), _configurations, longest=16384
    ),
    "records": Target(
        _record, ("canwall.record",), _records, _pictures_not_painted, longest=1 << 20
    ),
    "journals": Target(_journal, ("canwall.sweep.journal",), _journals, longest=1 << 16),
}
