"""A run's folder: its files by name, and reading them back."""

import json
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from canwall.config import ConfigError
from canwall.record.ring import ROW


def read_signals(path: Path) -> pa.Table:
    """signals.parquet as a table. Raises ConfigError where it is missing or not readable."""
    try:
        table = pq.read_table(path)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; give the folder of a run") from None
    except (OSError, pa.ArrowInvalid) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"{path}: not a record of a run: {reason}") from None
    missing = [name for name in ROW.names or () if name not in table.column_names]
    if missing:
        raise ConfigError(f"{path}: not a record of a run: lacks column {', '.join(missing)}")
    return table


@dataclass(frozen=True)
class RunFolder:
    """One run on disk."""

    path: Path

    @classmethod
    def create(cls, path: Path | None) -> "RunFolder":
        """A new folder; with no path, `runs/<date and time>` under the current directory.

        Raises ConfigError where the folder cannot be made or holds a run already.
        """
        if path is None:
            path = Path("runs") / datetime.now().strftime("%Y-%m-%d_%H-%M-%S_%f")
        folder = cls(path)
        if folder.signals.exists():
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

    @property
    def signals(self) -> Path:
        """One row per cycle."""
        return self.path / "signals.parquet"

    @property
    def summary(self) -> Path:
        """What came of it."""
        return self.path / "summary.json"

    @property
    def config(self) -> Path:
        """The configuration as resolved."""
        return self.path / "config.toml"

    @property
    def picture(self) -> Path:
        """The run at a glance."""
        return self.path / "run.png"

    def read_summary(self) -> dict[str, Any]:
        """summary.json. Raises ConfigError where it is missing or not JSON."""
        try:
            content: dict[str, Any] = json.loads(self.summary.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise ConfigError(f"{self.summary}: not a summary of a run: {error}") from None
        if "strikes" not in content:
            raise ConfigError(f"{self.summary}: not a summary of a run: lacks strikes")
        return content
