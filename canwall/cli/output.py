"""What a terminal shows of every command: the two consoles, error lines, progress."""

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

console = Console()
errors = Console(stderr=True, soft_wrap=True, highlight=False)


def say(text: str) -> None:
    """Error, warning or note: a line on standard error."""
    errors.print(f"canwall: {text}", markup=False)


class ShownProgress:
    """Progress: what is being done, then seconds of bus time, or steps."""

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

    def __enter__(self) -> "ShownProgress":
        self._progress.start()
        return self

    def __exit__(self, error: type[BaseException] | None, *exc_info: object) -> None:
        # The line that an error becomes stands alone.
        self._progress.live.transient = error is not None
        self._progress.stop()

    def report(self, what: str) -> None:
        """What is being done now."""
        self._progress.update(self._task, description=what)

    def advance(self, now_s: float, end_s: float | None) -> None:
        """So many seconds of so many, or until it is stopped."""
        clock = f"{now_s:.1f} s" if end_s is None else f"{now_s:.1f} of {end_s:g} s"
        self._progress.update(self._task, completed=now_s, total=end_s, clock=clock)

    def part(self, what: str, now_s: float, end_s: float) -> None:
        """So many seconds of so many, of a part that has a name."""
        self.report(what)
        self.advance(now_s, end_s)

    def count(self, what: str, done: int, total: int) -> None:
        """So many steps of so many."""
        clock = f"{done} of {total}"
        self._progress.update(
            self._task, description=what, completed=done, total=total, clock=clock
        )
