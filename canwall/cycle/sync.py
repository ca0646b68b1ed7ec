"""The SYNC of a run: the master's own, on a grid of absolute deadlines, or another producer's."""

import time
from typing import Protocol

import can

from canwall.bus import DataFrame
from canwall.drive import Link

#: The last part of a wait is spent awake: a sleep ends when the scheduler likes.
SPIN_NS = 200_000
#: Without a SYNC for this long, and no less than so many periods, its producer is gone.
_SILENCE_S, _SILENT_PERIODS = 0.1, 10


class SyncLostError(can.CanOperationError):
    """The producer of the SYNC has fallen silent."""

    def __init__(self, patience_s: float) -> None:
        super().__init__(f"no SYNC from its producer for {patience_s:g} s")


def sync_patience_s(period_s: float) -> float:
    """Silence after which the producer of the SYNC is gone."""
    return max(_SILENCE_S, _SILENT_PERIODS * period_s)


class SyncSource(Protocol):
    """Begins each cycle with a SYNC."""

    deadline_ns: int
    """When the next SYNC is due, by time.perf_counter_ns."""

    def next(self) -> int:
        """Wait for the next SYNC of the grid; when it was, by time.perf_counter_ns.

        Raises can.CanError.
        """
        ...


class ProducedSync:
    """Sends the SYNC, with the counter of 0x1019 where the drives want one.

    In real time its deadlines are a grid, k·T after the first: lateness does not add up, and a
    late cycle is not made up for by a burst of SYNCs. In simulated time the SYNCs follow one
    another. What has come before a SYNC goes to the network: a TPDO among it is late, or came
    twice. Taken for the next one, it would leave every position after it a cycle old.
    """

    def __init__(
        self, link: Link, cob_id: int, overflow: int, period_s: float, real_time: bool
    ) -> None:
        self._link = link
        self._overflow = overflow
        self._counter = 0
        self._period_ns = round(period_s * 1e9)
        self._real_time = real_time
        self._message = DataFrame(cob_id, bytes(1 if overflow else 0))
        self.deadline_ns = 0

    def next(self) -> int:
        """Wait until the SYNC is due, and send it."""
        if self._real_time:
            self._wait()
        else:
            self._serve_all()
        if self._overflow:
            # CiA 301, 7.2.5.3: from 1 to the overflow value, and again from 1.
            self._counter = self._counter % self._overflow + 1
            self._message.data[0] = self._counter
        now = time.perf_counter_ns()
        self._link.send(self._message)
        return now

    def _wait(self) -> None:
        now = time.perf_counter_ns()
        if self.deadline_ns == 0:
            self.deadline_ns = now
        asleep_ns = self.deadline_ns - now - SPIN_NS
        if asleep_ns > 0:
            time.sleep(asleep_ns * 1e-9)
        self._serve_all()
        while time.perf_counter_ns() < self.deadline_ns:
            pass
        behind = max(0, time.perf_counter_ns() - self.deadline_ns) // self._period_ns
        self.deadline_ns += (behind + 1) * self._period_ns

    def _serve_all(self) -> None:
        while self._link.serve(0.0):
            pass


class ExternalSync:
    """Follows the SYNC of another producer, whatever its period."""

    def __init__(self, link: Link, cob_id: int, period_s: float) -> None:
        self._link = link
        self._cob_ids = (cob_id,)
        self._period_ns = round(period_s * 1e9)
        self._patience_s = sync_patience_s(period_s)
        self.deadline_ns = 0

    def next(self) -> int:
        """Wait for the SYNC. Raises SyncLostError."""
        if self._link.wait_for(self._cob_ids, self._patience_s) is None:
            raise SyncLostError(self._patience_s)
        now = time.perf_counter_ns()
        self.deadline_ns = now + self._period_ns
        return now
