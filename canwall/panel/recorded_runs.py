"""Recorded runs as a page shows them: summary, strikes, marks, and signals at any zoom."""

import os
from typing import Any

import numpy as np

from canwall.config import ConfigError, load
from canwall.errors import InputError
from canwall.panel.frames import SIGNALS, signals_frame
from canwall.panel.held import Held
from canwall.panel.pyramid import Pyramid
from canwall.panel.shelf import Shelf
from canwall.record import RunFolder, numbers, read_signals
from canwall.record.columns import UNITS
from canwall.record.folder import stream_of

#: Recorded runs that are held in memory: 45 bytes per cycle.
_HELD = 4
#: The most points of one answer.
_MOST_POINTS = 20_000


class InProgressError(InputError):
    """A run whose record cannot be opened yet."""


class RecordedRuns:
    """Recorded runs below a folder, the last ones that were opened in memory.

    A run that was cut off is read as it is, and its folder left alone. A run in progress cannot be
    opened: its record would tell which wall is which in a blind comparison.
    """

    def __init__(self, shelf: Shelf) -> None:
        self._shelf = shelf
        self._pyramids = Held[Pyramid](_HELD)
        self._summaries = Held[dict[str, Any]](_HELD)

    def describe(self, word: str) -> dict[str, Any]:
        """Return a run without its signals, as JSON.

        Raises:
            InputError: If there is no such run, or its record cannot be used.
        """
        folder = self._ended(word)
        entry = self._shelf.entry(folder.path)
        summary = dict(self._summaries.get(_stamp(folder), lambda: _summary(folder)))
        strikes = summary.pop("strikes")
        settings, remarks = _settings(folder)
        return {
            **{key: entry[key] for key in ("id", "name", "when", "state", "duration_s")},
            "cycle_s": summary.get("cycle_s"),
            "remarks": [*summary.get("trips", []), *remarks],
            "columns": [{"name": name, "unit": UNITS[name]} for name in SIGNALS],
            "strikes": _strikes(strikes, summary),
            "summary": summary,
            "marks": folder.read_events(),
            "settings": settings,
        }

    def signals(self, word: str, start_s: float, stop_s: float, points: float) -> bytes:
        """Return the signals of a run between two times in a frame, as `Pyramid.between` does.

        Raises:
            InputError: If there is no such run, its record is damaged, or the interval is empty.
        """
        if not start_s < stop_s:
            raise InputError(f"from = {start_s:g}, to = {stop_s:g}: from has to be less than to")
        if not 1 <= points <= _MOST_POINTS:
            raise InputError(f"points = {points:g}: has to be between 1 and {_MOST_POINTS}")
        folder = self._ended(word)
        pyramid = self._pyramids.get(_stamp(folder), lambda: _pyramid(folder))
        return signals_frame(*pyramid.between(start_s, stop_s, int(points)))

    def _ended(self, word: str) -> RunFolder:
        folder = self._shelf.run(word)
        if folder.is_being_written:
            raise InProgressError(f"{folder.path}: the run is in progress; open it once it is over")
        return folder


def _stamp(folder: RunFolder) -> tuple[str, int, int]:
    """Return what changes with the record of a run.

    Raises:
        ConfigError: If there is none.
    """
    for path in (stream_of(folder.signals), folder.signals):
        try:
            found = path.stat()
        except OSError:
            continue
        return str(path), found.st_mtime_ns, found.st_size
    raise ConfigError(f"{folder.signals}: no such file; give the folder of a run")


def _summary(folder: RunFolder) -> dict[str, Any]:
    if os.path.lexists(folder.summary):
        return folder.read_summary()
    from canwall.run import read_run  # compiled code, which a complete record does not need

    return read_run(folder, complete=False).summary


def _strikes(strikes: list[dict[str, Any]], summary: dict[str, Any]) -> list[dict[str, Any]]:
    """Return strikes with the names that contacts of a run in progress have as well.

    A strike is passive as `analysis.metrics` has it: it gives no energy but what one encoder count
    explains.
    """
    drive = summary.get("drive")
    count = drive.get("rad_per_count") if isinstance(drive, dict) else None
    return [
        strike
        | {
            "n": number,
            "energy_j": strike.get("energy_out_j"),
            "passive": _is_passive(strike, count),
            "depth_rad": strike["peak_penetration_rad"],
        }
        for number, strike in enumerate(strikes, start=1)
    ]


def _is_passive(strike: dict[str, Any], count: float | None) -> bool | None:
    most, force = strike.get("energy_out_max_j"), strike.get("peak_force_nm")
    if most is None or force is None:
        return None
    return bool(most <= (count or 0.0) * force)


def _pyramid(folder: RunFolder) -> Pyramid:
    table = read_signals(folder.signals, ("t_s", *SIGNALS), only=True)
    if table.num_rows == 0:
        raise ConfigError(f"{folder.path}: no cycle was recorded")
    columns = np.empty((len(SIGNALS), table.num_rows), np.float32)
    for column, name in zip(columns, SIGNALS, strict=True):
        column[:] = numbers(table, name)
    return Pyramid(numbers(table, "t_s"), columns)


def _settings(folder: RunFolder) -> tuple[dict[str, Any] | None, list[str]]:
    """Return the configuration of a run; without one that this version reads, a remark."""
    try:
        return load(folder.config).model_dump(mode="json"), []
    except ConfigError as error:
        return None, [str(error)]
