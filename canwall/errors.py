"""The two kinds of failure that a user sees; the text of each is one short line."""

import difflib
import re
from collections.abc import Iterable, Sequence
from typing import Any

#: Longest word and longest text of a message, which may quote what it is about [characters].
_WORD, _TEXT = 250, 1000


def one_line(text: str) -> str:
    """Return a text as a line: control characters escaped, what is too long cut in its middle."""
    printable = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    return _cut(re.sub(r"\S+", lambda word: _cut(word[0], _WORD), printable), _TEXT)


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """Return the end of a message about an unknown name: the known one that is closest.

    It is empty if none is close.
    """
    close = difflib.get_close_matches(str(name), list(known), n=1)
    return f"; did you mean {close[0]}?" if close else ""


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[: most // 2]}…{text[-(most // 2 - 1) :]}"


class InputError(ValueError):
    """Input that cannot be used; the text says what, where, and what to do. Exit code 2."""

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))


class ConfigError(InputError):
    """A configuration that cannot be used."""


class RunFailedError(Exception):
    """Failure of a run. Exit code 1."""

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))


class TrippedError(RunFailedError):
    """A limit ended the run; the drive is disabled.

    Attributes:
        run: The run up to then, as `canwall.run` returns it.
    """

    def __init__(self, text: str, run: Any) -> None:
        super().__init__(text)
        self.run = run


class RunWarning(UserWarning):
    """Something that a run could not complete: a part of its record, or the drive put back."""


def first_of(failures: Sequence[str]) -> str:
    """Return the first of several failures, and how many more there are, in one line."""
    more = f", and {len(failures) - 1} more" if len(failures) > 1 else ""
    return f"{failures[0]}{more}"
