"""Lends the state of a simulated drive to compiled code, and takes it back (`cyclic`).

The one place that knows of the drive's parts what `cyclic` does in their stead. What is not
covered there is never lent: faults, delays, switches, ramps, other transmission types.
"""

import time
from typing import cast

import can
import numpy as np
from numpy.typing import NDArray

from canwall.bus.raw_socket import place_port
from canwall.bus.socket_pair import SocketPairBus
from canwall.compiled import data_to_number, number_to_data
from canwall.simdrive.communication.nmt import NmtState
from canwall.simdrive.communication.rpdo import Rpdo
from canwall.simdrive.communication.tpdo import Tpdo
from canwall.simdrive.cyclic import CYCLIC, MAX_FIELDS, MAX_TPDOS, VALUES, serving
from canwall.simdrive.drive import SimulatedDrive
from canwall.simdrive.faults import FaultyDrive, FaultyEncoder
from canwall.simdrive.mechanics.motion import ServoMotion
from canwall.simdrive.profile.state_machine import PdsState
from canwall.simdrive.runner import BusRunner

#: The drive's own timers are looked after this often [s].
_TIMERS_S = 0.01
_CONTROLWORD, _TARGET = 0x6040, 0x6071
#: What a PDO on events may carry: nothing that changes while the state is lent.
_CONSTANT = (0x6041, 0x6061)


class CompiledRunner(BusRunner):
    """A runner whose drive answers in compiled code while it may, at the other end of a pair."""

    def __init__(self, drive: FaultyDrive, bus: SocketPairBus) -> None:
        """Switch the drive on, as BusRunner does."""
        super().__init__(drive, bus)
        self._faulty = drive
        self._record = record = np.zeros(1, CYCLIC)
        place_port(record["port"][0])
        record["descriptor"] = bus.fileno()
        #: What compiled code calls instead of `poll`.
        self.compiled = serving(record)

    def poll(self) -> None:
        """Handle every frame that is waiting, without blocking, and the timers."""
        record = self._record
        if record["lent"][0]:
            now_s = self._clock()
            give_back(self._faulty, record, now_s - self._last_tick_s)
            self._last_tick_s = now_s
            if record["left"][0]:
                record["left"] = False
                self._handle(_message(record))
        super().poll()
        if lend(self._faulty, record):
            record["due_ns"] = time.perf_counter_ns() + round(_TIMERS_S * 1e9)


def _message(record: NDArray[np.void]) -> can.Message:
    length, data = int(record["left_length"][0]), int(record["left_data"][0])
    can_id = int(record["left_id"][0])
    return can.Message(
        arbitration_id=can_id & 0x1FFFFFFF,
        is_extended_id=bool(can_id >> 31),
        is_remote_frame=bool(can_id >> 30 & 1),
        is_error_frame=bool(can_id >> 29 & 1),
        dlc=length,
        data=None if can_id >> 30 & 1 else number_to_data(data, length),
    )


def lend(faulty: FaultyDrive, record: NDArray[np.void]) -> bool:
    """Fill a CYCLIC record of shape (1,), if nothing is going on that it does not cover."""
    drive = faulty.drive
    rpdos = drive._sync_rpdos
    if not (_in_operation(drive) and _undisturbed(faulty) and len(rpdos) == 1):
        return False
    tpdos = [_lay_out(tpdo) for tpdo in drive._sync_tpdos]
    fields = [(entry.index, entry.subindex, entry.size) for entry in rpdos[0]._entries]
    known = sorted(fields) == [(_CONTROLWORD, 0, 2), (_TARGET, 0, 2)]
    quiet = all(_is_quiet(tpdo) for tpdo in drive._event_tpdos)
    if not (known and quiet and len(tpdos) <= MAX_TPDOS and None not in tpdos):
        return False
    # Only its end says that it is lent, so that a half that fails would not be used.
    _fill_frames(drive, record, rpdos[0], [tpdo for tpdo in tpdos if tpdo is not None])
    _fill_torque(drive, record)
    _fill_motion(drive, record)
    record["lent"] = True
    return True


def _in_operation(drive: SimulatedDrive) -> bool:
    axis, machine = drive._pds, drive._pds.state_machine
    return (
        drive._nmt.state is NmtState.OPERATIONAL
        and machine.state is PdsState.OPERATION_ENABLED
        and machine.ramp is None
        and machine._following is None
        and axis._follows_target
        and axis._obeyed == axis._controlword.value
    )


def _undisturbed(faulty: FaultyDrive) -> bool:
    drive, encoder = faulty.drive, faulty._encoder
    motion = encoder._motion
    return (
        faulty._idle
        and isinstance(motion, ServoMotion)
        and encoder.counts == motion.counts
        and encoder.speed_counts_per_s == motion.speed_counts_per_s
        and not motion._share_s
        and not drive.real_time
        and drive.syncs > 0
        and drive._passed_s == 0.0
        and not drive._emcy.present
        and not drive._outbox
        and drive._clock.now_ns >= drive._silent_until_ns
        and not drive._actuator.delayed
        and drive._actuator._part == 1.0
        and drive._sync._length == 0
        and not drive._pds._inputs.wired
        and not drive._pds._inputs.closed
    )


def _lay_out(tpdo: Tpdo) -> list[tuple[int, int, int]] | None:
    """(place in VALUES, shift, bits) of what a TPDO carries; None: it is one of another kind."""
    if tpdo._divider != 1 or tpdo._awaited or len(tpdo._entries) > MAX_FIELDS:
        return None
    fields, shift = [], 0
    for entry in tpdo._entries:
        if entry.subindex or entry.index not in VALUES or entry.size is None:
            return None
        fields.append((VALUES.index(entry.index), shift, 8 * entry.size))
        shift += 8 * entry.size
    return fields


def _is_quiet(tpdo: Tpdo) -> bool:
    """Whether a PDO on events has nothing to send while the state is lent."""
    constant = all(entry.index in _CONSTANT for entry in tpdo._entries)
    return constant and not tpdo._event_ns and tpdo._sent == tpdo._payload()


def _fill_frames(
    drive: SimulatedDrive,
    record: NDArray[np.void],
    rpdo: Rpdo,
    tpdos: list[list[tuple[int, int, int]]],
) -> None:
    axis = drive._pds
    record["sync_id"] = drive._sync.can_id
    record["rpdo_id"], record["rpdo_length"] = rpdo.can_id, rpdo._struct.size
    torque_first = rpdo._entries[0].index == _TARGET
    record["controlword_shift"] = 16 if torque_first else 0
    record["torque_shift"] = 0 if torque_first else 16
    record["pending"], record["received"] = rpdo._pending is not None, False
    record["pending_data"] = data_to_number(rpdo._pending or b"")
    record["tpdo_count"] = len(tpdos)
    for k, (tpdo, fields) in enumerate(zip(drive._sync_tpdos, tpdos, strict=True)):
        row = record["tpdos"][0, k]
        row["can_id"], row["length"], row["count"] = tpdo.can_id, tpdo._struct.size, len(fields)
        for n, field in enumerate(fields):
            row["fields"][n] = field
    torque, feedback = axis._torque, axis._feedback
    for place, entry in enumerate(
        (
            axis._statusword,
            feedback._position,
            feedback._velocity,
            torque._demand,
            torque._actual,
            torque._current,
            axis._target_torque,
            axis._controlword,
            axis._mode_display,
        )
    ):
        record["values"][0, place] = entry.value
    record["syncs"] = drive.syncs


def _fill_torque(drive: SimulatedDrive, record: NDArray[np.void]) -> None:
    torque = drive._pds._torque
    limit = min(torque._max_torque.value, torque._max_current.value, torque._peak)
    record["highest"] = min(limit, torque._positive_limit.value)
    record["lowest"] = -min(limit, torque._negative_limit.value)
    record["nm_per_mille"] = torque._nm_per_mille
    record["held"], record["limited"] = torque._held, torque.limited
    overload = torque.overload
    record["peak"], record["budget"], record["used"] = (
        overload.peak,
        overload._budget,
        overload._used,
    )
    record["warning"] = overload.warning
    record["direct"] = drive._actuator.direct


def _fill_motion(drive: SimulatedDrive, record: NDArray[np.void]) -> None:
    motion = _motion(drive)
    constant, slope = motion._script
    record["servo"] = motion._servo.ctypes.data
    record["push"], record["slope"] = constant.ctypes.data, slope.ctypes.data
    record["piece"], record["piece_length"] = motion._elapsed - motion._first, len(constant)
    record["period"], record["smoothing"] = motion._period_s, motion._smoothing
    record["counts"], record["speed"] = motion._counts, motion._speed_counts_per_s
    feedback = drive._pds._feedback
    record["position_sign"], record["position_shift"] = feedback._position_sign, feedback._shift
    record["position_scale"] = feedback._position_unit.per_increment
    record["speed_scale"] = feedback._units_per_count


def _motion(drive: SimulatedDrive) -> ServoMotion:
    return cast(ServoMotion, cast(FaultyEncoder, drive._motion)._motion)


def give_back(faulty: FaultyDrive, record: NDArray[np.void], passed_s: float) -> None:
    """Let the drive go on from where compiled code has come to, `passed_s` of clock time later."""
    drive = faulty.drive
    lent = record[0]
    record["lent"] = False
    drive._clock.advance(passed_s)
    faulty._elapsed += passed_s / drive.sync_period_s
    axis, rpdo = drive._pds, drive._sync_rpdos[0]
    values = [int(value) for value in lent["values"]]
    torque, feedback = axis._torque, axis._feedback
    (
        _,
        feedback._position.value,
        feedback._velocity.value,
        torque._demand.value,
        torque._actual.value,
        torque._current.value,
        axis._target_torque.value,
        _,
        _,
    ) = values
    torque._held, torque.overload._used = int(lent["held"]), float(lent["used"])
    motion = _motion(drive)
    motion._elapsed = motion._first + int(lent["piece"])
    motion._counts = motion._counts_before = feedback.counts = int(lent["counts"])
    motion._speed_counts_per_s = float(lent["speed"])
    rpdo._pending = None
    if lent["pending"]:
        rpdo._pending = number_to_data(int(lent["pending_data"]), rpdo._struct.size)
    # The timers that these frames restart: they came meanwhile, the last of them just now.
    now_ns = drive._clock.now_ns
    if lent["received"] and rpdo._time_ns:
        rpdo._deadline_ns = now_ns + rpdo._time_ns
    if int(lent["syncs"]) > drive.syncs:
        drive.syncs = int(lent["syncs"])
        drive._without_sync_s = 0.0
        sync = drive._sync
        if sync._period_ns:
            sync._deadline_ns = now_ns + sync._period_ns * 3 // 2
        if sync._window_ns:
            sync._window_end_ns = now_ns + sync._window_ns
