"""Dialogue with a person at a terminal who may stop the wall at any time."""

import os
import select
import time
from collections.abc import Iterable
from typing import TextIO

#: Interval at which the keyboard is polled while a wall is rendered [s].
_POLL_INTERVAL_S = 0.02


class SessionEndedError(Exception):
    """The person ended the session; the drive is disabled."""


class Terminal:
    """Prompts and answers, line by line; a line can also stop a wall while it is rendered."""

    def __init__(self, source: int = 0, words: TextIO | None = None) -> None:
        """Read from the descriptor `source`, print to `words`; by default the standard ones."""
        self._source = source
        self._words = words
        self._buffer = b""
        self._polled_s = 0.0
        self._at_end = False

    def say(self, text: str) -> None:
        """Print a line."""
        print(text, file=self._words, flush=True)

    def ask(self, question: str, answers: Iterable[str]) -> str:
        """Repeat the question until it gets one of the answers.

        Raises SessionEndedError on "q" and at the end of the input.
        """
        known = tuple(answers)
        while True:
            print(f"{question} ", end="", file=self._words, flush=True)
            line = self._read_line()
            if line is None or line == "q":
                raise SessionEndedError
            if line in known:
                return line
            listed = ", ".join("Enter" if answer == "" else answer for answer in known)
            self.say(f"please type one of: {listed}, q")

    def discard_input(self) -> None:
        """Discard what was typed so far, which cannot answer a question still to come."""
        while self._has_input():
            if not self._fill_buffer():
                break
        self._buffer = b""

    def poll_line(self) -> str | None:
        """Return a line typed since the last call, None without one, "q" at the end of input."""
        if time.monotonic() < self._polled_s + _POLL_INTERVAL_S:
            return None
        self._polled_s = time.monotonic()
        if b"\n" not in self._buffer and self._has_input():
            self._fill_buffer()
        if b"\n" in self._buffer:
            return self._read_line()
        return "q" if self._at_end else None

    def _has_input(self) -> bool:
        return not self._at_end and bool(select.select([self._source], [], [], 0.0)[0])

    def _fill_buffer(self) -> bool:
        """Read what is there, waiting for it; False at the end of input."""
        data = b"" if self._at_end else os.read(self._source, 1024)
        self._at_end = not data
        self._buffer += data
        return bool(data)

    def _read_line(self) -> str | None:
        """Return the next line, waiting for it; None at the end of input."""
        while b"\n" not in self._buffer:
            if not self._fill_buffer():
                return None
        line, _, self._buffer = self._buffer.partition(b"\n")
        return line.decode(errors="replace").strip().lower()
