"""Signs of life for the watchdogs of the drives, sent by the cycle: a loop that hangs is dead."""

import time
from collections.abc import Iterable

import can

from canwall.drive import Link, Watchdog


class Beats:
    """Sends what the watchdogs of all drives want to hear, each when it is due."""

    def __init__(self, link: Link, watchdogs: Iterable[Watchdog]) -> None:
        """Drives that listen to the same heartbeat get it as often as the shortest one wants."""
        self._link = link
        periods: dict[tuple[int, bytes, bool], float] = {}
        for watchdog in watchdogs:
            beat = watchdog.beat
            if beat is not None:
                key = beat.can_id, beat.data, beat.remote
                periods[key] = min(watchdog.period_s, periods.get(key, watchdog.period_s))
        self._messages = [
            can.Message(
                arbitration_id=can_id, data=data, is_remote_frame=remote, is_extended_id=False
            )
            for can_id, data, remote in periods
        ]
        self._periods_ns = [round(period * 1e9) for period in periods.values()]
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
