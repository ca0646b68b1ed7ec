"""Folder of a run: names of its files, and functions to read them."""

import contextlib
import json
from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from canwall.errors import ConfigError

if TYPE_CHECKING:
    import pyarrow as pa

#: Cycles before a trip that are kept.
_TRIP_CYCLES = 200


def stream_of(signals: Path) -> Path:
    """Return the path of the rows during the run: a stream that is readable while incomplete."""
    return signals.with_suffix(".arrows")


def read_signals(path: Path, columns: Collection[str] = ("j",)) -> "pa.Table":
    """Read signals.parquet as a table, or the stream of a run that was cut off.

    The table has all columns of the record, which another version may have written: some may be
    missing and others added. `columns` are those that the caller requires.

    Raises:
        ConfigError: If the file is missing, not readable, or lacks one of `columns`.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        stream = stream_of(path)
        table = _read_stream(stream) if stream.exists() else pq.ParquetFile(path).read()
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; give the folder of a run") from None
    except (OSError, pa.ArrowInvalid) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"{path}: not a record of a run: {reason}") from None
    missing = [name for name in columns if name not in table.column_names]
    if missing:
        raise ConfigError(
            f"{path}: lacks column {', '.join(missing)}: not a record of a run, or an older one "
            "than this needs"
        )
    return table


def numbers(signals: "pa.Table", name: str) -> NDArray[Any]:
    """Return a column of numbers as an array, shape (n,).

    pyarrow's `to_numpy` would import pandas first, which takes longer than a short run.
    """
    chunks = [np.from_dlpack(chunk) for chunk in signals[name].chunks]
    return np.concatenate(chunks) if chunks else np.empty(0)


def _read_stream(path: Path) -> "pa.Table":
    """Return the batches of a stream up to the first incomplete one."""
    import pyarrow as pa

    with path.open("rb") as file, pa.ipc.open_stream(file) as stream:
        batches = []
        with contextlib.suppress(OSError, pa.ArrowInvalid):
            batches.extend(stream)
        return pa.Table.from_batches(batches, stream.schema)


@dataclass(frozen=True)
class RunFolder:
    """One run on disk."""

    path: Path

    @classmethod
    def create(cls, path: Path | None) -> "RunFolder":
        """Create a folder, by default `runs/<date and time>` under the current directory.

        Raises ConfigError if the folder cannot be created or already holds a run.
        """
        path = path or cls.default_path()
        folder = cls(path)
        if folder.signals.exists() or stream_of(folder.signals).exists():
            raise ConfigError(f"{path}: holds a run already; choose another --output")
        try:
            path.mkdir(parents=True, exist_ok=True)
            probe = path / ".writable"
            probe.touch()
            probe.unlink()
        except OSError as error:
            raise ConfigError(
                f"{path}: cannot be written: {error.strerror}; choose another --output"
            ) from None
        return folder

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
        """Path of a file that exists during the run and holds the address for changes."""
        return self.path / "live.json"

    @property
    def trip(self) -> Path:
        """Path of the last cycles before a trip, with every column, for a spreadsheet."""
        return self.path / "trip.csv"

    def write_trip(self, signals: "pa.Table", cycle: int) -> None:
        """Write the cycles up to the one that tripped, in the order of j."""
        import pyarrow.csv as pa_csv

        end = int(np.searchsorted(numbers(signals, "j"), cycle, side="right"))
        pa_csv.write_csv(
            signals.slice(max(0, end - _TRIP_CYCLES), min(end, _TRIP_CYCLES)), self.trip
        )

    def read_summary(self) -> dict[str, Any]:
        """Read summary.json. Raises ConfigError if it is missing or not JSON."""
        try:
            content: dict[str, Any] = json.loads(self.summary.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise ConfigError(f"{self.summary}: not a summary of a run: {error}") from None
        if "strikes" not in content:
            raise ConfigError(f"{self.summary}: not a summary of a run: lacks strikes")
        return content
