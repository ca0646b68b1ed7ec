"""Folder of a run: names of its files, and functions to read them."""

import contextlib
import fcntl
import json
import os
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from canwall.errors import ConfigError, RunFailedError
from canwall.record.columns import schema
from canwall.record.shared_memory import LiveAddresses, MemoryAddress

if TYPE_CHECKING:
    import pyarrow as pa

#: Cycles before a trip that are kept.
_TRIP_CYCLES = 200
#: What readers of a summary need of each strike.
_STRIKE = {
    "start_s": float,
    "end_s": float,
    "law": str,
    "stiffness": float,
    "chatter": bool,
    "chatter_frequency_hz": float,
    "peak_penetration_rad": float,
}


class RecordError(RunFailedError):
    """Failure to write a record."""


def reason(error: BaseException) -> str:
    """Return why a file could not be read or written, in one line."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return (str(error).splitlines() or [type(error).__name__])[0]


def unfinished(path: Path, writer: int) -> Path:
    """Return the path at which a process with this ID writes a file before it is whole."""
    return path.with_name(f".{path.name}.{writer}")


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[IO[bytes]]:
    """Write a file whole or not at all.

    What has its name is replaced, and nothing written through it if it is a symbolic link.

    Raises RecordError if it cannot be written.
    """
    new = unfinished(path, os.getpid())
    try:
        new.unlink(missing_ok=True)
        with new.open("xb") as file:
            yield file
            synchronise(file)
        new.replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            new.unlink(missing_ok=True)
        if not isinstance(error, OSError):
            raise
        raise RecordError(f"{path}: cannot be written: {reason(error)}") from None


def synchronise(file: IO[Any]) -> None:
    """Write a file through to the disk."""
    file.flush()
    os.fsync(file.fileno())


def stream_of(signals: Path) -> Path:
    """Return the path of the rows during the run: a stream that is readable while incomplete."""
    return signals.with_suffix(".arrows")


def read_signals(
    path: Path, columns: Collection[str] = ("j",), *, only: bool = False
) -> "pa.Table":
    """Read signals.parquet as a table, or the stream of a run that was cut off.

    The table has all columns of the record, which another version may have written: some may be
    missing and others added. `columns` are those that the caller requires.

    Args:
        path: The file.
        columns: Names of the columns that the caller requires.
        only: Read no others.

    Raises:
        ConfigError: If the file is missing, not readable, or lacks one of `columns`.
    """
    import pyarrow as pa

    wanted = list(columns) if only else None
    try:
        try:
            table = _read_stream(stream_of(path), wanted)
        except FileNotFoundError:
            table = _read_parquet(path, wanted)
        table.validate(full=True)
    except NotADirectoryError:
        raise ConfigError(f"{path.parent}: is a file; give the folder of a run") from None
    except FileNotFoundError:
        raise ConfigError(
            of_several_drives(path.parent) or f"{path}: no such file; give the folder of a run"
        ) from None
    except (OSError, UnicodeError, pa.ArrowException) as error:
        raise ConfigError(f"{path}: not a record of a run: {reason(error)}") from None
    missing = [name for name in columns if name not in table.column_names]
    if missing:
        raise ConfigError(
            f"{path}: lacks column {', '.join(missing)}: not a record of a run, or an older one "
            "than this needs"
        )
    for field in schema(()):
        if field.name in table.column_names and table.schema.field(field.name).type != field.type:
            found = table.schema.field(field.name).type
            raise ConfigError(
                f"{path}: column {field.name} holds {found}, not {field.type}: not a record of a "
                "run, or one of another version"
            )
    return table


def numbers(signals: "pa.Table", name: str) -> NDArray[Any]:
    """Return a column of numbers as an array, shape (n,).

    pyarrow's `to_numpy` would import pandas first, which takes longer than a short run.
    """
    chunks = [np.from_dlpack(chunk) for chunk in signals[name].chunks]
    return np.concatenate(chunks) if chunks else np.empty(0)


def _read_parquet(path: Path, columns: list[str] | None) -> "pa.Table":
    import pyarrow as pa
    import pyarrow.parquet as pq

    with pq.ParquetFile(path, page_checksum_verification=True) as file:
        table = file.read(columns)
        # The number of rows stands there twice, and has no checksum.
        if table.num_rows != file.metadata.num_rows:
            raise pa.ArrowInvalid(f"{table.num_rows} rows, not {file.metadata.num_rows}")
        return table


def _read_stream(path: Path, columns: list[str] | None) -> "pa.Table":
    """Return the batches of a stream up to the first incomplete one."""
    import pyarrow as pa

    with path.open("rb") as file, pa.ipc.open_stream(file) as stream:
        batches = []
        with contextlib.suppress(OSError, pa.ArrowException):
            batches.extend(stream)
        table = pa.Table.from_batches(batches, stream.schema)
        return (
            table
            if columns is None
            else table.select([n for n in columns if n in table.schema.names])
        )


@dataclass(frozen=True)
class RunFolder:
    """One run on disk."""

    path: Path

    @classmethod
    def create(cls, path: Path | None, config: str, bus_log: str = "bus.log") -> "RunFolder":
        """Create the folder of one run, by default `runs/<date and time>` here.

        Args:
            path: The folder; it may exist and hold other files. What a run has left in it that
                failed before its first cycle is replaced.
            config: Content of config.toml. Who creates that file has the folder.
            bus_log: Path of the bus log, relative to the folder.

        Raises:
            ConfigError: If the folder cannot be written, or one of the files is there already,
                whoever made it.
        """
        folder = cls(path or cls.default_path())
        try:
            folder.path.mkdir(parents=True, exist_ok=True)
            folder._remove_empty_record(bus_log)
            refuse_taken(folder._files(bus_log))
            folder._claim(config)
        except OSError as error:
            raise ConfigError(
                f"{folder.path}: cannot be written: {reason(error)}; choose another --output"
            ) from None
        return folder

    def _remove_empty_record(self, bus_log: str) -> None:
        with contextlib.suppress(ConfigError, FileNotFoundError):
            if read_signals(self.signals).num_rows or os.path.lexists(self.summary):
                return
            self.signals.unlink()  # first: of several runs that begin here, only one goes on
            self.config.unlink(missing_ok=True)
            (self.path / bus_log).unlink(missing_ok=True)

    def _claim(self, config: str) -> None:
        """Write config.toml, unless another run has done so meanwhile."""
        try:
            file = self.config.open("xb")
        except FileExistsError:
            raise _taken(self.config) from None
        try:
            with file:
                file.write(config.encode())
                synchronise(file)
        except OSError:
            self.config.unlink()
            raise

    def _files(self, bus_log: str) -> list[Path]:
        signals, log = self.signals, self.path / bus_log
        known = [signals, stream_of(signals), self.summary, self.picture, self.live, self.trip]
        return [*known, self.events, self.config, log]

    @property
    def is_being_written(self) -> bool:
        """True while a run, or what completes its record, is alive (`lock_folder`)."""
        try:
            descriptor = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY)
        except OSError:
            return False
        try:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:
            return False  # a file system without locks
        finally:
            os.close(descriptor)
        return False

    @staticmethod
    def default_path() -> Path:
        """Return `runs/<date and time>` under the current directory."""
        return Path("runs") / datetime.now().strftime("%Y-%m-%d_%H-%M-%S_%f")

    @property
    def signals(self) -> Path:
        """Path of the signals, one row per cycle (Parquet)."""
        return self.path / "signals.parquet"

    @property
    def summary(self) -> Path:
        """Path of the summary (JSON)."""
        return self.path / "summary.json"

    @property
    def config(self) -> Path:
        """Path of the resolved configuration (TOML)."""
        return self.path / "config.toml"

    @property
    def picture(self) -> Path:
        """Path of the picture of the run."""
        return self.path / "run.png"

    @property
    def live(self) -> Path:
        """Path of a file that exists during the run, with the addresses of its shared memory."""
        return self.path / "live.json"

    @property
    def events(self) -> Path:
        """Path of what other processes asked of the run, and of their marks (JSON lines)."""
        return self.path / "events.jsonl"

    @property
    def trip(self) -> Path:
        """Path of the last cycles before a trip, with every column, for a spreadsheet."""
        return self.path / "trip.csv"

    def write_summary(self, summary: dict[str, Any]) -> None:
        """Write summary.json. Raises RecordError if it cannot be written."""
        with whole_file(self.summary) as file:
            file.write(json.dumps(summary, indent=2).encode() + b"\n")

    def write_trip(self, signals: "pa.Table", cycle: int) -> None:
        """Write the cycles up to the one that tripped, in the order of j.

        Raises RecordError if they cannot be written.
        """
        import pyarrow.csv as pa_csv

        end = int(np.searchsorted(numbers(signals, "j"), cycle, side="right"))
        rows = signals.slice(max(0, end - _TRIP_CYCLES), min(end, _TRIP_CYCLES))
        with whole_file(self.trip) as file:
            pa_csv.write_csv(rows, file)

    def write_live(self, addresses: LiveAddresses) -> None:
        """Write live.json. Raises RecordError if it cannot be written."""
        content = {name: address._asdict() for name, address in addresses._asdict().items()}
        with whole_file(self.live) as file:
            file.write(json.dumps(content, indent=1).encode() + b"\n")

    def read_live(self) -> LiveAddresses:
        """Read live.json. Raises OSError or ValueError if there is none that can be used."""
        try:
            content = json.loads(self.live.read_text(encoding="utf-8"))
        except RecursionError:
            content = None
        if not isinstance(content, dict) or set(content) != set(LiveAddresses._fields):
            raise ValueError("not the addresses of a run")
        return LiveAddresses(**{name: _address(value) for name, value in content.items()})

    def write_event(self, event: dict[str, Any]) -> None:
        """Append a line to events.jsonl. Raises OSError."""
        with self.events.open("ab") as file:
            file.write(json.dumps(event, ensure_ascii=False).encode() + b"\n")

    def read_events(self) -> list[dict[str, Any]]:
        """Read events.jsonl: requests that were taken, marks and what else ended the wall.

        A line that a failure has cut off is left out; a run without requests has none.
        """
        try:
            lines = self.events.read_bytes().splitlines()
        except FileNotFoundError:
            return []
        except OSError as error:
            raise ConfigError(f"{self.events}: {reason(error)}") from None
        events = []
        for line in lines:
            with contextlib.suppress(ValueError, RecursionError):
                if isinstance(event := json.loads(line), dict):
                    events.append(event)
        return events

    def read_summary(self) -> dict[str, Any]:
        """Read summary.json. Raises ConfigError if it is missing or not a summary."""
        try:
            content = json.loads(self.summary.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError) as error:
            raise ConfigError(f"{self.summary}: not a summary of a run: {reason(error)}") from None
        strikes = content.get("strikes") if isinstance(content, dict) else None
        if not isinstance(strikes, list) or not all(map(_is_strike, strikes)):
            raise ConfigError(f"{self.summary}: not a summary of a run: lacks strikes")
        return content


def _address(value: object) -> MemoryAddress:
    kinds = MemoryAddress.__annotations__
    if not isinstance(value, dict) or {k: type(v) for k, v in value.items()} != kinds:
        raise ValueError("not the address of a block of memory")
    return MemoryAddress(**value)


def _is_strike(entry: object) -> bool:
    return isinstance(entry, dict) and all(
        isinstance(entry.get(name), (int, float) if kind is float else kind)
        for name, kind in _STRIKE.items()
    )


def of_several_drives(path: Path) -> str:
    """Return what to do with a folder that holds those of several drives; of others, nothing."""
    drives: list[str] = []
    with contextlib.suppress(OSError, ValueError):  # of a name that is none of a file
        drives = sorted(config.parent.name for config in path.glob("node*/config.toml"))
    if not drives:
        return ""
    return f"{path}: the run of several drives; give the folder of one: {', '.join(drives)}"


def lock_folder(path: Path) -> int | None:
    """Mark a run's folder as being written for as long as the descriptor is open.

    Returns None where the file system has no locks.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)  # who looks at it has it for microseconds
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def refuse_taken(files: Iterable[Path]) -> None:
    """Raise ConfigError if one of the files that are to be written is there already."""
    for file in files:
        if os.path.lexists(file):
            raise _taken(file)


def _taken(file: Path) -> ConfigError:
    return ConfigError(f"{file.parent}: holds {file.name} already; choose another --output")
