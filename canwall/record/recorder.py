"""Master's end of the record: it starts, commands and ends the writer."""

import contextlib
import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from canwall.record.folder import RecordError, RunFolder, unfinished
from canwall.record.ring import Ring
from canwall.record.target import Target

#: Time limit for the writer to complete its files after the run, or to draw [s], and what it has
#: more to draw each row of a long run [s].
_TIMEOUT_S, _DRAWING_S = 60.0, 1e-4


#: Interval at which it is asked whether to wait any longer [s].
_LOOK_S = 0.05

#: Time limit for a stream to send what is left at the end of a run [s].
_STREAM_REST_S = 2.0


class Recorder:
    """Record of a run in progress; a context manager, which ends the writer.

    The writer, a separate process, empties `ring` into the run's folder. It takes some tenths of a
    second to start, so a recorder should be made early, ahead of other work.
    """

    def __init__(self) -> None:
        """Start the writer. Raises RecordError."""
        self.folder = Path()
        self._begun = False
        self._failure = ""
        self._unread = b""
        self._answers: list[str] = []
        try:
            self.ring = Ring.create()
            self._writer = subprocess.Popen(
                [sys.executable, "-P", "-m", "canwall.record.writer", str(self.ring.descriptor)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                bufsize=0,
                pass_fds=[self.ring.descriptor],
                start_new_session=True,  # Ctrl-C is for the master, which ends the writer
            )
        except OSError as error:
            raise RecordError(f"the writer of the record does not start: {error}") from None
        assert self._writer.stdout is not None
        self._says = select.poll()
        self._says.register(self._writer.stdout, select.POLLIN)

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, *exc_info: object) -> None:
        if not self._begun:
            self._writer.kill()  # it may still be starting
        with self._writer:  # closes the pipes, which ends the writer, and waits for it
            pass
        self.ring.close()

    def begin(self, folder: Path, bus_log: str, channel: str, laws: Sequence[str]) -> None:
        """Begin to record into an existing folder, without frames if `bus_log` is empty."""
        self.folder = folder
        self._begun = True
        self._tell(folder=str(folder), bus_log=bus_log, channel=channel, laws=list(laws))

    def failure(self) -> str:
        """Return why the record cannot go on, in a line, as soon as it is so; empty while it does.

        It takes a microsecond, so that the loop can ask in every cycle.
        """
        if not self._failure and self._says.poll(0):
            self._listen()
        return self._failure and f"{self.folder}: the record is incomplete: {self._failure}"

    def close(self) -> list[str]:
        """Complete the files. Returns remarks for readers of the record, one line each."""
        self._tell(close=True)
        if error := self._answer():
            self._failure = self._failure or error
        notes = [failure] if (failure := self.failure()) else []
        header = self.ring.header[0]
        for what in ("rows", "frames"):
            lost = int(header[f"{what}_lost"])
            if lost:
                notes.append(f"{self.folder}: {lost} {what} lost: the disk was too slow")
        return notes

    def draw(self, given_up: Callable[[], bool] = lambda: False) -> list[str]:
        """Draw run.png once the summary is written. Returns errors, one line each.

        given_up: Asked meanwhile; True ends the drawing.
        """
        self._tell(draw=True)
        rows = int(self.ring.header["row_head"][0])
        error = self._answer(given_up, _TIMEOUT_S + _DRAWING_S * rows)
        if not error:
            return []
        if self._writer.poll() is not None:
            picture = RunFolder(self.folder).picture
            unfinished(picture, self._writer.pid).unlink(missing_ok=True)
        return [f"{self.folder}: the picture is missing: {error}"]

    def _tell(self, **order: Any) -> None:
        assert self._writer.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # `_listen` notices a writer that has died
            self._writer.stdin.write(json.dumps(order).encode() + b"\n")

    def _answer(
        self, given_up: Callable[[], bool] = lambda: False, timeout_s: float | None = None
    ) -> str:
        """Return the writer's error message on an order, empty if all went well."""
        deadline = time.monotonic() + (_TIMEOUT_S if timeout_s is None else timeout_s)
        while not self._answers:
            if not self._says.poll(_LOOK_S * 1e3):
                if given_up():
                    self._kill_writer()
                    return "given up; `canwall plot` draws it"
                if time.monotonic() < deadline:
                    continue
                self._kill_writer()
                return "the writer of the record does not answer"
            if not self._listen():
                return self._failure
        return self._answers.pop(0)

    def _kill_writer(self) -> None:
        self._writer.kill()
        self._writer.wait()

    def _listen(self) -> bool:
        """Read what the writer says, which is waiting; return False if it has died."""
        assert self._writer.stdout is not None
        part = os.read(self._writer.stdout.fileno(), 4096)
        *lines, self._unread = (self._unread + part).split(b"\n")
        for line in lines:
            said = json.loads(line)
            if "done" in said:
                self._answers.append(said["done"])
            else:
                self._failure = said["failed"]
        if not part:
            self._failure = self._failure or "the writer of the record has died"
        return bool(part)


class Stream:
    """Rows of a run that are sent to a plotting program as they come; a context manager.

    A process of its own reads along behind the loop and takes nothing out of the ring: neither a
    receiver that is slow or absent nor the end of that process disturbs the run.
    """

    def __init__(self, ring: Ring, target: Target, name: str, laws: Sequence[str]) -> None:
        """Start the process. Raises RecordError.

        Args:
            ring: Ring of the run, which has to outlast the stream.
            target: Host and port to which it sends, see `parse_target`.
            name: Name of the group of signals.
            laws: Names of the laws of the run.
        """
        what = json.dumps({"target": target, "name": name, "laws": list(laws)})
        try:
            self._sender = subprocess.Popen(
                [sys.executable, "-P", "-m", "canwall.record.stream", str(ring.descriptor), what],
                stdin=subprocess.PIPE,
                bufsize=0,
                pass_fds=[ring.descriptor],
                start_new_session=True,
            )
        except OSError as error:
            raise RecordError(f"the stream does not start: {error}") from None

    def __enter__(self) -> "Stream":
        return self

    def __exit__(self, *exc_info: object) -> None:
        assert self._sender.stdin is not None
        self._sender.stdin.close()  # it sends the rest and ends
        try:
            self._sender.wait(_STREAM_REST_S)
        except subprocess.TimeoutExpired:
            self._sender.kill()
            self._sender.wait()


@contextlib.contextmanager
def start_recorders(count: int) -> Iterator[list[Recorder]]:
    """Start a recorder for each of `count` drives, for the context. Raises RecordError."""
    with contextlib.ExitStack() as stack:
        yield [stack.enter_context(Recorder()) for _ in range(count)]
