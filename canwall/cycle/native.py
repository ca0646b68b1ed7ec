"""The exchange in compiled code, as the loop sees it (`native_cycle` is the compiled code)."""

from collections.abc import Iterator, Mapping, Sequence

import can
import numpy as np
from numpy.typing import NDArray

from canwall.bus import CycleSocket, bus_error
from canwall.bus.can_ids import EMCY, ERROR_CONTROL, PDOS
from canwall.bus.raw_socket import CFunction, place_port
from canwall.compiled import data_to_number
from canwall.cycle.axis import WallAxis
from canwall.cycle.beats import periods_ns
from canwall.cycle.exchange import Exchange
from canwall.cycle.native_cycle import (
    AT_ONCE,
    AXIS,
    BEAT,
    CAN_RTR,
    EXCHANGE,
    INBOX,
    UNLESS_OPERATIONAL,
    UNSEEN,
    Result,
    begin,
    run,
)
from canwall.cycle.sync import SyncLostError, sync_patience_s
from canwall.drive import Link
from canwall.drive.watchdog import ErrorControlFrame
from canwall.record.ring import FRAME, HEADER, RECEIVED, Ring, to_message

#: A drive that answers within this time after a SYNC is awaited awake.
LOOK_NS = 30_000

#: A full transmit buffer is waited for no longer than this in simulated time, and so much of a
#: cycle in real time.
_SEND_PATIENCE_S, _SEND_SHARE = 1.0, 0.2


class _FrameRing:
    """Frames that compiled code has put down, in this process."""

    def __init__(self, length: int) -> None:
        self.header, self.frames = np.zeros(1, HEADER), np.zeros(length, FRAME)

    def take(self) -> Iterator[NDArray[np.void]]:
        """Each frame that waits, oldest first."""
        while self.header["frame_tail"][0] < self.header["frame_head"][0]:
            frame = self.frames[self.header["frame_tail"][0] % len(self.frames)].copy()
            self.header["frame_tail"] += 1
            yield frame


class NativeExchange(Exchange):
    """The exchange in compiled code, over SocketCAN or a socket that carries such frames."""

    name = "native"

    def __init__(
        self, link: Link, axes: Sequence[WallAxis], real_time: bool, external_sync: bool = False
    ) -> None:
        """With `external_sync` somebody else produces the SYNC.

        Raises can.CanInitializationError for a bus that it cannot work on.
        """
        super().__init__(link, axes, real_time)
        setup = axes[0].setup
        beats = periods_ns(axis.setup.watchdog for axis in axes)
        treatment = np.zeros(0x800, np.uint8)
        treatment[setup.sync_cob_id] = AT_ONCE
        for axis in axes:
            treatment[EMCY + axis.node.node_id] = AT_ONCE
            treatment[ERROR_CONTROL + axis.node.node_id] = UNLESS_OPERATIONAL
        tpdos = [axis.setup.tpdo.cob_id for axis in axes]
        rpdos = [axis.setup.rpdo.cob_id for axis in axes]
        self._socket = CycleSocket(
            link.bus,
            received=[*tpdos, *np.flatnonzero(treatment).tolist()],
            sent=[setup.sync_cob_id, *rpdos, *(beat.can_id for beat in beats)],
            stamps=real_time,
        )
        self._inbox = _FrameRing(INBOX)
        self._unseen = _FrameRing(INBOX)
        self._frames = _axis_records(axes)
        self._beats = _beat_records(beats)
        self._exchange = exchange = np.zeros(1, EXCHANGE)
        place_port(exchange["port"][0])
        exchange["descriptor"] = self._socket.descriptor
        exchange["stamped"] = self._socket.stamped
        patience_s = _SEND_SHARE * self._period_s if real_time else _SEND_PATIENCE_S
        exchange["send_patience_ns"] = _ns(patience_s)
        exchange["real_time"], exchange["external"] = real_time, external_sync
        exchange["sync_id"] = setup.sync_cob_id
        exchange["sync_overflow"] = setup.sync_counter_overflow
        exchange["sync_patience_ns"] = _ns(sync_patience_s(self._period_s))
        exchange["period_ns"] = self._period_ns
        exchange["sync_interval"] = self.sync_interval.ctypes.data
        exchange["sync_error"] = self.sync_error.ctypes.data
        exchange["timeout_ns"] = _ns(self._timeout_s)
        exchange["look_ns"] = LOOK_NS
        exchange["missing_timeout_ns"] = _ns(self._missing_timeout_s)
        exchange["axes"], exchange["axes_length"] = self._frames.ctypes.data, len(axes)
        exchange["beats"], exchange["beats_length"] = self._beats.ctypes.data, len(beats)
        self._treatment = treatment
        self._subscribed = -1
        exchange["inbox_header"] = self._inbox.header.ctypes.data
        exchange["inbox"] = self._inbox.frames.ctypes.data
        # What is compiled is loaded at its first call.
        begin(exchange, 0)
        run(exchange)

    @property
    def deadline_ns(self) -> int:
        """When the next SYNC is due, by time.perf_counter_ns."""
        return int(self._exchange["deadline_ns"][0])

    @property
    def last_sync_ns(self) -> int:
        """When the latest SYNC was, by time.perf_counter_ns; 0: there was none yet."""
        return int(self._exchange["last_sync_ns"][0])

    @property
    def look_ns(self) -> int:
        """How long after a SYNC the TPDOs are looked for awake, before the wait is a sleep [ns]."""
        return int(self._exchange["look_ns"][0])

    @look_ns.setter
    def look_ns(self, look_ns: int) -> None:
        self._exchange["look_ns"] = look_ns

    @property
    def descriptor(self) -> int:
        """What the frames of the cycle go through."""
        return int(self._exchange["descriptor"][0])

    @descriptor.setter
    def descriptor(self, descriptor: int) -> None:
        self._exchange["descriptor"] = descriptor

    def cycle(self, most: int = 1) -> None:
        """One cycle or up to `most`. Raises can.CanError where the bus fails."""
        exchange = self._exchange
        exchange["writer_reads"] = self.waits_for_writer
        for axis, frames in zip(self.axes, self._frames, strict=True):
            frames["late_limit"] = axis.limits.late_cycles or 0
        self._settle_log()
        self._settle_idle()
        self._settle_treatment()
        begin(exchange, most)
        while True:
            result = run(exchange)
            self._see_frames()
            if result == Result.DONE:
                break
            if result == Result.IDLE:
                assert self._link.idle is not None
                self._link.idle()
            elif result == Result.RECORD_BEHIND:
                self._wait_for_writer()
                exchange["writer_reads"] = self.waits_for_writer
            elif result != Result.SEEN_FIRST:
                self._give_up(result)
        self._tell_axes()
        if self._socket.own:
            while self._link.serve(0.0):
                pass

    def _tell_axes(self) -> None:
        for axis, frames in zip(self.axes, self._frames, strict=True):
            axis.late_rpdo = int(frames["late_rpdo"])
            axis.late_in_a_row = int(frames["late_in_a_row"])
            if frames["wrong_length"] >= 0:
                axis.wrong_length = int(frames["wrong_length"])
            self._check_late(axis)

    def _settle_log(self) -> None:
        """Log frames where the link does: into a ring directly, else for `_see_frames`."""
        exchange, log = self._exchange, self._link.log
        owner = getattr(log, "__self__", None)
        ring = owner if isinstance(owner, Ring) else self._unseen
        self._logs_to = ring
        exchange["log_header"] = 0 if log is None else ring.header.ctypes.data
        exchange["log"], exchange["log_length"] = ring.frames.ctypes.data, len(ring.frames)

    def _settle_idle(self) -> None:
        link, exchange = self._link, self._exchange
        exchange["idle"] = link.idle is not None
        function = link.compiled_idle or CFunction(0, 0)
        exchange["idle_function"], exchange["idle_state"] = function

    def _settle_treatment(self) -> None:
        """PDOs that nobody in Python has subscribed to end in the log."""
        subscribed = self._link.network.subscribers
        if len(subscribed) != self._subscribed:
            self._subscribed = len(subscribed)
            treatment = self._treatment.copy()
            for can_id in PDOS:
                if not subscribed.get(can_id):
                    treatment[can_id] = UNSEEN
            self._exchange["treatment"] = treatment

    def _see_frames(self) -> None:
        log = self._link.log
        if log is not None:
            for frame in self._unseen.take():
                received = bool(frame["flags"] & RECEIVED)
                log(float(frame["time_s"]), to_message(frame, ""), received)
        for frame in self._inbox.take():
            self._link.dispatch(to_message(frame, ""))

    def _give_up(self, result: int) -> None:
        if result == Result.NO_SYNC:
            raise SyncLostError(sync_patience_s(self._period_s))
        if result == Result.GONE:
            if self._socket.renew():
                self.descriptor = self._socket.descriptor
            raise can.CanOperationError("the other side of the bus has gone")
        number = int(self._exchange["port"]["errno"][0, 0])
        raise bus_error(number, self._link.bus)

    def close(self) -> None:
        """Close the socket of the cycle, where it has one of its own."""
        self._socket.close()


def _axis_records(axes: Sequence[WallAxis]) -> NDArray[np.void]:
    records = np.zeros(len(axes), AXIS)
    for record, axis in zip(records, axes, strict=True):
        tpdo, rpdo = axis.setup.tpdo, axis.setup.rpdo
        record["tpdo_id"], record["tpdo_length"] = tpdo.cob_id, tpdo.length
        record["rpdo_id"], record["rpdo_length"] = rpdo.cob_id, rpdo.length
        record["constant"], record["wrong_length"] = rpdo.constant, -1
        for name, array in (
            ("cycle", axis.cycle),
            ("row", axis.row),
            ("latency", axis.latency),
            ("sync_to_rpdo", axis.sync_to_rpdo),
            ("header", axis.ring.header),
            ("rows", axis.ring.rows),
        ):
            record[name] = array.ctypes.data
    return records


def _beat_records(beats: Mapping[ErrorControlFrame, int]) -> NDArray[np.void]:
    records = np.zeros(len(beats), BEAT)
    for record, (beat, period_ns) in zip(records, beats.items(), strict=True):
        record["can_id"] = beat.can_id | (CAN_RTR if beat.remote else 0)
        record["length"], record["data"] = len(beat.data), data_to_number(beat.data)
        record["period_ns"] = period_ns
    return records


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
