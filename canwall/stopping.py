"""Signals that request the end of a run, so that the drive is disabled first; the end at once."""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import NoReturn

#: Exit code of what Ctrl-C has ended, with the drive disabled.
INTERRUPTED = 130

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopRequest:
    """Requests of the end so far.

    Attributes:
        count: Number of signals.
        held: True if signals are only counted, False if they raise KeyboardInterrupt.
    """

    def __init__(self, held: bool = True) -> None:
        self.count = 0
        self.held = held
        self._attend: Callable[[], object] = lambda: None

    def __call__(self) -> bool:
        """Return whether the end was requested."""
        return self.count > 0

    def hold(self, attend: Callable[[], object]) -> None:
        """Only count signals from now on, so that what ends the run is complete.

        Args:
            attend: Called at each signal: has the loop look at this request at once.
        """
        self._attend = attend
        self.held = True

    def request(self) -> None:
        """Request the end, as a signal does; any thread may call this."""
        self.count += 1
        self._attend()

    def _request(self, number: int, frame: object) -> None:
        self.request()
        if not self.held:
            raise KeyboardInterrupt


_in_force: list[StopRequest] = []


@contextmanager
def stop_on_signals(held: bool = True) -> Iterator[StopRequest]:
    """Turn Ctrl-C, SIGTERM and a closed terminal into a request, for as long as the context lasts.

    Signals that the program was started to ignore (nohup) stay ignored. A context within another
    one has the request of that.

    Args:
        held: False if signals are to raise KeyboardInterrupt until `StopRequest.hold` is called.
    """
    if _in_force:
        _in_force[-1].held |= held
        yield _in_force[-1]
        return
    stop = StopRequest(held)
    _in_force.append(stop)
    handled = [s for s in _SIGNALS if signal.getsignal(s) is not signal.SIG_IGN]
    previous = {s: signal.signal(s, stop._request) for s in handled}
    try:
        yield stop
    finally:
        _in_force.remove(stop)
        for number, handler in previous.items():
            signal.signal(number, handler)


def end_at_once(code: int) -> NoReturn:
    """End the process with an exit code; what has been printed is told, nothing else is done."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, OSError, ValueError):  # closed, or none
            stream.flush()
    os._exit(code)
