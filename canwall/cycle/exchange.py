"""The exchange of one cycle's frames over python-can, for any adapter that it supports."""

import time
from typing import Any

import can
import numpy as np
from numpy.typing import NDArray

from canwall.compiled import data_to_number, number_to_data
from canwall.cycle.step import step
from canwall.cycle.timing import HISTOGRAM, observe_ns
from canwall.drive import DriveSetup, Link
from canwall.record import ROW, Phase, Ring
from canwall.record.ring import put_row

#: In simulated time nothing is late: this long a TPDO is waited for before it counts as lost.
_SIMULATED_TIMEOUT_S = 1.0
#: Once one was missed, the next ones are waited for no longer than this.
_MISSING_TIMEOUT_S = 0.05
#: The part of a real cycle in which the TPDO has to arrive, for the RPDO to be in time.
_SYNCHRONOUS_WINDOW = 0.8
#: How full the ring of the record may be before simulated time waits for its writer.
_BACKLOG = 0.5
#: A writer that takes nothing for this long is taken for gone; what is lost is counted.
_WRITER_PATIENCE_S = 10.0


class _CyclicFrame(can.Message):
    """A frame that is sent in every cycle, with other data.

    python-can's virtual bus copies each frame deeply, which by the general way of copy.deepcopy
    takes as long as all the rest of a cycle.
    """

    def __init__(self, can_id: int, length: int) -> None:
        super().__init__(arbitration_id=can_id, is_extended_id=False, data=bytes(length))

    def __deepcopy__(self, memo: dict[int, Any] | None) -> can.Message:
        return can.Message(
            timestamp=self.timestamp,
            arbitration_id=self.arbitration_id,
            is_extended_id=False,
            data=bytes(self.data),
        )


class PythonCanExchange:
    """SYNC, TPDO, step, RPDO: one cycle at a time.

    In real time the SYNCs keep to absolute deadlines; in simulated time they follow one another
    as fast as the drive answers.
    """

    def __init__(
        self,
        link: Link,
        setup: DriveSetup,
        cycle: NDArray[np.void],
        ring: Ring,
        real_time: bool,
    ) -> None:
        self._link = link
        self._cycle = cycle
        self._ring = ring
        self._real_time = real_time
        self._period_ns = round(float(cycle["period"][0]) * 1e9)
        timeout = self._period_ns * 1e-9 * _SYNCHRONOUS_WINDOW
        self._timeout_s = timeout if real_time else _SIMULATED_TIMEOUT_S
        self._tpdo_id = setup.tpdo.cob_id
        self._tpdo_length = setup.tpdo.length
        self._rpdo_length = setup.rpdo.length
        self._rpdo_constant = setup.rpdo.constant
        self._sync = _CyclicFrame(setup.sync_cob_id, 0)
        self._rpdo = _CyclicFrame(setup.rpdo.cob_id, setup.rpdo.length)
        self.row = np.zeros(1, ROW)
        self.sync_interval = np.zeros(1, HISTOGRAM)
        self.latency = np.zeros(1, HISTOGRAM)
        self.late_rpdo = 0
        self._deadline_ns = 0
        self._last_sync_ns = 0
        self._writer_reads = True
        self._warm_up()

    def _warm_up(self) -> None:
        # What is compiled is loaded at its first call, which takes longer than many a cycle.
        cycle, row = self._cycle.copy(), self.row.copy()
        for phase in Phase:
            cycle["phase"] = phase
            step(cycle, row, 0, True)
            step(cycle, row, 0, False)
        put_row(self._ring.header.copy(), self._ring.rows[:1].copy(), row)
        observe_ns(self.latency.copy(), 0)

    def cycle(self) -> None:
        """One cycle. Raises can.CanError where the bus fails."""
        sync_ns = self._wait_for_sync()
        if self._cycle["missed_in_a_row"][0]:
            self._drop_late()
        self._link.send(self._sync)
        message = self._receive()
        received_ns = time.perf_counter_ns()
        data = data_to_number(message.data) if message is not None else 0
        answer = step(self._cycle, self.row, data, message is not None)
        self._rpdo.data[:] = number_to_data(answer | self._rpdo_constant, self._rpdo_length)
        self._link.send(self._rpdo)
        self._note(sync_ns, received_ns, time.perf_counter_ns())

    def _drop_late(self) -> None:
        # The TPDO that was missed may have come since. Taken for the next one, it would leave
        # every position after it a cycle old.
        while self._link.serve(0.0):
            pass

    def _receive(self) -> can.Message | None:
        missing = bool(self._cycle["missed_in_a_row"][0])
        timeout = min(self._timeout_s, _MISSING_TIMEOUT_S) if missing else self._timeout_s
        message = self._link.wait_for(self._tpdo_id, timeout)
        # A TPDO that is too short does not carry what was mapped: as good as none.
        if message is not None and len(message.data) < self._tpdo_length:
            return None
        return message

    def _wait_for_sync(self) -> int:
        if self._real_time:
            now = time.perf_counter_ns()
            if self._deadline_ns == 0:
                self._deadline_ns = now
            if now < self._deadline_ns:
                time.sleep((self._deadline_ns - now) * 1e-9)
            # Deadlines are a grid: a late cycle is not made up for by a burst of SYNCs.
            behind = max(0, time.perf_counter_ns() - self._deadline_ns) // self._period_ns
            self._deadline_ns += (behind + 1) * self._period_ns
        elif self._ring.backlog() > _BACKLOG:
            self._wait_for_writer()
        return time.perf_counter_ns()

    def _wait_for_writer(self) -> None:
        deadline = time.monotonic() + _WRITER_PATIENCE_S
        while self._writer_reads and self._ring.backlog() > _BACKLOG:
            time.sleep(0.001)
            self._writer_reads = time.monotonic() < deadline

    def _note(self, sync_ns: int, received_ns: int, sent_ns: int) -> None:
        row = self.row[0]
        if self._last_sync_ns:
            interval = sync_ns - self._last_sync_ns
            observe_ns(self.sync_interval, interval)
            row["sync_interval_s"] = interval * 1e-9
        self._last_sync_ns = sync_ns
        latency = sent_ns - received_ns
        observe_ns(self.latency, latency)
        row["latency_s"] = latency * 1e-9
        if self._real_time and sent_ns > self._deadline_ns:
            self.late_rpdo += 1
        put_row(self._ring.header, self._ring.rows, self.row)
