"""The exchange of a cycle's frames in compiled code: one function, without the interpreter lock.

Deadline, SYNC, TPDOs, steps, RPDOs, signs of life and the record are one call over one record. It
comes back to Python between two cycles, and within a cycle only for what Python has to see before
the torque is computed (an EMCY, an error frame), or where a simulated drive lives in the master's
idle time. It can be called again at any such place and goes on where it was.
"""

from enum import IntEnum
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from canwall.bus.raw_socket import (
    CLOSED,
    FAILED,
    FRAME,
    NOTHING,
    PORT,
    elements,
    now_ns,
    receive,
    send,
    sleep_until,
    wait_readable,
    wall_clock_ns,
)
from canwall.compiled import Record, compiled
from canwall.cycle.exchange import BACKLOG
from canwall.cycle.state import CYCLE
from canwall.cycle.step import step
from canwall.cycle.sync import SPIN_NS
from canwall.cycle.timing import HISTOGRAM, observe_ns
from canwall.record.columns import ROW
from canwall.record.ring import (
    ERROR,
    EXTENDED,
    FRAMES,
    HEADER,
    RECEIVED,
    REMOTE,
    ROWS,
    put_frame,
    put_row,
)
from canwall.record.ring import FRAME as LOGGED


class Result(IntEnum):
    """What compiled code comes back to Python for."""

    DONE = 0
    SEEN_FIRST = 1
    """Frames have come that Python has to see before the torque is computed."""
    IDLE = 2
    """The drive that lives in the master's idle time is to be called."""
    RECORD_BEHIND = 3
    NO_SYNC = 4
    GONE = 5
    ERRNO = 6


# The enum's values as plain numbers for the compiled code.
_DONE, _SEEN_FIRST, _IDLE, _RECORD_BEHIND, _NO_SYNC, _GONE, _ERRNO = map(int, Result)
#: Where a cycle is: before its SYNC, waiting for somebody else's, waiting for TPDOs.
_BEFORE, _SYNC_AWAITED, _TPDO_AWAITED = range(3)

_CAN_EFF, CAN_RTR, _CAN_ERR = 1 << 31, 1 << 30, 1 << 29
_OPERATIONAL = 5
#: How a CAN-ID is to be treated: seen at once, or only if it tells of another NMT state; seen by
#: nobody, only logged. 0: seen between two cycles.
AT_ONCE, UNLESS_OPERATIONAL, UNSEEN = 1, 2, 3
#: Frames that wait for Python between two looks of it.
INBOX = 1 << 12
_BITS_OFF = ~np.uint32(_CAN_EFF | CAN_RTR | _CAN_ERR)

#: One drive: where its frames are, and the addresses of what belongs to its axis.
AXIS = np.dtype(
    [
        ("tpdo_id", "i8"),
        ("tpdo_length", "i8"),
        ("rpdo_id", "i8"),
        ("rpdo_length", "i8"),
        ("constant", "i8"),
        ("cycle", "u8"),
        ("row", "u8"),
        ("latency", "u8"),
        ("sync_to_rpdo", "u8"),
        ("header", "u8"),
        ("rows", "u8"),
        ("awaited", "?"),
        ("late_rpdo", "i8"),
        ("late_in_a_row", "i8"),
        ("late_limit", "i8"),
        ("wrong_length", "i8"),  # of the last TPDO that was too short; -1: there was none
    ],
    align=True,
)
BEAT = np.dtype(
    [("can_id", "i8"), ("length", "i8"), ("data", "i8"), ("period_ns", "i8"), ("due_ns", "i8")],
    align=True,
)
EXCHANGE = np.dtype(
    [
        ("port", PORT, (1,)),
        ("descriptor", "i8"),
        ("stamped", "?"),
        ("send_patience_ns", "i8"),
        # SYNC
        ("real_time", "?"),
        ("external", "?"),
        ("sync_id", "i8"),
        ("sync_overflow", "i8"),
        ("sync_counter", "i8"),
        ("sync_patience_ns", "i8"),
        ("period_ns", "i8"),
        ("deadline_ns", "i8"),
        ("last_sync_ns", "i8"),
        ("sync_interval_s", "f8"),
        ("sync_interval", "u8"),
        ("sync_error", "u8"),
        # TPDOs
        ("timeout_ns", "i8"),
        ("missing_timeout_ns", "i8"),
        ("look_ns", "i8"),  # this long after a SYNC the bus is looked at awake
        ("stage", "i8"),
        ("left", "i8"),  # cycles that are still to be done in this call
        ("strikes", "i8"),
        ("wait_until_ns", "i8"),
        ("looked_ns", "i8"),
        ("axes", "u8"),
        ("axes_length", "i8"),
        ("beats", "u8"),
        ("beats_length", "i8"),
        # Frames for Python, those of them that it has to see at once, and all frames for the log.
        ("treatment", "u1", (0x800,)),
        ("at_once", "?"),
        ("inbox_header", "u8"),
        ("inbox", "u8"),
        ("log_header", "u8"),
        ("log", "u8"),
        ("log_length", "i8"),
        # The drive that lives in idle time: to be asked for in Python, or by address.
        ("idle", "?"),
        ("idle_function", "u8"),
        ("idle_state", "u8"),
        ("writer_reads", "?"),
    ],
    align=True,
)


@intrinsic  # type: ignore[untyped-decorator]
def _call_idle(typingctx: Any, address: Any, state: Any) -> Any:
    """Whether the compiled idle function at `address` did all that there was to be done."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = ir.IntType(64)
        function = ir.FunctionType(number, [number]).as_pointer()
        return builder.call(builder.inttoptr(arguments[0], function), [arguments[1]])

    return types.int64(types.uint64, types.uint64), codegen


@compiled
def _flags(frame: Record) -> int:
    """What a record's flags make of those in the identifier."""
    flags = REMOTE if frame.can_id & CAN_RTR else 0
    flags |= ERROR if frame.can_id & _CAN_ERR else 0
    return flags | (EXTENDED if frame.can_id & _CAN_EFF else 0)


@compiled
def _note(exchange: Record, received: int) -> None:
    """Log the frame in the port; received: RECEIVED, or 0 for one that was sent."""
    port = exchange.port[0]
    frame = port.frame[0]
    if exchange.log_header:
        stamp_ns = port.stamp_ns if received and port.stamp_ns else wall_clock_ns(port)
        put_frame(
            elements(exchange.log_header, 1, HEADER),
            elements(exchange.log, exchange.log_length, LOGGED),
            stamp_ns * 1e-9,
            frame.can_id & _BITS_OFF,
            received | _flags(frame),
            frame.length,
            frame.data,
        )


@compiled
def _hand_over(exchange: Record) -> None:
    """Leave the frame in the port to Python."""
    port = exchange.port[0]
    frame = port.frame[0]
    flags = RECEIVED | _flags(frame)
    if flags == RECEIVED and exchange.treatment[frame.can_id & 0x7FF] == UNSEEN:
        return
    put_frame(
        elements(exchange.inbox_header, 1, HEADER),
        elements(exchange.inbox, INBOX, LOGGED),
        (port.stamp_ns if port.stamp_ns else wall_clock_ns(port)) * 1e-9,
        frame.can_id & _BITS_OFF,
        flags,
        frame.length,
        frame.data,
    )
    if flags & ERROR:
        exchange.at_once = True
    elif not flags & (REMOTE | EXTENDED):
        treatment = exchange.treatment[frame.can_id & 0x7FF]
        well = frame.length == 1 and frame.data & 0x7F == _OPERATIONAL
        if treatment == AT_ONCE or (treatment == UNLESS_OPERATIONAL and not well):
            exchange.at_once = True


@compiled
def _transmit(exchange: Record, can_id: int, length: int, data: int) -> bool:
    port = exchange.port[0]
    if send(port, exchange.descriptor, can_id, length, data, exchange.send_patience_ns) != FRAME:
        return False
    _note(exchange, 0)
    return True


@compiled
def _serve_all(exchange: Record) -> int:
    """Leave all that has come to Python; NOTHING where there is no more.

    A TPDO among it is late, or came twice. Taken for the next one, it would leave every position
    after it a cycle old.
    """
    port = exchange.port[0]
    while True:
        came = receive(port, exchange.descriptor, exchange.stamped)
        if came != FRAME:
            return came
        _note(exchange, RECEIVED)
        _hand_over(exchange)


@compiled
def next_deadline(deadline_ns: int, now: int, period_ns: int) -> int:
    """The next instant of the grid that lies ahead: a late cycle is not made up for."""
    return deadline_ns + (max(0, now - deadline_ns) // period_ns + 1) * period_ns


@compiled
def _sleep(exchange: Record) -> None:
    """Until shortly before the SYNC is due."""
    port = exchange.port[0]
    if exchange.deadline_ns == 0:
        exchange.deadline_ns = now_ns(port)
    while exchange.deadline_ns - now_ns(port) > SPIN_NS:
        sleep_until(port, exchange.deadline_ns - SPIN_NS)


@compiled
def _spin(exchange: Record) -> None:
    """The last part of the wait, awake; sets the deadline after this one."""
    port = exchange.port[0]
    now = now_ns(port)
    while now < exchange.deadline_ns:
        now = now_ns(port)
    exchange.deadline_ns = next_deadline(exchange.deadline_ns, now, exchange.period_ns)


@compiled
def _send_sync(exchange: Record) -> int:
    """Send the SYNC when it is due; _DONE where all is well."""
    if exchange.real_time:
        _sleep(exchange)
    came = _serve_all(exchange)
    if came == CLOSED:
        return _GONE
    if came == FAILED:
        return _ERRNO
    if exchange.at_once:
        return _SEEN_FIRST
    if exchange.real_time:
        _spin(exchange)
    length = 0
    if exchange.sync_overflow:
        # CiA 301, 7.2.5.3: from 1 to the overflow value, and again from 1.
        exchange.sync_counter = exchange.sync_counter % exchange.sync_overflow + 1
        length = 1
    sync_ns = now_ns(exchange.port[0])
    if not _transmit(exchange, exchange.sync_id, length, exchange.sync_counter):
        return _ERRNO
    _begin(exchange, sync_ns)
    return _DONE


@compiled
def _begin(exchange: Record, sync_ns: int) -> None:
    """A SYNC was on the bus: the TPDOs are awaited from now on."""
    interval = sync_ns - exchange.last_sync_ns if exchange.last_sync_ns else 0
    if interval:
        observe_ns(elements(exchange.sync_interval, 1, HISTOGRAM), interval)
        observe_ns(elements(exchange.sync_error, 1, HISTOGRAM), abs(interval - exchange.period_ns))
    exchange.last_sync_ns = sync_ns
    exchange.sync_interval_s = interval * 1e-9
    timeout = exchange.timeout_ns
    if _missing(exchange):
        timeout = exchange.missing_timeout_ns
    exchange.wait_until_ns = sync_ns + timeout
    exchange.looked_ns = sync_ns
    axes = elements(exchange.axes, exchange.axes_length, AXIS)
    for k in range(len(axes)):
        axes[k].awaited = True
    exchange.stage = _TPDO_AWAITED


@compiled
def _missing(exchange: Record) -> bool:
    """Whether the TPDO of any axis was missed in the last cycle."""
    missed = 0
    axes = elements(exchange.axes, exchange.axes_length, AXIS)
    for k in range(len(axes)):
        missed += elements(axes[k].cycle, 1, CYCLE)[0].missed_in_a_row
    return missed > 0


@compiled
def _answer(exchange: Record, axis: Record, data: int, received: bool, received_ns: int) -> bool:
    """Step and RPDO of one axis, and its row; whether the bus took the RPDO."""
    axis.awaited = False
    rows = elements(axis.row, 1, ROW)
    answer = step(elements(axis.cycle, 1, CYCLE), rows, data, received)
    if not _transmit(exchange, axis.rpdo_id, axis.rpdo_length, answer | axis.constant):
        return False
    sent_ns = now_ns(exchange.port[0])
    observe_ns(elements(axis.latency, 1, HISTOGRAM), sent_ns - received_ns)
    row: Record = rows[0]
    row.sync_interval_s = exchange.sync_interval_s
    row.latency_s = (sent_ns - received_ns) * 1e-9
    if exchange.real_time:
        since_due = sent_ns - exchange.deadline_ns + exchange.period_ns
        observe_ns(elements(axis.sync_to_rpdo, 1, HISTOGRAM), since_due)
        late = sent_ns > exchange.deadline_ns
        axis.late_rpdo += late
        axis.late_in_a_row = axis.late_in_a_row + 1 if late else 0
    put_row(elements(axis.header, 1, HEADER), elements(axis.rows, ROWS, ROW), rows)
    return True


@compiled
def _received_ns(port: Record) -> int:
    """When the frame in the port came, by CLOCK_MONOTONIC: the kernel's stamp where it has one."""
    now = now_ns(port)
    return now - max(0, wall_clock_ns(port) - port.stamp_ns) if port.stamp_ns else now


@compiled
def _take(exchange: Record) -> bool:
    """Take the frame in the port, which is a TPDO or not; whether the bus took the answer."""
    _note(exchange, RECEIVED)
    port = exchange.port[0]
    frame = port.frame[0]
    axes = elements(exchange.axes, exchange.axes_length, AXIS)
    for k in range(len(axes)):
        axis: Record = axes[k]
        if axis.awaited and frame.can_id == axis.tpdo_id:
            # A TPDO that is too short does not carry what was mapped: as good as none.
            complete = frame.length >= axis.tpdo_length
            if not complete:
                axis.wrong_length = frame.length
            data = frame.data if complete else 0
            return _answer(exchange, axis, data, complete, _received_ns(port))
    _hand_over(exchange)
    return True


@compiled
def _give_up_waiting(exchange: Record) -> bool:
    """Answer for those whose TPDO has not come; whether the bus took it."""
    axes = elements(exchange.axes, exchange.axes_length, AXIS)
    for k in range(len(axes)):
        if axes[k].awaited and not _answer(exchange, axes[k], 0, False, now_ns(exchange.port[0])):
            return False
    return True


@compiled
def _awaited(exchange: Record) -> int:
    """How many TPDOs are awaited."""
    awaited = 0
    axes = elements(exchange.axes, exchange.axes_length, AXIS)
    for k in range(len(axes)):
        awaited += axes[k].awaited
    return awaited


@compiled
def _beat(exchange: Record) -> bool:
    """Send the signs of life that are due; whether the bus took them."""
    beats = elements(exchange.beats, exchange.beats_length, BEAT)
    for k in range(len(beats)):
        beat: Record = beats[k]
        now = now_ns(exchange.port[0])
        if now >= beat.due_ns:
            if not _transmit(exchange, beat.can_id, beat.length, beat.data):
                return False
            beat.due_ns = now + beat.period_ns
    return True


@compiled
def _record_is_behind(exchange: Record) -> bool:
    """Whether the writer of the record has to be waited for, which only simulated time can."""
    if exchange.real_time or not exchange.writer_reads:
        return False
    axes = elements(exchange.axes, exchange.axes_length, AXIS)
    for k in range(len(axes)):
        header: Record = elements(axes[k].header, 1, HEADER)[0]
        if header.row_head - header.row_tail > BACKLOG * ROWS:
            return True
        if header.frame_head - header.frame_tail > BACKLOG * FRAMES:
            return True
    return False


@compiled
def _wants_python(exchange: Record) -> bool:
    """Whether something is to be done before the next cycle: a trip, a turn, frames."""
    inbox: Record = elements(exchange.inbox_header, 1, HEADER)[0]
    if inbox.frame_head != inbox.frame_tail:
        return True
    axes = elements(exchange.axes, exchange.axes_length, AXIS)
    for k in range(len(axes)):
        cycle: Record = elements(axes[k].cycle, 1, CYCLE)[0]
        late = axes[k].late_limit > 0 and axes[k].late_in_a_row >= axes[k].late_limit
        if cycle.trip or cycle.missed_in_a_row or late:
            return True
    return _strikes(exchange) != exchange.strikes


@compiled
def _strikes(exchange: Record) -> int:
    axes = elements(exchange.axes, exchange.axes_length, AXIS)
    strikes = 0
    for k in range(len(axes)):
        strikes += elements(axes[k].cycle, 1, CYCLE)[0].strikes
    return strikes


@compiled
def _fail(exchange: Record, why: int) -> int:
    """The cycle is given up; the next call begins another."""
    exchange.stage = _BEFORE
    return why


@compiled
def _start(exchange: Record) -> int:
    """Up to the SYNC, or to waiting for it; _DONE where all is well."""
    if _record_is_behind(exchange):
        return _RECORD_BEHIND
    if not exchange.external:
        return _send_sync(exchange)
    exchange.wait_until_ns = now_ns(exchange.port[0]) + exchange.sync_patience_ns
    exchange.stage = _SYNC_AWAITED
    return _DONE


@compiled
def _nothing_came(exchange: Record) -> int:
    """Wait, or let the drive live that waits itself; _DONE where it is to be looked again."""
    port = exchange.port[0]
    left_ns = exchange.wait_until_ns - now_ns(port)
    if left_ns <= 0:
        if exchange.stage == _SYNC_AWAITED:
            return _NO_SYNC
        return _DONE if _give_up_waiting(exchange) else _ERRNO
    if not exchange.idle:
        # A drive that answers at once is not worth a sleep, which costs more than its answer.
        if now_ns(port) - exchange.looked_ns > exchange.look_ns:
            wait_readable(port, exchange.descriptor, left_ns)
    elif not exchange.idle_function or not _call_idle(exchange.idle_function, exchange.idle_state):
        return _IDLE
    return _DONE


@compiled
def _exchange_frames(exchange: Record) -> int:
    """Take what has come, or wait; _DONE where all is well, with or without an end in sight."""
    port = exchange.port[0]
    came = receive(port, exchange.descriptor, exchange.stamped)
    if came == CLOSED:
        return _GONE
    if came == FAILED:
        return _ERRNO
    if came == NOTHING:
        return _nothing_came(exchange)
    if exchange.stage == _SYNC_AWAITED and port.frame[0].can_id == exchange.sync_id:
        _note(exchange, RECEIVED)
        now = now_ns(port)
        exchange.deadline_ns = now + exchange.period_ns
        _begin(exchange, now)
        return _DONE
    return _DONE if _take(exchange) else _ERRNO


@compiled
def begin(exchanges: NDArray[np.void], most: int) -> None:
    """Ask for a cycle, and up to `most` of them while nothing else is to be done."""
    exchange: Record = exchanges[0]
    exchange.left = most
    exchange.strikes = _strikes(exchange)


@compiled
def run(exchanges: NDArray[np.void]) -> int:
    """Go on with the cycles that were asked for; a `Result`, after which it may be called again.

    exchanges has dtype EXCHANGE and shape (1,), and must stay where it is.
    """
    exchange: Record = exchanges[0]
    while exchange.left > 0:
        result = _start(exchange) if exchange.stage == _BEFORE else _exchange_frames(exchange)
        if exchange.at_once:
            exchange.at_once = False
            if result in (_DONE, _SEEN_FIRST):
                return _SEEN_FIRST
        if result in (_IDLE, _RECORD_BEHIND):
            return result
        if result != _DONE:
            return _fail(exchange, result)
        if exchange.stage == _TPDO_AWAITED and _awaited(exchange) == 0:
            exchange.stage = _BEFORE
            if not _beat(exchange):
                return _fail(exchange, _ERRNO)
            exchange.left = 0 if _wants_python(exchange) else exchange.left - 1
    return _DONE
