"""Signs of life for the watchdogs of the drives, sent by the cycle: a loop that hangs is dead."""

import time
from collections.abc import Iterable

import can

from canwall.drive import Link, Watchdog
from canwall.drive.watchdog import ErrorControlFrame


def periods_ns(watchdogs: Iterable[Watchdog]) -> dict[ErrorControlFrame, int]:
    """The signs of life that these watchdogs want to hear, and how often each.

    Drives that listen to the same heartbeat get it as often as the shortest one wants.
    """
    periods: dict[ErrorControlFrame, float] = {}
    for watchdog in watchdogs:
        beat = watchdog.error_control
        if beat is not None:
            periods[beat] = min(watchdog.period_s, periods.get(beat, watchdog.period_s))
    return {beat: round(period * 1e9) for beat, period in periods.items()}


class Beats:
    """Sends what the watchdogs of all drives want to hear, each when it is due."""

    def __init__(self, link: Link, watchdogs: Iterable[Watchdog]) -> None:
        self._link = link
        periods = periods_ns(watchdogs)
        self._messages = [
            can.Message(
                arbitration_id=beat.can_id,
                data=beat.data,
                is_remote_frame=beat.remote,
                is_extended_id=False,
            )
            for beat in periods
        ]
        self._periods_ns = list(periods.values())
        self._due_ns = [0] * len(periods)

    def __bool__(self) -> bool:
        """Whether there is anything to send at all."""
        return bool(self._messages)

    def send(self) -> None:
        """Send what is due now. Raises can.CanError."""
        now = time.perf_counter_ns()
        for k, message in enumerate(self._messages):
            if now >= self._due_ns[k]:
                self._link.send(message)
                self._due_ns[k] = now + self._periods_ns[k]
