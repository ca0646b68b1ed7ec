"""Signals that request the end of a run, so that the drive is disabled first."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopRequest:
    """A flag that is set when the end of the run is requested."""

    def __init__(self) -> None:
        self.requested = False

    def __call__(self) -> bool:
        """Return whether the end was requested."""
        return self.requested


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Turn Ctrl-C, SIGTERM and a closed terminal into a request, for as long as the context lasts.

    Signals that the program was started to ignore (nohup) stay ignored.
    """
    stop = StopRequest()

    def request(number: int, frame: object) -> None:
        stop.requested = True

    handled = [s for s in _SIGNALS if signal.getsignal(s) is not signal.SIG_IGN]
    previous = {s: signal.signal(s, request) for s in handled}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
