"""Progress of calls that take a while, in a terminal and in a notebook."""

import sys
import threading
import warnings
from types import TracebackType
from typing import Any, Self

from canwall.code_on_disk import is_first_start
from canwall.compiled import announce_compiling

#: Interval at which it is drawn [s].
_DRAWN_EVERY_S = 0.2


class Progress:
    """A progress bar on standard error; a context manager, which removes the bar at its end.

    It is drawn by a thread of its own: the loop of a run, which reports from between two cycles,
    does not wait for a terminal or a browser. What neither is a terminal nor a notebook gets none.
    """

    def __init__(self, shown: bool) -> None:
        """Show nothing if `shown` is False."""
        self._shown = shown
        self._what, self._done = "preparing", 0.0
        self._total: float | None = None
        self._ended = threading.Event()

    def __enter__(self) -> Self:
        if not self._shown:
            return self
        if is_first_start():
            announce_compiling(
                lambda: self.report("compiling for this machine, about half a minute")
            )
        with warnings.catch_warnings():
            # Without ipywidgets the bar is made of characters, which does as well.
            warnings.simplefilter("ignore")
            from tqdm.auto import tqdm

        self._bar: Any = tqdm(
            bar_format="{desc} {bar:24} {n:.4g}/{total:.4g}",
            total=1,
            leave=False,
            # A notebook's standard error does not say that it is one.
            disable=False if "ipykernel" in sys.modules else None,
        )
        self._thread = threading.Thread(target=self._draw_until_ended, daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._shown:
            self._ended.set()
            self._thread.join()
            self._bar.close()

    def report(self, what: str) -> None:
        """Show the step that begins now."""
        self._what = what

    def advance(self, now_s: float, end_s: float | None) -> None:
        """Show the seconds done, of a total or until stopped."""
        self._done, self._total = now_s, end_s

    def count(self, what: str, done: int, total: int) -> None:
        """Show the steps done of a total."""
        self._what, self._done, self._total = what, done, total

    def _draw_until_ended(self) -> None:
        while not self._ended.wait(_DRAWN_EVERY_S):
            self._bar.set_description(self._what, refresh=False)
            self._bar.n, self._bar.total = self._done, self._total or self._done or 1
            self._bar.refresh()
