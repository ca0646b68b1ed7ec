"""Output of the commands: the two consoles, error lines, progress."""

import os
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from canwall.strict_json import as_json


class _LastingConsole(Console):
    """Console that outlasts its file: a full disk or a closed pipe does not end a command.

    Attributes:
        has_lost: True once a result could not be written; who closes a pipe has read enough.
    """

    has_lost = False

    def __init__(self, **options: Any) -> None:
        # What is printed is text: [b] and :b: are parts of names.
        super().__init__(markup=False, emoji=False, **options)

    def print(self, *objects: Any, **options: Any) -> None:
        try:
            super().print(*objects, **options)
        except OSError as error:
            # What is left in buffers goes nowhere, at the end of Python as well.
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, 2 if self.stderr else 1)
            os.close(nowhere)
            if not self.stderr and not isinstance(error, BrokenPipeError):
                self.has_lost = True
                say(f"standard output cannot be written: {error.strerror}")

    def on_broken_pipe(self) -> None:
        """Leave it to `print`: rich would end the command."""
        raise BrokenPipeError


console = _LastingConsole()
errors = _LastingConsole(stderr=True, soft_wrap=True, highlight=False)


def say(text: str) -> None:
    """Print an error, a warning or a note as a line on standard error."""
    errors.print(f"canwall: {text}")


def print_json(content: Any) -> None:
    """Print a result as a line of JSON on standard output; what is no finite number is null."""
    print_text(as_json(content))


def print_text(text: str, end: str = "\n") -> None:
    """Print a text on standard output as it is."""
    console.print(text, end=end, soft_wrap=True, highlight=False)


class ProgressDisplay:
    """Progress on standard error: the current step, with seconds of bus time or a count."""

    def __init__(self) -> None:
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[clock]}"),
            TimeRemainingColumn(),
            console=errors,
            disable=not errors.is_terminal,
        )
        self._task = self._progress.add_task("preparing", total=None, clock="")

    def __enter__(self) -> "ProgressDisplay":
        self._progress.start()
        return self

    def __exit__(self, error: type[BaseException] | None, *exc_info: object) -> None:
        # Erase the display if an error line follows.
        self._progress.live.transient = error is not None
        self._progress.stop()

    def report(self, what: str) -> None:
        """Show the step that begins now."""
        self._progress.update(self._task, description=what)

    def advance(self, now_s: float, end_s: float | None) -> None:
        """Show the seconds done, of a total or until stopped."""
        clock = f"{now_s:.1f} s" if end_s is None else f"{now_s:.1f} of {end_s:g} s"
        self._progress.update(self._task, completed=now_s, total=end_s, clock=clock)

    def phase(self, what: str, now_s: float, end_s: float) -> None:
        """Show the seconds done of a named phase."""
        self.report(what)
        self.advance(now_s, end_s)

    def count(self, what: str, done: int, total: int) -> None:
        """Show the steps done of a total."""
        clock = f"{done} of {total}"
        self._progress.update(
            self._task, description=what, completed=done, total=total, clock=clock
        )
