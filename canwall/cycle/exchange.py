"""The exchange of one cycle's frames over python-can, for any adapter that it supports."""

import time
from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from canwall.bus import DataFrame
from canwall.compiled import data_to_number, number_to_data
from canwall.cycle.axis import WallAxis
from canwall.cycle.beats import Beats
from canwall.cycle.step import step
from canwall.cycle.sync import ProducedSync, SyncSource
from canwall.cycle.timing import HISTOGRAM, observe_ns
from canwall.drive import Link
from canwall.record import Phase
from canwall.record.ring import put_row

#: In simulated time nothing is late: this long a TPDO is waited for before it counts as lost.
_SIMULATED_TIMEOUT_S = 1.0
#: Once one was missed, the next ones are waited for no longer than this.
_MISSING_TIMEOUT_S = 0.05
#: The part of a real cycle in which the TPDO has to arrive, for the RPDO to be in time.
_SYNCHRONOUS_WINDOW = 0.8
#: How full the ring of the record may be before simulated time waits for its writer.
BACKLOG = 0.5
#: A writer that takes nothing for this long is taken for gone; what is lost is counted.
_WRITER_PATIENCE_S = 10.0


class Exchange(ABC):
    """SYNC, TPDOs, steps, RPDOs: the cycle of all axes, in whatever way its frames are exchanged.

    In real time the SYNCs keep to absolute deadlines; in simulated time they follow one another
    as fast as the drives answer.
    """

    #: How it is called in a summary.
    name: str
    #: How many cycles it may do before the loop looks after everything else again.
    ahead = 1

    def __init__(self, link: Link, axes: Sequence[WallAxis], real_time: bool) -> None:
        self._link = link
        self.axes = axes
        self._real_time = real_time
        self._period_s = float(axes[0].cycle["period"][0])
        self._period_ns = round(self._period_s * 1e9)
        window_s = self._period_s * _SYNCHRONOUS_WINDOW
        self._timeout_s = window_s if real_time else _SIMULATED_TIMEOUT_S
        self._missing_timeout_s = min(self._timeout_s, _MISSING_TIMEOUT_S)
        #: Intervals of the SYNC, and how far each is from its period.
        self.sync_interval, self.sync_error = np.zeros(1, HISTOGRAM), np.zeros(1, HISTOGRAM)
        #: Whether simulated time waits for the writer of the record; False once it is gone.
        self.waits_for_writer = True
        for axis in axes:
            _warm_up(axis)

    @abstractmethod
    def cycle(self, most: int = 1) -> None:
        """One cycle; or, where there is nothing to be done in between, several, `most` at most.

        Raises can.CanError where the bus fails.
        """

    @property
    @abstractmethod
    def last_sync_ns(self) -> int:
        """When the latest SYNC was, by time.perf_counter_ns; 0: there was none yet."""

    def longest_pause_s(self) -> float:
        """The longest that the drives have been without a SYNC, from the latest to now as well."""
        since = time.perf_counter_ns() - self.last_sync_ns if self.last_sync_ns else 0
        return max(int(self.sync_interval["largest_ns"][0]), since) * 1e-9

    def close(self) -> None:  # noqa: B027 (only some have anything to give back)
        """Give back what the exchange has opened; the link stays open."""

    def _check_late(self, axis: WallAxis) -> None:
        """Give the wall up whose RPDOs have come too late for too many cycles."""
        most = axis.limits.late_cycles
        if most and axis.late_in_a_row >= most:
            axis.give_up(
                f"RPDOs after the next SYNC for {axis.late_in_a_row} cycles, limits.late_cycles = "
                f"{most}: the machine is too slow for bus.cycle_s"
            )

    def _record_is_behind(self) -> bool:
        return any(axis.ring.backlog() > BACKLOG for axis in self.axes)

    def _wait_for_writer(self) -> None:
        if not self._record_is_behind():
            return
        deadline = time.monotonic() + _WRITER_PATIENCE_S
        while self.waits_for_writer and self._record_is_behind():
            time.sleep(0.001)
            self.waits_for_writer = time.monotonic() < deadline


class PythonCanExchange(Exchange):
    """The exchange over python-can, for any adapter that it supports."""

    name = "python-can"

    def __init__(
        self,
        link: Link,
        axes: Sequence[WallAxis],
        real_time: bool,
        sync: SyncSource | None = None,
    ) -> None:
        """Without a `sync`, the master produces it as the first axis' drive wants it."""
        super().__init__(link, axes, real_time)
        setup = axes[0].setup
        self._sync = sync or ProducedSync(
            link, setup.sync_cob_id, setup.sync_counter_overflow, self._period_s, real_time
        )
        self._by_tpdo = {axis.setup.tpdo.cob_id: axis for axis in axes}
        self._rpdos = {
            id(axis): DataFrame(axis.setup.rpdo.cob_id, bytes(axis.setup.rpdo.length))
            for axis in axes
        }
        self._beats = Beats(link, (axis.setup.watchdog for axis in axes))
        self._last_sync_ns = 0
        #: Whether a message's time stamp is the kernel's, by the clock of time.time.
        self._stamped = type(link.bus).__module__.startswith("can.interfaces.socketcan")

    @property
    def last_sync_ns(self) -> int:
        """When the latest SYNC was, by time.perf_counter_ns; 0: there was none yet."""
        return self._last_sync_ns

    def cycle(self, most: int = 1) -> None:
        """One cycle. Raises can.CanError where the bus fails."""
        missing = any(axis.cycle["missed_in_a_row"][0] for axis in self.axes)
        if not self._real_time:
            self._wait_for_writer()
        interval_s = self._begin()
        awaited = self._by_tpdo.copy()
        timeout = self._missing_timeout_s if missing else self._timeout_s
        deadline = time.monotonic() + timeout
        while awaited:
            message = self._link.wait_for(awaited, timeout)
            received_ns = time.perf_counter_ns()
            if message is None:
                break
            if self._stamped:
                received_ns -= max(0, time.time_ns() - round(message.timestamp * 1e9))
            axis = awaited.pop(message.arbitration_id)
            # A TPDO that is too short does not carry what was mapped: as good as none.
            complete = len(message.data) >= axis.setup.tpdo.length
            if not complete:
                axis.wrong_length = len(message.data)
            data = data_to_number(message.data) if complete else 0
            self._answer(axis, data, complete, received_ns, interval_s)
            if awaited:
                timeout = max(0.0, deadline - time.monotonic())
        for axis in awaited.values():
            self._answer(axis, 0, False, time.perf_counter_ns(), interval_s)
        if self._beats:
            self._beats.send()

    def _begin(self) -> float:
        """The SYNC; seconds since the one before, 0 for the first."""
        sync_ns = self._sync.next()
        interval = sync_ns - self._last_sync_ns if self._last_sync_ns else 0
        if interval:
            observe_ns(self.sync_interval, interval)
            observe_ns(self.sync_error, abs(interval - self._period_ns))
        self._last_sync_ns = sync_ns
        return interval * 1e-9

    def _answer(
        self, axis: WallAxis, data: int, received: bool, received_ns: int, interval_s: float
    ) -> None:
        answer = step(axis.cycle, axis.row, data, received)
        rpdo = self._rpdos[id(axis)]
        answer |= axis.setup.rpdo.constant
        rpdo.data[:] = number_to_data(answer, axis.setup.rpdo.length)
        self._link.send(rpdo)
        sent_ns = time.perf_counter_ns()
        latency = sent_ns - received_ns
        observe_ns(axis.latency, latency)
        row = axis.row[0]
        row["sync_interval_s"] = interval_s
        row["latency_s"] = latency * 1e-9
        if self._real_time:
            observe_ns(axis.sync_to_rpdo, sent_ns - self._sync.deadline_ns + self._period_ns)
            late = sent_ns > self._sync.deadline_ns
            axis.late_rpdo += late
            axis.late_in_a_row = axis.late_in_a_row + 1 if late else 0
            self._check_late(axis)
        put_row(axis.ring.header, axis.ring.rows, axis.row)


def _warm_up(axis: WallAxis) -> None:
    # What is compiled is loaded at its first call, which takes longer than many a cycle.
    cycle, row = axis.cycle.copy(), axis.row.copy()
    for phase in Phase:
        cycle["phase"] = phase
        step(cycle, row, 0, True)
        step(cycle, row, 0, False)
    put_row(axis.ring.header.copy(), axis.ring.rows[:1].copy(), row)
    observe_ns(axis.latency.copy(), 0)
