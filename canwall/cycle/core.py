"""The rules of a cycle, compiled and without input or output: frames and time in, frames out.

Deadlines, SYNC and its counter, awaited TPDOs, steps, RPDOs, lateness, heartbeat and guarding
frames, the record and the hand-over of all other frames stand here once. A transport moves the
frames and sleeps: it calls `proceed` with the time, and `take` with each frame that it receives;
both return what the core wants next (`Want`). All times are CLOCK_MONOTONIC in nanoseconds
(time.perf_counter_ns), but for the kernel's stamps.
"""

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from canwall.bus.raw_socket import CAN_EFF, CAN_ERR, CAN_RTR, elements
from canwall.compiled import Record, compiled
from canwall.cycle.state import CYCLE
from canwall.cycle.step import step
from canwall.cycle.timing import HISTOGRAM, observe_ns
from canwall.record.columns import ROW
from canwall.record.ring import (
    ERROR,
    EXTENDED,
    FRAME,
    FRAMES,
    HEADER,
    RECEIVED,
    REMOTE,
    ROWS,
    put_frame,
    put_row,
)

#: A sleep ends when the scheduler likes: the last part of a wait is a busy one.
SPIN_NS = 200_000
#: Frames that may wait for Python between two of its turns.
INBOX = 1 << 12
#: Fill level of the record's rings above which simulated time waits for the writer.
BACKLOG = 0.5

_OPERATIONAL = 5
_ID_BITS = CAN_ERR - 1


class Want(IntEnum):
    """Request of the core to its transport, or to Python."""

    SEND = 0
    """Send the frame in `out`, then `proceed`."""
    FRAME = 1
    """Receive one frame and `take` it, or `proceed` at `until_ns`."""
    DRAIN = 2
    """`take` every frame that is there, then `proceed`."""
    SLEEP = 3
    """Sleep until `until_ns`, then `proceed`."""
    SPIN = 4
    """`proceed` again at once: the rest of the wait is too short for a sleep."""
    DONE = 5
    """The cycles that were asked for are done, or Python has something to do before the next."""
    HAND_OVER = 6
    """Python has to see the frames in the inbox before the torque is computed; then `proceed`."""
    WRITER = 7
    """The writer of the record is behind; `proceed` once it has caught up."""
    SYNC_LOST = 8
    """The producer of the SYNC has fallen silent."""


# The enum's values as plain numbers for the compiled code.
(_SEND, _FRAME, _DRAIN, _SLEEP, _SPIN, _DONE, _HAND_OVER, _WRITER, _SYNC_LOST) = map(int, Want)

#: Stages of a cycle.
_BEFORE, _DRAINING, _SYNC_DUE, _SYNC_SENT, _SYNC_AWAITED, _TPDO_AWAITED, _RPDO_SENT, _AFTER = range(
    8
)


class Handling(IntEnum):
    """Hand-over of a frame that is not the cycle's own, by its CAN-ID."""

    BETWEEN_CYCLES = 0
    URGENT = 1
    """Before the next torque is computed: it may end the wall."""
    URGENT_UNLESS_OPERATIONAL = 2
    """As URGENT, unless it is one byte that says NMT OPERATIONAL."""
    LOG_ONLY = 3


_URGENT, _UNLESS_OPERATIONAL, _LOG_ONLY = (
    int(Handling.URGENT),
    int(Handling.URGENT_UNLESS_OPERATIONAL),
    int(Handling.LOG_ONLY),
)

#: The frames of one drive, their timing, and the addresses of what belongs to its wall.
DRIVE_FRAMES = np.dtype(
    [
        ("tpdo_id", "i8"),
        ("tpdo_length", "i8"),
        ("rpdo_id", "i8"),
        ("rpdo_length", "i8"),
        ("constant", "i8"),  # what a fixed RPDO carries besides controlword and torque
        ("cycle", "u8"),
        ("row", "u8"),
        ("latency", "u8"),
        ("sync_to_rpdo", "u8"),
        ("header", "u8"),
        ("rows", "u8"),
        ("awaited", "?"),
        ("received_ns", "i8"),  # when the TPDO came, or was given up
        ("late_rpdo", "i8"),
        ("late_in_a_row", "i8"),
        ("late_limit", "i8"),
        ("wrong_length", "i8"),  # of the last TPDO that was too short; -1: there was none
    ],
    align=True,
)
#: A heartbeat or guarding frame that a drive's watchdog waits for.
ERROR_CONTROL = np.dtype(
    [("can_id", "i8"), ("length", "i8"), ("data", "i8"), ("period_ns", "i8"), ("due_ns", "i8")],
    align=True,
)
CORE = np.dtype(
    [
        # The frame to be sent: CAN-ID (with the flags of linux/can.h), length, data as a number.
        ("out", "i8", (3,)),
        ("until_ns", "i8"),
        ("sending_ns", "i8"),  # when the SYNC was to be sent
        ("stage", "i8"),
        ("left", "i8"),  # cycles that are still to be done
        ("wall_offset_ns", "i8"),  # CLOCK_REALTIME less CLOCK_MONOTONIC
        # SYNC
        ("real_time", "?"),
        ("external_sync", "?"),
        ("sync_id", "i8"),
        ("sync_overflow", "i8"),
        ("sync_counter", "i8"),
        ("sync_patience_ns", "i8"),
        ("period_ns", "i8"),
        ("deadline_ns", "i8"),
        ("sync_ns", "i8"),  # of the latest SYNC; 0: there was none yet
        ("sync_interval_s", "f8"),
        ("sync_interval", "u8"),
        ("sync_error", "u8"),
        # TPDOs and RPDOs
        ("timeout_ns", "i8"),
        ("missing_timeout_ns", "i8"),
        ("tpdo_until_ns", "i8"),
        ("answered", "i8"),  # the drive whose RPDO is being sent
        ("drives", "u8"),
        ("drives_length", "i8"),
        ("strikes", "i8"),
        # Heartbeat and guarding frames
        ("error_control", "u8"),
        ("error_control_length", "i8"),
        ("error_control_sent", "i8"),
        # Frames for Python, and all frames for the log (address 0: there is none).
        ("handling", "u1", (0x800,)),
        ("urgent", "?"),
        ("inbox_header", "u8"),
        ("inbox", "u8"),
        ("log_header", "u8"),
        ("log", "u8"),
        ("log_length", "i8"),
        ("writer_reads", "?"),
    ],
    align=True,
)


@compiled
def begin(cores: NDArray[np.void], most: int, wall_offset_ns: int) -> None:
    """Ask for a cycle, and for up to `most` of them while Python has nothing to do in between."""
    core: Record = cores[0]
    core.left = most
    core.strikes = _strikes(core)
    core.wall_offset_ns = wall_offset_ns


@compiled
def abandon(cores: NDArray[np.void]) -> None:
    """Give up the cycle under way: the bus has failed. `begin` begins another."""
    core: Record = cores[0]
    core.stage = _BEFORE
    core.left = 0


@compiled
def proceed(cores: NDArray[np.void], now_ns: int) -> int:
    """Go on with the cycle; return a `Want`.

    Also confirms a frame that was to be sent, and that there was no frame (more) to be taken.
    cores has dtype CORE and shape (1,).
    """
    core: Record = cores[0]
    stage = core.stage
    if stage == _TPDO_AWAITED:
        return _await_tpdos(core, now_ns)
    if stage == _SYNC_SENT:
        _log(core, now_ns + core.wall_offset_ns, 0, core.out[0], core.out[1], core.out[2])
        _begin_cycle(core, core.sending_ns)
        return _await_tpdos(core, now_ns)
    if stage == _RPDO_SENT:
        _complete_answer(core, now_ns)
        return _await_tpdos(core, now_ns)
    if stage == _AFTER:
        _log(core, now_ns + core.wall_offset_ns, 0, core.out[0], core.out[1], core.out[2])
        return _send_error_control(core, now_ns)
    if stage == _SYNC_AWAITED:
        return _FRAME if now_ns < core.until_ns else _SYNC_LOST
    if stage == _BEFORE:
        return _start(core, now_ns)
    return _send_sync(core, now_ns)


@compiled
def take(
    cores: NDArray[np.void], can_id: int, length: int, data: int, now_ns: int, stamp_ns: int
) -> int:
    """Take a frame that was received; return a `Want`.

    can_id has the flags of linux/can.h, data is a little-endian number, stamp_ns the kernel's time
    stamp (CLOCK_REALTIME) or 0.
    """
    core: Record = cores[0]
    wall_ns = stamp_ns if stamp_ns else now_ns + core.wall_offset_ns
    _log(core, wall_ns, RECEIVED, can_id, length, data)
    if core.stage == _TPDO_AWAITED:
        drives = elements(core.drives, core.drives_length, DRIVE_FRAMES)
        for k in range(len(drives)):
            drive: Record = drives[k]
            if drive.awaited and can_id == drive.tpdo_id:
                # A TPDO that is too short does not carry what was mapped: as good as none.
                complete = length >= drive.tpdo_length
                if not complete:
                    drive.wrong_length = length
                received_ns = min(now_ns, wall_ns - core.wall_offset_ns)
                return _answer(core, k, data if complete else 0, complete, received_ns)
    elif core.stage == _SYNC_AWAITED and can_id == core.sync_id:
        core.deadline_ns = now_ns + core.period_ns
        _begin_cycle(core, now_ns)
        return _await_tpdos(core, now_ns)
    # Before a SYNC this may be a TPDO that is late, or came twice: taken for the next one, it
    # would leave every position after it a cycle old.
    _hand_over(core, wall_ns, can_id, length, data)
    if core.stage == _DRAINING:
        return _DRAIN
    return _urgent(core) or _FRAME


@compiled
def _start(core: Record, now_ns: int) -> int:
    """Begin a cycle, or end the cycles that were asked for."""
    if core.left <= 0:
        return _DONE
    if _record_is_behind(core):
        return _WRITER
    if core.external_sync:
        core.until_ns = now_ns + core.sync_patience_ns
        core.stage = _SYNC_AWAITED
        return _FRAME
    if core.real_time:
        if core.deadline_ns == 0:
            core.deadline_ns = now_ns
        if core.deadline_ns - now_ns > SPIN_NS:
            core.until_ns = core.deadline_ns - SPIN_NS
            return _SLEEP
    core.stage = _DRAINING
    return _DRAIN


@compiled
def _send_sync(core: Record, now_ns: int) -> int:
    """Send the SYNC when it is due; what had come before was taken."""
    if core.stage == _DRAINING:
        if core.urgent:
            core.stage = _BEFORE
            return _urgent(core)
        core.stage = _SYNC_DUE
    if core.real_time:
        if now_ns < core.deadline_ns:
            return _SPIN
        core.deadline_ns = next_deadline(core.deadline_ns, now_ns, core.period_ns)
    length = 0
    if core.sync_overflow:
        # CiA 301, 7.2.5.3: from 1 to the overflow value, and again from 1.
        core.sync_counter = core.sync_counter % core.sync_overflow + 1
        length = 1
    core.sending_ns = now_ns
    core.stage = _SYNC_SENT
    return _send(core, core.sync_id, length, core.sync_counter)


@compiled
def next_deadline(deadline_ns: int, now_ns: int, period_ns: int) -> int:
    """Return the next instant of the grid that lies ahead: a late cycle is not made up for."""
    return deadline_ns + (max(0, now_ns - deadline_ns) // period_ns + 1) * period_ns


@compiled
def _begin_cycle(core: Record, sync_ns: int) -> None:
    """Await the TPDOs of a SYNC."""
    interval = sync_ns - core.sync_ns if core.sync_ns else 0
    if interval:
        observe_ns(elements(core.sync_interval, 1, HISTOGRAM), interval)
        observe_ns(elements(core.sync_error, 1, HISTOGRAM), abs(interval - core.period_ns))
    core.sync_ns = sync_ns
    core.sync_interval_s = interval * 1e-9
    timeout = core.timeout_ns
    drives = elements(core.drives, core.drives_length, DRIVE_FRAMES)
    for k in range(len(drives)):
        drives[k].awaited = True
        if elements(drives[k].cycle, 1, CYCLE)[0].missed_in_a_row:
            timeout = core.missing_timeout_ns
    core.tpdo_until_ns = sync_ns + timeout
    core.stage = _TPDO_AWAITED


@compiled
def _await_tpdos(core: Record, now_ns: int) -> int:
    """Wait for the TPDOs that are missing; answer without them when time is up."""
    core.stage = _TPDO_AWAITED
    drives = elements(core.drives, core.drives_length, DRIVE_FRAMES)
    for k in range(len(drives)):
        if drives[k].awaited:
            if now_ns < core.tpdo_until_ns:
                core.until_ns = core.tpdo_until_ns
                return _FRAME
            return _answer(core, k, 0, False, now_ns)
    core.error_control_sent = 0
    return _send_error_control(core, now_ns)


@compiled
def _answer(core: Record, k: int, data: int, received: bool, received_ns: int) -> int:
    """Compute the torque of one drive's wall and send its RPDO."""
    drive: Record = elements(core.drives, core.drives_length, DRIVE_FRAMES)[k]
    drive.awaited = False
    drive.received_ns = received_ns
    rows = elements(drive.row, 1, ROW)
    answer = step(elements(drive.cycle, 1, CYCLE), rows, data, received)
    core.answered = k
    core.stage = _RPDO_SENT
    return _send(core, drive.rpdo_id, drive.rpdo_length, answer | drive.constant)


@compiled
def _complete_answer(core: Record, sent_ns: int) -> None:
    """Record the cycle of the drive whose RPDO was sent."""
    _log(core, sent_ns + core.wall_offset_ns, 0, core.out[0], core.out[1], core.out[2])
    drive: Record = elements(core.drives, core.drives_length, DRIVE_FRAMES)[core.answered]
    latency = sent_ns - drive.received_ns
    observe_ns(elements(drive.latency, 1, HISTOGRAM), latency)
    rows = elements(drive.row, 1, ROW)
    row: Record = rows[0]
    row.sync_interval_s = core.sync_interval_s
    row.latency_s = latency * 1e-9
    if core.real_time:
        since_due = sent_ns - core.deadline_ns + core.period_ns
        observe_ns(elements(drive.sync_to_rpdo, 1, HISTOGRAM), since_due)
        late = sent_ns > core.deadline_ns
        drive.late_rpdo += late
        drive.late_in_a_row = drive.late_in_a_row + 1 if late else 0
    put_row(elements(drive.header, 1, HEADER), elements(drive.rows, ROWS, ROW), rows)


@compiled
def _send_error_control(core: Record, now_ns: int) -> int:
    """Send the next heartbeat or guarding frame that is due; then the cycle is over."""
    core.stage = _AFTER
    frames = elements(core.error_control, core.error_control_length, ERROR_CONTROL)
    for k in range(core.error_control_sent, len(frames)):
        frame: Record = frames[k]
        if now_ns >= frame.due_ns:
            frame.due_ns = now_ns + frame.period_ns
            core.error_control_sent = k + 1
            return _send(core, frame.can_id, frame.length, frame.data)
    core.stage = _BEFORE
    core.left = 0 if _wants_python(core) else core.left - 1
    return _start(core, now_ns)


@compiled
def _send(core: Record, can_id: int, length: int, data: int) -> int:
    core.out[0] = can_id
    core.out[1] = length
    core.out[2] = data if length == 8 else data & ((1 << 8 * length) - 1)
    return _SEND


@compiled
def _urgent(core: Record) -> int:
    """HAND_OVER, once, where a frame has come that may end the wall; else 0."""
    if not core.urgent:
        return 0
    core.urgent = False
    return _HAND_OVER


@compiled
def _flags(can_id: int) -> int:
    """Flags of a record's frame for those of an identifier."""
    flags = REMOTE if can_id & CAN_RTR else 0
    flags |= ERROR if can_id & CAN_ERR else 0
    return flags | (EXTENDED if can_id & CAN_EFF else 0)


@compiled
def _log(core: Record, wall_ns: int, received: int, can_id: int, length: int, data: int) -> None:
    """Log a frame; received is RECEIVED, or 0 for one that was sent."""
    if core.log_header:
        put_frame(
            elements(core.log_header, 1, HEADER),
            elements(core.log, core.log_length, FRAME),
            wall_ns * 1e-9,
            can_id & _ID_BITS,
            received | _flags(can_id),
            length,
            data,
        )


@compiled
def _hand_over(core: Record, wall_ns: int, can_id: int, length: int, data: int) -> None:
    """Leave a frame to Python, at the latest before the next cycle."""
    flags = RECEIVED | _flags(can_id)
    standard = not flags & (REMOTE | EXTENDED | ERROR)
    handling = core.handling[can_id & 0x7FF]
    if standard and handling == _LOG_ONLY:
        return
    put_frame(
        elements(core.inbox_header, 1, HEADER),
        elements(core.inbox, INBOX, FRAME),
        wall_ns * 1e-9,
        can_id & _ID_BITS,
        flags,
        length,
        data,
    )
    operational = length == 1 and data & 0x7F == _OPERATIONAL
    if flags & ERROR or (
        standard and (handling == _URGENT or (handling == _UNLESS_OPERATIONAL and not operational))
    ):
        core.urgent = True


@compiled
def _record_is_behind(core: Record) -> bool:
    """Return whether the writer of the record is behind; only simulated time can wait for it."""
    if core.real_time or not core.writer_reads:
        return False
    drives = elements(core.drives, core.drives_length, DRIVE_FRAMES)
    for k in range(len(drives)):
        header: Record = elements(drives[k].header, 1, HEADER)[0]
        if header.row_head - header.row_tail > BACKLOG * ROWS:
            return True
        if header.frame_head - header.frame_tail > BACKLOG * FRAMES:
            return True
    return False


@compiled
def _wants_python(core: Record) -> bool:
    """Return whether Python is due before the next cycle: a trip, a strike's end, frames."""
    inbox: Record = elements(core.inbox_header, 1, HEADER)[0]
    if inbox.frame_head != inbox.frame_tail:
        return True
    drives = elements(core.drives, core.drives_length, DRIVE_FRAMES)
    for k in range(len(drives)):
        drive: Record = drives[k]
        cycle: Record = elements(drive.cycle, 1, CYCLE)[0]
        late = drive.late_limit > 0 and drive.late_in_a_row >= drive.late_limit
        if cycle.trip or cycle.missed_in_a_row or late:
            return True
    return _strikes(core) != core.strikes


@compiled
def _strikes(core: Record) -> int:
    drives = elements(core.drives, core.drives_length, DRIVE_FRAMES)
    strikes = 0
    for k in range(len(drives)):
        strikes += elements(drives[k].cycle, 1, CYCLE)[0].strikes
    return strikes
