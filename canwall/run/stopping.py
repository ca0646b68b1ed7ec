"""What asks a run to end: signals, which end nothing themselves."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

#: What asks a run to end.
_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopRequest:
    """Whether somebody asked the run to end."""

    def __init__(self) -> None:
        self.requested = False

    def __call__(self) -> bool:
        """Whether it was asked for."""
        return self.requested


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Ctrl-C, SIGTERM and a terminal that is closed ask for an end instead of ending.

    The drive is to be disabled first. What the program was started to ignore (nohup) it ignores.
    """
    stop = StopRequest()

    def request(number: int, frame: object) -> None:
        stop.requested = True

    ends = [s for s in _ENDING if signal.getsignal(s) is not signal.SIG_IGN]
    previous = {s: signal.signal(s, request) for s in ends}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
