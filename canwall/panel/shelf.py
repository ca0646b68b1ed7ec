"""Recorded runs and sweeps below a folder, and the words by which a page names them."""

import base64
import functools
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from canwall.errors import InputError
from canwall.record import RunFolder
from canwall.record.folder import stream_of

#: Folders that are looked into, and their depth below the first one.
_MOST_FOLDERS, _DEPTH = 5000, 5
_NOT_THERE = "no such run or sweep; choose one of the list"


class NotThereError(InputError):
    """A run or a sweep that does not exist."""


@dataclass(frozen=True)
class Shelf:
    """Runs and sweeps in a folder and in those below it.

    Attributes:
        root: The folder; or that of a single run, or the file of a single sweep.
    """

    root: Path

    def contents(self) -> dict[str, Any]:
        """Return what is there, the newest first, and whether folders were left out, as JSON."""
        items: list[dict[str, Any]] = []
        truncated = False
        for number, (folder, sweeps) in enumerate(self._folders()):
            if number == _MOST_FOLDERS:
                truncated = True
                break
            items += [self.entry(path) for path in ([folder] if _is_run(folder) else sweeps)]
        items.sort(key=lambda item: str(item["when"]), reverse=True)
        return {"items": items, "truncated": truncated}

    def run(self, word: str) -> RunFolder:
        """Return a run by its word. Raises NotThereError if there is none."""
        path = self._path(word)
        if not _is_run(path):
            raise NotThereError(_NOT_THERE)
        return RunFolder(path)

    def sweep(self, word: str) -> Path:
        """Return the file of a sweep by its word. Raises NotThereError if there is none."""
        path = self._path(word)
        if not _is_sweep(path):
            raise NotThereError(_NOT_THERE)
        return path

    def entry(self, path: Path) -> dict[str, Any]:
        """Return what the list says of the folder of a run, or of the file of a sweep."""
        relative = path.relative_to(self.root)
        word = base64.urlsafe_b64encode(os.fsencode(relative)).rstrip(b"=").decode()
        name = str(relative) if relative.parts else self.root.resolve().name
        name = os.fsencode(name).decode(errors="replace")
        if _is_sweep(path):
            return {"id": word, "kind": "sweep", "name": name, "when": _when(path)}
        return {"id": word, "kind": "run", "name": name, **_run_entry(RunFolder(path))}

    def _path(self, word: str) -> Path:
        """Return the path that a word stands for, which is not outside of the root."""
        try:
            encoded = word.encode("ascii") + b"=" * (-len(word) % 4)
            relative = Path(os.fsdecode(base64.b64decode(encoded, b"-_", validate=True)))
            path = self.root / relative
            below = not relative.is_absolute() and ".." not in relative.parts
            inside = below and path.resolve().is_relative_to(self.root.resolve())
        except (ValueError, OSError, RuntimeError):  # RuntimeError: for links in a circle
            inside = False
        if not inside:
            raise NotThereError(_NOT_THERE)
        return path

    def _folders(self) -> Iterator[tuple[Path, list[Path]]]:
        """Yield each folder and the sweeps in it; there is nothing below the folder of a run."""
        if self.root.is_file():
            yield self.root.parent, [self.root]
            return
        for path, below, files in os.walk(self.root):
            folder = Path(path)
            deep = len(folder.relative_to(self.root).parts) >= _DEPTH or _is_run(folder)
            below[:] = [] if deep else [name for name in below if not name.startswith(".")]
            yield folder, [folder / name for name in files if _is_sweep(folder / name)]


def _is_run(path: Path) -> bool:
    signals = RunFolder(path).signals
    return os.path.isfile(signals) or os.path.isfile(stream_of(signals))  # also for a long name


def _is_sweep(path: Path) -> bool:
    return path.suffix == ".nc" and os.path.isfile(path)


def _when(path: Path) -> str:
    """Return the time at which a file was written, in ISO 8601; empty if it is not there."""
    try:
        return datetime.fromtimestamp(path.stat().st_mtime, UTC).isoformat(timespec="seconds")
    except OSError:
        return ""


def _run_entry(folder: RunFolder) -> dict[str, Any]:
    # The configuration is written at the start.
    entry: dict[str, Any] = {"when": _when(folder.config), "laws": [], "stiffness": None}
    entry |= {"strikes": None, "duration_s": None, "chatter": None}
    if folder.is_being_written:
        return entry | {"state": "in progress"}
    try:
        found = folder.summary.stat()
    except OSError:
        return entry | {"state": "cut off"}
    return entry | _from_summary(folder, found.st_mtime_ns, found.st_size)


@functools.lru_cache(maxsize=4096)
def _from_summary(folder: RunFolder, _modified_ns: int, _size: int) -> dict[str, Any]:
    """Return what the list takes from a summary; it is read again once it has changed."""
    try:
        summary = folder.read_summary()
    except InputError as error:
        return {"state": "damaged", "error": str(error)}
    strikes = summary["strikes"]
    laws = list(dict.fromkeys(strike["law"] for strike in strikes)) or summary.get("law", [])
    length = summary.get("cycles"), summary.get("cycle_s")
    return {
        "state": "cut off" if summary.get("cut_off") else "complete",
        "laws": laws,
        "stiffness": summary.get("stiffness"),
        "strikes": len(strikes),
        "duration_s": math.prod(length)
        if all(isinstance(n, int | float) for n in length)
        else None,
        "chatter": any(strike["chatter"] for strike in strikes),
    }
