"""The master's end of the record: starts the writer, and closes the record with it."""

import json
import subprocess
import sys
from pathlib import Path

from canwall.errors import RunFailedError
from canwall.record.ring import Ring

#: How long a writer may take to complete its files after the run [s].
_CLOSE_TIMEOUT_S = 60.0


class RecordError(RunFailedError):
    """A record that could not be written."""


class Recorder:
    """A run's record in the making.

    Everything goes through `ring`. `close` completes the files; a master that dies has them
    completed all the same.
    """

    def __init__(self, folder: Path, bus_log: str | None, channel: str, laws: list[str]) -> None:
        """Start recording into an existing folder. Raises RecordError."""
        self.folder = folder
        self.ring = Ring.create()
        arguments = [
            str(self.ring.descriptor),
            str(folder),
            bus_log or "",
            channel,
            json.dumps(laws),
        ]
        try:
            self._writer = subprocess.Popen(
                [sys.executable, "-m", "canwall.record.writer", *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                pass_fds=[self.ring.descriptor],
                start_new_session=True,  # Ctrl-C is meant for the master, who ends the writer
            )
        except OSError as error:
            raise RecordError(
                f"{folder}: the writer of the record does not start: {error}"
            ) from None

    def close(self) -> list[str]:
        """Complete the files. Returns what a reader of the record has to know, a line each."""
        try:
            out, _ = self._writer.communicate(timeout=_CLOSE_TIMEOUT_S)
            error = json.loads(out)["error"]
        except (subprocess.TimeoutExpired, ValueError):
            self._writer.kill()
            self._writer.communicate()
            error = "the writer of the record did not finish"
        header = self.ring.header[0]
        notes = [f"{self.folder}: the record is incomplete: {error}"] if error else []
        for what in ("rows", "frames"):
            lost = int(header[f"{what}_lost"])
            if lost:
                notes.append(f"{self.folder}: {lost} {what} lost: the disk was too slow")
        return notes
