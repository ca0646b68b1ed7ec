"""The simulated drive's part in a cycle, compiled from frame to frame.

While a drive is in operation in cyclic synchronous torque and nothing happens but SYNCs and RPDOs
that bring another torque, all that it does is arithmetic. Compiled code borrows its state for that
long, and gives it back with the first frame that asks for more, which the drive itself then takes.
The frames are the same, bit for bit.
"""

import functools
import math
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from canwall.bus.raw_socket import (
    FRAME,
    PORT,
    CFunction,
    elements,
    now_ns,
    receive,
    send,
)
from canwall.compiled import Record, compiled, compiled_for_c
from canwall.simdrive.mechanics.servo import SERVO, move_servo

MAX_TPDOS, MAX_FIELDS = 4, 4
#: A master that does not read for so long loses a TPDO.
_SEND_PATIENCE_NS = 1_000_000_000
_RATED = 1000
_INT32 = 1 << 31

#: What a TPDO may carry, by its place in `values`.
VALUES = (0x6041, 0x6064, 0x606C, 0x6074, 0x6077, 0x6078, 0x6071, 0x6040, 0x6061)
_, _POSITION, _VELOCITY, _DEMAND, _ACTUAL, _CURRENT, _TARGET, _CONTROLWORD, _ = range(9)

FIELD = np.dtype([("value", "i8"), ("shift", "i8"), ("bits", "i8")])
TPDO = np.dtype(
    [("can_id", "i8"), ("length", "i8"), ("fields", FIELD, (MAX_FIELDS,)), ("count", "i8")]
)
#: PdsState and parameters on loan.
CYCLIC = np.dtype(
    [
        ("port", PORT, (1,)),
        ("descriptor", "i8"),
        ("lent", "?"),
        ("due_ns", "i8"),  # when the drive's own timers want to be looked after
        # The frame that ended the loan.
        ("left", "?"),
        ("left_id", "i8"),
        ("left_length", "i8"),
        ("left_data", "i8"),
        # Frames
        ("sync_id", "i8"),
        ("rpdo_id", "i8"),
        ("rpdo_length", "i8"),
        ("controlword_shift", "i8"),
        ("torque_shift", "i8"),
        ("pending", "?"),
        ("received", "?"),
        ("pending_data", "i8"),
        ("tpdos", TPDO, (MAX_TPDOS,)),
        ("tpdo_count", "i8"),
        ("values", "i8", (len(VALUES),)),
        ("syncs", "i8"),
        # Torque
        ("highest", "i8"),
        ("lowest", "i8"),
        ("nm_per_mille", "f8"),
        ("held", "i8"),
        ("limited", "?"),
        ("warning", "?"),
        ("peak", "f8"),
        ("budget", "f8"),
        ("used", "f8"),
        ("direct", "?"),
        # Motion
        ("servo", "u8"),
        ("push", "u8"),
        ("slope", "u8"),
        ("piece", "i8"),
        ("piece_length", "i8"),
        ("period", "f8"),
        ("counts", "i8"),
        ("speed", "f8"),
        ("smoothing", "f8"),
        # Feedback
        ("position_sign", "i8"),
        ("position_shift", "i8"),
        ("position_scale", "f8"),
        ("speed_scale", "f8"),
    ],
    align=True,
)


@compiled
def _signed(value: int, bits: int) -> int:
    value &= (1 << bits) - 1
    return value - (1 << bits) if value >> (bits - 1) else value


@compiled
def _covered(drive: Record, used: float) -> int:
    """The largest torque that the I²t budget covers for a period (`Overload.limit`)."""
    left = (drive.budget - used) / drive.period
    return math.floor(min(drive.peak, math.sqrt(_RATED**2 + max(0.0, left)) + 1e-9))


@compiled
def _sync(drive: Record) -> bool:
    """One SYNC; False where it asks for more than is on loan, and nothing has been done."""
    values = drive.values
    target = values[_TARGET]
    if drive.pending:
        target = _signed(drive.pending_data >> drive.torque_shift, 16)
    if drive.piece >= drive.piece_length:
        return False
    # I²t (`TorquePath.pass_time`) and limits (`TorquePath.give`).
    used = drive.used
    if not (-_RATED <= drive.held <= _RATED and used == 0.0):
        used = max(0.0, used + (drive.held**2 - _RATED**2) * drive.period)
    torque = max(drive.lowest, min(drive.highest, target))
    if not -_RATED <= torque <= _RATED:
        covered = _covered(drive, used)
        torque = max(-covered, min(covered, torque))
    if (torque != target) != drive.limited or (used > 0.8 * drive.budget) != drive.warning:
        return False  # the statusword changes

    demanded = values[_DEMAND] * drive.nm_per_mille
    servos = elements(drive.servo, 1, SERVO)
    push = elements(drive.push, drive.piece_length, np.float64)
    slope = elements(drive.slope, drive.piece_length, np.float64)
    counts = move_servo(servos, demanded, push[drive.piece], slope[drive.piece], drive.period)
    quotient = (counts - drive.counts) / drive.period
    drive.speed += drive.smoothing * (quotient - drive.speed)
    drive.counts = counts
    drive.piece += 1
    drive.syncs += 1

    drive.used, drive.held = used, torque
    drive.pending = False
    values[_TARGET] = target
    values[_DEMAND] = values[_ACTUAL] = values[_CURRENT] = torque
    if not drive.direct:
        shown = np.rint(servos[0].torque / drive.nm_per_mille) if drive.nm_per_mille else 0.0
        values[_ACTUAL] = values[_CURRENT] = int(shown)
    position = drive.position_sign * (counts + drive.position_shift)
    if drive.position_scale != 1.0:
        position = math.floor(position * drive.position_scale + 0.5)
    values[_POSITION] = _signed(position, 32)
    speed = np.rint(drive.speed * drive.speed_scale)
    values[_VELOCITY] = int(max(-float(_INT32), min(_INT32 - 1.0, speed)))
    return True


@compiled
def _send_tpdos(drive: Record) -> None:
    for k in range(drive.tpdo_count):
        tpdo = drive.tpdos[k]
        data = 0
        for n in range(tpdo.count):
            field = tpdo.fields[n]
            data |= (drive.values[field.value] & ((1 << field.bits) - 1)) << field.shift
        send(drive.port[0], drive.descriptor, tpdo.can_id, tpdo.length, data, _SEND_PATIENCE_NS)


@compiled
def _take(drive: Record) -> bool:
    """Take the frame in the port; False where the drive itself has to."""
    frame = drive.port[0].frame[0]
    if frame.can_id == drive.rpdo_id and frame.length >= drive.rpdo_length:
        controlword = (frame.data >> drive.controlword_shift) & 0xFFFF
        if controlword != drive.values[_CONTROLWORD]:
            return False
        drive.pending = drive.received = True
        drive.pending_data = frame.data
        return True
    if frame.can_id == drive.sync_id and frame.length == 0 and _sync(drive):
        _send_tpdos(drive)
        return True
    return False


@compiled
def serve(drives: NDArray[np.void]) -> int:
    """Take all frames that are there; 1, or 0 where the drive itself has to go on.

    drives has dtype CYCLIC and shape (1,).
    """
    drive: Record = drives[0]
    if not drive.lent or drive.left or now_ns(drive.port[0]) >= drive.due_ns:
        return 0
    port = drive.port[0]
    while receive(port, drive.descriptor, False) == FRAME:
        if not _take(drive):
            frame = port.frame[0]
            drive.left = True
            drive.left_id, drive.left_length = frame.can_id, frame.length
            drive.left_data = frame.data
            return 0
    return 1


def _serve_at(address: int) -> int:
    """`serve`, of the record at an address."""
    return serve(elements(address, 1, CYCLIC))


@functools.cache
def _served() -> Any:
    return compiled_for_c(_serve_at, types.int64(types.uint64))


def serving(record: NDArray[np.void]) -> CFunction:
    """`serve` as a C function, for a record that stays where it is."""
    return CFunction(int(_served().address), record.ctypes.data)
