"""A run in progress from a script or a notebook."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from canwall.errors import ConfigError
from canwall.extras import need
from canwall.library.arguments import as_dict, as_path
from canwall.library.laws import LawLike, law_name
from canwall.record.columns import ROW, UNITS, record_batch
from canwall.record.live import LiveRun, LiveSettings
from canwall.record.ring import ROWS
from canwall.record.status import Status

if TYPE_CHECKING:
    import pandas as pd


def attach(folder: str | os.PathLike[str]) -> "AttachedRun":
    """Attach to a run in progress on this machine, by its folder.

    The run, which another process has started (`canwall run`, the panel, a notebook), does not wait
    for this one.

    Args:
        folder: Folder of its record; of several drives on one bus, that of one, `node5` for one.

    Raises:
        canwall.errors.ConfigError: If no run that writes the folder is in progress.
    """
    return AttachedRun(LiveRun.open(as_path("folder", folder)))


class AttachedRun:
    """A run in progress; a context manager, which detaches from it."""

    def __init__(self, live: LiveRun) -> None:
        self.live = live
        self._rows: NDArray[np.void] = np.zeros(0, ROW)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def close(self) -> None:
        """Detach; the run goes on."""
        self.live.close()

    @property
    def folder(self) -> Path:
        """Folder of the record, for `canwall.read` once the run has ended."""
        return self.live.folder.path

    @property
    def status(self) -> Status:
        """State of the run, renewed some 30 times a second."""
        return self.live.status()

    @property
    def settings(self) -> LiveSettings:
        """Wall, limits, guard and operator in force."""
        return self.live.settings()

    def signals(self, seconds: float | None = None) -> "pd.DataFrame":
        """Return the last signals, a row per SYNC, as `canwall.RecordedRun.signals` has them.

        Args:
            seconds: Their bus time; None: all that the run keeps in memory, 16 384 cycles.
        """
        need("sweep")
        self._rows = np.concatenate([self._rows, self.live.rows()])[-ROWS:]
        rows = self._rows
        if seconds is not None and len(rows):
            rows = rows[rows["t_s"] > rows["t_s"][-1] - seconds]
        laws = [law.name for law in self.settings.laws]
        signals = record_batch(rows, laws).to_pandas()
        signals.attrs["units"] = {name: UNITS.get(name, "") for name in signals.columns}
        return signals

    def change(
        self,
        *,
        law: LawLike | None = None,
        stiffness: float | None = None,
        damping: float | None = None,
        position: float | None = None,
        options: Mapping[str, float] | None = None,
        **keys: Any,
    ) -> int:
        """Change the wall, as a whole and without a bump (`canwall change`).

        Args:
            law: One of the laws of the run (`settings.laws`).
            stiffness: Stiffness [N·m/rad].
            damping: Damping [N·m·s/rad], instead of a damping ratio too.
            position: Position of the wall on the drive's axis [rad].
            options: Options of the law.
            keys: Other keys of `[[schedule]]`: `tension="clamp"`, `limits={"torque_nm": 1.0}`,
                `guard={"action": "act"}`. Limits only go down.

        Returns:
            The cycle from which on it is in force.

        Raises:
            canwall.errors.ConfigError: If it is wrong, or the run refuses it.
            canwall.errors.RunFailedError: If the run does not take it.
        """
        given = {
            "law": None if law is None else law_name(law),
            "stiffness_nm_per_rad": stiffness,
            "damping_nm_s_per_rad": damping,
            "position_rad": position,
            "options": None if options is None else as_dict("options", options),
        }
        given = {key: value for key, value in given.items() if value is not None}
        if "do" in keys:
            raise ConfigError("do: unknown key; a change has keys of [[schedule]]")
        return self.live.request({"do": "change"} | given | keys)

    def take_turns(self, *walls: Mapping[str, Any]) -> int:
        """Have walls alternate from strike to strike; none ends it.

        Each has keys of `[[schedule]]`, and applies to the wall in force: `{"law": "standard"},
        {"law": "half_sample"}`. Returns and raises as `change`.
        """
        given = [as_dict(f"walls.{i}", wall) for i, wall in enumerate(walls)]
        return self.live.request({"do": "take_turns", "walls": given})

    def mark(self, text: str) -> int:
        """Write a line into the run's events.jsonl; return its cycle. Raises as `change`."""
        return self.live.request({"do": "mark", "text": text})

    def watch_beat(self, timeout_s: float) -> int:
        """Have the wall ramped down and the run ended once `beat` has not been called for a time.

        Args:
            timeout_s: That time [s], 0.1 to 5; 0: never.
        """
        return self.live.request({"do": "watch_beat", "timeout_s": timeout_s})

    def beat(self) -> None:
        """Show a sign of life."""
        self.live.beat()

    def stop(self) -> None:
        """Have the torque zero in the next cycle, and the drive disabled; the run ends as tripped.

        No part of the run has to answer for the zero. It is no emergency stop.
        """
        self.live.stop()

    def end(self) -> int:
        """End the run as Ctrl-C does. Raises as `change`."""
        return self.live.request({"do": "end"})

    def __repr__(self) -> str:
        status, wall = self.status, self.settings.wall
        how = "ended" if status.ended else status.phase
        return (
            f"<AttachedRun {self.folder}: {wall.law}, {wall.stiffness_nm_per_rad:g} N·m/rad; "
            f"{how}, cycle {status.cycle}>"
        )
