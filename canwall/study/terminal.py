"""Questions to a person at a terminal who may end what goes on at any time."""

import os
import select
import time
from collections.abc import Iterable

#: Between two looks after the keyboard while a wall is rendered [s].
_LOOKS_S = 0.02


class SessionEndedError(Exception):
    """The person, or Ctrl-C, ended the session; the drive is disabled."""


class Terminal:
    """Prompts and answers, line by line; the same lines can end a wall while it is rendered."""

    def __init__(self, source: int = 0) -> None:
        """source: file descriptor of the keyboard."""
        self._source = source
        self._read = b""
        self._looked = 0.0
        self._ended = False

    def say(self, text: str) -> None:
        """A line to the person."""
        print(text, flush=True)

    def ask(self, question: str, answers: Iterable[str]) -> str:
        """One of the answers. Raises SessionEndedError for q, and where the input has ended."""
        known = tuple(answers)
        while True:
            print(f"{question} ", end="", flush=True)
            line = self._line()
            if line is None or line == "q":
                raise SessionEndedError
            if line in known:
                return line
            said = ", ".join("Enter" if answer == "" else answer for answer in known)
            self.say(f"please: {said}, or q")

    def discard_input(self) -> None:
        """What was typed before is no answer to what comes."""
        while self._waits():
            if not self._take():
                break
        self._read = b""

    def pressed(self) -> str | None:
        """A line that was typed meanwhile; "q" where the input has ended."""
        if time.monotonic() < self._looked + _LOOKS_S:
            return None
        self._looked = time.monotonic()
        if b"\n" not in self._read and self._waits():
            self._take()
        if b"\n" in self._read:
            return self._line()
        return "q" if self._ended else None

    def _waits(self) -> bool:
        return not self._ended and bool(select.select([self._source], [], [], 0.0)[0])

    def _take(self) -> bool:
        data = b"" if self._ended else os.read(self._source, 1024)
        self._ended = not data
        self._read += data
        return bool(data)

    def _line(self) -> str | None:
        while b"\n" not in self._read:
            if not self._take():
                return None
        line, _, self._read = self._read.partition(b"\n")
        return line.decode(errors="replace").strip().lower()
