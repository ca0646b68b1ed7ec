"""Exchange of a cycle's frames: the compiled core (`core`) on a transport, as the loop sees it.

In real time the SYNCs keep to absolute deadlines; in simulated time they follow one another as
fast as the drives answer.
"""

import itertools
import time
from collections.abc import Iterable, Iterator, Sequence

import can
import numpy as np
from numpy.typing import NDArray

from canwall.bus import DataFrame
from canwall.bus.can_ids import EMCY, ERROR_CONTROL, NMT, PDOS
from canwall.bus.raw_socket import CAN_RTR
from canwall.compiled import data_to_number, number_to_data
from canwall.cycle import core as cycle_core
from canwall.cycle.axis import WallAxis
from canwall.cycle.core import CORE, DRIVE_FRAMES, INBOX, Handling, Want
from canwall.cycle.python_can import PythonCanTransport
from canwall.cycle.step import step, step_address
from canwall.cycle.transport import CycleFrames, TransportFactory
from canwall.drive import Link, Watchdog
from canwall.drive.watchdog import ErrorControlFrame
from canwall.record import Phase
from canwall.record.histogram import HISTOGRAM, percentile_ns
from canwall.record.ring import FRAME, HEADER, RECEIVED, Ring, to_message

#: Time after which a TPDO counts as lost in simulated time, where nothing is late.
_SIMULATED_TIMEOUT_S = 1.0
#: The same once a TPDO has been lost.
_MISSING_TIMEOUT_S = 0.05
#: Part of a cycle in real time within which the TPDO has to arrive for the RPDO to be in time.
_SYNCHRONOUS_WINDOW = 0.8
#: Time without progress after which the writer counts as dead; lost items are counted.
_WRITER_PATIENCE_S = 10.0
#: Part of the period by which the median interval of SYNCs may be off, half of it by its bucket.
_OFF_PERIOD = 1.0 / 16.0
#: Time without a SYNC, and the least number of periods, after which its producer counts as silent.
_SYNC_PATIENCE_S, _SYNC_PATIENCE_CYCLES = 0.1, 10


class SyncLostError(can.CanOperationError):
    """The producer of the SYNC has fallen silent."""

    def __init__(self, patience_s: float) -> None:
        super().__init__(f"no SYNC from its producer for {patience_s:g} s")


class ExchangeRetiredError(Exception):
    """A call that was given up has come back, and ends."""


class _FrameRing:
    """Frames that compiled code hands to Python."""

    def __init__(self) -> None:
        self.header, self.frames = np.zeros(1, HEADER), np.zeros(INBOX, FRAME)

    def take(self) -> Iterator[NDArray[np.void]]:
        """Yield the waiting frames, the oldest first."""
        header = self.header
        while header["frame_tail"][0] < header["frame_head"][0]:
            frame = self.frames[header["frame_tail"][0] % len(self.frames)].copy()
            header["frame_tail"] += 1
            yield frame


class Exchange:
    """SYNC, TPDOs, steps and RPDOs of all axes, cycle by cycle."""

    def __init__(
        self,
        link: Link,
        axes: Sequence[WallAxis],
        real_time: bool,
        external_sync: bool = False,
        transport: TransportFactory = PythonCanTransport,
    ) -> None:
        """Prepare the cycles of axes that share the SYNC of the first one's drive.

        Args:
            link: The bus.
            axes: Drives that are set up, and their walls.
            real_time: True if SYNCs follow the clock.
            external_sync: True if another node produces the SYNC.
            transport: Makes the transport of the frames.

        Raises:
            can.CanInitializationError: If the transport cannot work on this bus.
        """
        self.link = link
        self.axes = axes
        self._real_time = real_time
        self._period_s = float(axes[0].cycle["period"][0])
        #: Cycles that may be done before the loop attends to everything else again.
        self.ahead = 1
        #: Intervals of the SYNC, and their deviations from the period.
        self.sync_interval, self.sync_error = np.zeros(1, HISTOGRAM), np.zeros(1, HISTOGRAM)
        #: True while simulated time waits for the writer of the record; False once that has died.
        self.waits_for_writer = True
        self._inbox, self._unlogged = _FrameRing(), _FrameRing()
        self._error_control = _error_control_frames(axis.setup.watchdog for axis in axes)
        self._drives = np.zeros(len(axes), DRIVE_FRAMES)
        for k, axis in enumerate(axes):
            axis.frames = self._drives[k : k + 1]
            _lay_out(axis)
        self._handling = _handling(axes)
        self._subscribed = -1
        self._core = self._make_core(external_sync)
        setup = axes[0].setup
        self.transport = transport(
            link,
            self._core,
            CycleFrames(
                (*self._drives["tpdo_id"].tolist(), *np.flatnonzero(self._handling).tolist()),
                (
                    setup.sync_cob_id,
                    *self._drives["rpdo_id"].tolist(),
                    *self._error_control["can_id"].tolist(),
                ),
                real_time,
                self._period_s,
            ),
        )
        # Compiled code is loaded at its first call.
        cycle_core.begin(self._core, 0, 0)
        self.transport.run()

    def _make_core(self, external_sync: bool) -> NDArray[np.void]:
        core, setup = np.zeros(1, CORE), self.axes[0].setup
        window_s = self._period_s * _SYNCHRONOUS_WINDOW
        timeout_s = window_s if self._real_time else _SIMULATED_TIMEOUT_S
        core["real_time"], core["external_sync"] = self._real_time, external_sync
        core["sync_id"], core["sync_overflow"] = setup.sync_cob_id, setup.sync_counter_overflow
        core["period_ns"] = _ns(self._period_s)
        core["sync_patience_ns"] = _ns(self._sync_patience_s)
        core["timeout_ns"] = _ns(timeout_s)
        core["missing_timeout_ns"] = _ns(min(timeout_s, _MISSING_TIMEOUT_S))
        core["sync_interval"] = self.sync_interval.ctypes.data
        core["sync_error"] = self.sync_error.ctypes.data
        core["drives"], core["drives_length"] = self._drives.ctypes.data, len(self._drives)
        core["error_control"] = self._error_control.ctypes.data
        core["error_control_length"] = len(self._error_control)
        core["inbox_header"] = self._inbox.header.ctypes.data
        core["inbox"] = self._inbox.frames.ctypes.data
        return core

    @property
    def name(self) -> str:
        """Name of the transport in a summary."""
        return self.transport.name

    @property
    def deadline_ns(self) -> int:
        """Instant at which the next SYNC is due, by time.perf_counter_ns."""
        return int(self._core["deadline_ns"][0])

    @property
    def last_sync_ns(self) -> int:
        """Instant of the latest SYNC, by time.perf_counter_ns, or 0 before the first."""
        return int(self._core["sync_ns"][0])

    @property
    def last_error_control_ns(self) -> int:
        """Instant of the latest heartbeat or guarding frame, or 0 before the first."""
        frames = self._error_control
        sent = [int(f["due_ns"] - f["period_ns"]) for f in frames if f["due_ns"]]
        return max(sent, default=0)

    @property
    def _sync_patience_s(self) -> float:
        return max(_SYNC_PATIENCE_S, _SYNC_PATIENCE_CYCLES * self._period_s)

    def longest_pause_s(self) -> float:
        """Return the longest time that the drives were without a SYNC, up to now."""
        since = time.perf_counter_ns() - self.last_sync_ns if self.last_sync_ns else 0
        return max(int(self.sync_interval["largest_ns"][0]), since) * 1e-9

    def cycle(self, most: int = 1) -> None:
        """Do one cycle, or up to `most` if Python has nothing to do in between.

        Raises:
            can.CanError: If the bus fails.
        """
        core = self._core
        self.check_in_force()
        core["writer_reads"] = self.waits_for_writer
        for axis in self.axes:
            axis.frames["late_limit"] = axis.limits.late_cycles
        self._choose_log()
        self._choose_handling()
        cycle_core.begin(core, most, time.time_ns() - time.perf_counter_ns())
        try:
            while (want := self.transport.run()) != Want.DONE:
                self._serve_python(want)
        except BaseException:
            cycle_core.abandon(core)
            raise
        finally:
            if not core["retired"][0]:
                self._serve_frames()
        self.check_in_force()
        for axis in self.axes:
            _check_late(axis)
        self.transport.finish_cycle()

    @property
    def other_period_s(self) -> float | None:
        """Period of another producer's SYNC that is not that of the walls [s]; None: it is."""
        if not (self._core["external_sync"][0] and self._real_time):
            return None
        found_s = percentile_ns(self.sync_interval, 50.0) * 1e-9
        off = found_s and abs(found_s / self._period_s - 1.0) > _OFF_PERIOD
        return found_s if off else None

    def warm_up(self) -> None:
        """Have the laws loaded, which happens at their first call and may take longer than a cycle.

        They are called by address, so loading the core does not load them.
        """
        for axis in self.axes:
            cycle, row = axis.cycle.copy(), axis.row.copy()
            for phase in Phase:
                axis.cycle["phase"] = phase
                step(axis.cycle, axis.row, 0, True)
                step(axis.cycle, axis.row, 0, False)
            axis.cycle[:], axis.row[:] = cycle, row

    @property
    def progress(self) -> tuple[int, ...]:
        """A value that changes as long as a call of `cycle` gets on, and frames come and go."""
        at = [(int(a.cycle["j"][0]), int(a.cycle["evaluated"][0])) for a in self.axes]
        return (self.link.turns, *itertools.chain(*at))

    def attend(self) -> None:
        """Return from `cycle` after each single one from now on; another thread may call this."""
        self._core["single"] = True

    def retire(self) -> None:
        """Send no more frames, although a call of `cycle` may still come back."""
        self._core["retired"] = True

    def check_in_force(self) -> None:
        """Raise ExchangeRetiredError once this exchange is retired."""
        if self._core["retired"][0]:
            raise ExchangeRetiredError

    def send_zero(self, link: Link) -> None:
        """Send RPDOs that disable the drives, without torque, each with its SYNC.

        They go over another link, without the cycle. Raises can.CanError.
        """
        core = self._core[0]
        for axis in self.axes:
            rpdo = axis.setup.rpdo
            link.send(DataFrame(rpdo.cob_id, number_to_data(rpdo.constant, rpdo.length)))
        if not core["external_sync"]:
            overflow = int(core["sync_overflow"])
            if overflow:
                core["sync_counter"] = core["sync_counter"] % overflow + 1
            link.send(
                DataFrame(int(core["sync_id"]), bytes([core["sync_counter"]] * bool(overflow)))
            )

    def close(self) -> None:
        """Release the resources of the transport; the link stays open."""
        if not self._core["retired"][0]:  # or else what comes back uses a descriptor of others
            self.transport.close()

    def _serve_python(self, want: Want) -> None:
        if want == Want.HAND_OVER:
            self._serve_frames()
        elif want == Want.WRITER:
            self._wait_for_writer()
            self._core["writer_reads"] = self.waits_for_writer
        else:
            raise SyncLostError(self._sync_patience_s)

    def _serve_frames(self) -> None:
        """Log the frames that compiled code could not log, and dispatch those in the inbox."""
        log = self.link.log
        if log is not None:
            for frame in self._unlogged.take():
                received = bool(frame["flags"] & RECEIVED)
                log(float(frame["time_s"]), to_message(frame, ""), received)
        for frame in self._inbox.take():
            self.link.dispatch(to_message(frame, ""))

    def _choose_log(self) -> None:
        """Log frames where the link logs its own, directly into a ring or by `_serve_frames`."""
        core, log = self._core, self.link.log
        owner = getattr(log, "__self__", None)
        ring = owner if isinstance(owner, Ring) else self._unlogged
        core["log_header"] = 0 if log is None else ring.header.ctypes.data
        core["log"], core["log_length"] = ring.frames.ctypes.data, len(ring.frames)

    def _choose_handling(self) -> None:
        """Only log those PDOs to which nothing in Python has subscribed."""
        subscribed = self.link.network.subscribers
        if len(subscribed) != self._subscribed:
            self._subscribed = len(subscribed)
            handling = self._handling.copy()
            for can_id in PDOS:
                if not subscribed.get(can_id):
                    handling[can_id] = Handling.LOG_ONLY
            self._core["handling"] = handling

    def _wait_for_writer(self) -> None:
        deadline = time.monotonic() + _WRITER_PATIENCE_S
        while self.waits_for_writer and self._record_is_behind():
            time.sleep(0.001)
            self.link.turns += 1
            self.waits_for_writer = time.monotonic() < deadline

    def _record_is_behind(self) -> bool:
        return any(axis.ring.backlog() > cycle_core.BACKLOG for axis in self.axes)


def _check_late(axis: WallAxis) -> None:
    """Give up a wall whose RPDOs have been late for too many cycles."""
    most = axis.limits.late_cycles
    if most and axis.late_in_a_row >= most:
        axis.give_up(
            f"RPDOs after the next SYNC for {axis.late_in_a_row} cycles, limits.late_cycles = "
            f"{most}: the machine is too slow for bus.cycle_s"
        )


def _lay_out(axis: WallAxis) -> None:
    """Fill the frames of an axis."""
    drive, tpdo, rpdo = axis.frames, axis.setup.tpdo, axis.setup.rpdo
    drive["tpdo_id"], drive["tpdo_length"] = tpdo.cob_id, tpdo.length
    drive["rpdo_id"], drive["rpdo_length"] = rpdo.cob_id, rpdo.length
    drive["constant"], drive["wrong_length"] = rpdo.constant, -1
    drive["step"] = step_address()
    for name, array in (
        ("cycle", axis.cycle),
        ("row", axis.row),
        ("latency", axis.latency),
        ("sync_to_rpdo", axis.sync_to_rpdo),
        ("header", axis.ring.header),
        ("rows", axis.ring.rows),
    ):
        drive[name] = array.ctypes.data


def _handling(axes: Sequence[WallAxis]) -> NDArray[np.uint8]:
    """Return the handling of frames by CAN-ID; those that may end a wall are urgent."""
    handling = np.zeros(0x800, np.uint8)
    handling[[NMT, axes[0].setup.sync_cob_id]] = Handling.URGENT
    for axis in axes:
        handling[axis.setup.rpdo.cob_id] = Handling.URGENT
        handling[EMCY + axis.node.node_id] = Handling.URGENT
        handling[ERROR_CONTROL + axis.node.node_id] = Handling.URGENT_UNLESS_OPERATIONAL
    return handling


def error_control_periods_ns(watchdogs: Iterable[Watchdog]) -> dict[ErrorControlFrame, int]:
    """Return the frames that these watchdogs expect, and the period of each [ns].

    Drives that consume the same heartbeat get it with the shortest of their periods.
    """
    periods: dict[ErrorControlFrame, float] = {}
    for watchdog in watchdogs:
        frame = watchdog.error_control
        if frame is not None:
            periods[frame] = min(watchdog.period_s, periods.get(frame, watchdog.period_s))
    return {frame: _ns(period) for frame, period in periods.items()}


def _error_control_frames(watchdogs: Iterable[Watchdog]) -> NDArray[np.void]:
    periods = error_control_periods_ns(watchdogs)
    records = np.zeros(len(periods), cycle_core.ERROR_CONTROL)
    for record, (frame, period_ns) in zip(records, periods.items(), strict=True):
        record["can_id"] = frame.can_id | (CAN_RTR if frame.remote else 0)
        record["length"], record["data"] = len(frame.data), data_to_number(frame.data)
        record["period_ns"] = period_ns
    return records


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
