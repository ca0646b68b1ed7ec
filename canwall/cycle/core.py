"""Rules of a cycle, compiled and without input or output: frames and time in, frames out.

This is the only implementation of deadlines, SYNC and its counter, awaited TPDOs, steps, RPDOs,
lateness, heartbeat and guarding frames, the record, and the hand-over of all other frames. A
transport moves the frames and sleeps: it calls `proceed` with the time, and `take` with each frame
that it receives; both return what the core wants next (`Want`). All times are CLOCK_MONOTONIC in
nanoseconds (time.perf_counter_ns), except for the kernel's time stamps.
"""

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from canwall.bus.raw_socket import CAN_EFF, CAN_ERR, CAN_RTR, elements
from canwall.compiled import Record, compiled
from canwall.cycle.state import CYCLE
from canwall.cycle.step import step_at
from canwall.cycle.timing import observe_ns
from canwall.cycle.trips import stop
from canwall.record.append import load_acquire, put_frame, put_row
from canwall.record.columns import ROW
from canwall.record.controls import CONTROLS
from canwall.record.histogram import HISTOGRAM
from canwall.record.ring import (
    ERROR,
    EXTENDED,
    FRAME,
    FRAMES,
    HEADER,
    RECEIVED,
    REMOTE,
    ROWS,
)

#: Last part of a wait, which is a busy one because the end of a sleep is not precise.
SPIN_NS = 200_000
#: Capacity for frames that wait for Python.
INBOX = 1 << 12
#: Fill level of the record's rings above which simulated time waits for the writer.
BACKLOG = 0.5

_OPERATIONAL = 5

#: In simulated time, the wait for a TPDO that is not there when the timeout has passed.
_SECOND_LOOK_NS = 50_000_000
_ID_BITS = CAN_ERR - 1


class Want(IntEnum):
    """Request of the core to its transport, or to Python."""

    SEND = 0
    """Send the frame in `out`, then `proceed`."""
    FRAME = 1
    """Receive one frame and `take` it, or `proceed` at `until_ns`."""
    DRAIN = 2
    """`take` every waiting frame, then `proceed`."""
    SLEEP = 3
    """Sleep until `until_ns`, then `proceed`."""
    SPIN = 4
    """`proceed` again at once; the rest of the wait is too short for a sleep."""
    DONE = 5
    """The requested cycles are done, or Python has something to do before the next one."""
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
    """Hand-over of a frame that does not belong to the cycle, by its CAN-ID."""

    BETWEEN_CYCLES = 0
    URGENT = 1
    """Before the next torque is computed, because it may end the wall."""
    URGENT_UNLESS_OPERATIONAL = 2
    """As URGENT, except for a heartbeat of a node in OPERATIONAL."""
    LOG_ONLY = 3


_URGENT, _UNLESS_OPERATIONAL, _LOG_ONLY = (
    int(Handling.URGENT),
    int(Handling.URGENT_UNLESS_OPERATIONAL),
    int(Handling.LOG_ONLY),
)

#: Frames of one drive, their timing, and the addresses of the records of its wall.
DRIVE_FRAMES = np.dtype(
    [
        ("tpdo_id", "i8"),
        ("tpdo_length", "i8"),
        ("rpdo_id", "i8"),
        ("rpdo_length", "i8"),
        ("constant", "i8"),  # content of a fixed RPDO besides controlword and torque
        ("step", "u8"),
        ("cycle", "u8"),
        ("row", "u8"),
        ("latency", "u8"),
        ("sync_to_rpdo", "u8"),
        ("header", "u8"),
        ("rows", "u8"),
        ("controls", "u8"),  # words of other processes (address 0: none)
        ("awaited", "?"),
        ("received_ns", "i8"),  # when the TPDO arrived, or counted as missing
        ("late_rpdo", "i8"),
        ("late_in_a_row", "i8"),
        ("late_limit", "i8"),
        ("wrong_length", "i8"),  # of the last TPDO that was too short, -1 if there was none
        ("received", "?"),  # True if the TPDO of this cycle has come
        ("late_tpdo", "i8"),
        ("late_tpdo_ns", "i8"),  # from its SYNC to the last TPDO that came after it was awaited
    ],
    align=True,
)
#: A heartbeat or guarding frame that a drive's watchdog expects.
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
        ("retired", "?"),  # no more frames, even if a call that was given up comes back
        ("left", "i8"),  # remaining cycles
        ("single", "?"),  # only one cycle at a time, whatever was requested
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
        ("sync_ns", "i8"),  # of the latest SYNC, 0 before the first
        ("sync_stamp_ns", "i8"),  # the kernel's stamp of an external SYNC, 0 if there is none
        ("sync_interval_s", "f8"),
        ("sync_interval", "u8"),
        ("sync_error", "u8"),
        # TPDOs and RPDOs
        ("timeout_ns", "i8"),
        ("missing_timeout_ns", "i8"),
        ("tpdo_until_ns", "i8"),
        ("looked_again", "?"),  # for TPDOs, after the timeout
        ("answered", "i8"),  # the drive whose RPDO is being sent
        ("drives", "u8"),
        ("drives_length", "i8"),
        ("strikes", "i8"),
        # Heartbeat and guarding frames
        ("error_control", "u8"),
        ("error_control_length", "i8"),
        ("error_control_sent", "i8"),
        # Frames for Python, and all frames for the log (address 0: no log).
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
    """Request one cycle, or up to `most` while Python has nothing to do in between."""
    core: Record = cores[0]
    core.left = most
    core.strikes = _strikes(core)
    core.wall_offset_ns = wall_offset_ns


@compiled
def abandon(cores: NDArray[np.void]) -> None:
    """Abandon the present cycle after a failure of the bus; `begin` starts another one."""
    core: Record = cores[0]
    core.stage = _BEFORE
    core.left = 0


@compiled
def proceed(cores: NDArray[np.void], now_ns: int) -> int:
    """Continue the cycle; return a `Want`.

    The call also confirms that a frame was sent, or that no (further) frame is waiting. cores has
    dtype CORE and shape (1,).
    """
    core: Record = cores[0]
    stage = core.stage
    if core.retired:
        return _DONE
    if stage == _TPDO_AWAITED:
        return _await_tpdos(core, now_ns)
    if stage == _SYNC_SENT:
        _log(core, now_ns + core.wall_offset_ns, 0, core.out[0], core.out[1], core.out[2])
        _begin_cycle(core, core.sending_ns, core.sending_ns - core.sync_ns)
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
def proceed_without(cores: NDArray[np.void], now_ns: int) -> int:
    """Continue without the TPDOs that are missing: the drives have done all that they were asked.

    That is known in simulated time of drives that this process serves, on its own SYNC: that of
    another producer comes when it likes. Returns a `Want`.
    """
    core: Record = cores[0]
    core.looked_again = True
    core.tpdo_until_ns = now_ns
    return proceed(cores, now_ns)


@compiled
def take(
    cores: NDArray[np.void], can_id: int, length: int, data: int, now_ns: int, stamp_ns: int
) -> int:
    """Process a received frame; return a `Want`.

    can_id has the flags of linux/can.h, data is a little-endian number, stamp_ns the kernel's time
    stamp (CLOCK_REALTIME) or 0.
    """
    core: Record = cores[0]
    if core.retired:
        return _DONE
    wall_ns = stamp_ns if stamp_ns else now_ns + core.wall_offset_ns
    _log(core, wall_ns, RECEIVED, can_id, length, data)
    if core.stage == _TPDO_AWAITED:
        drives = elements(core.drives, core.drives_length, DRIVE_FRAMES)
        for k in range(len(drives)):
            drive: Record = drives[k]
            if drive.awaited and can_id == drive.tpdo_id:
                # A TPDO that is too short lacks mapped objects, and counts as missing.
                complete = length >= drive.tpdo_length
                if not complete:
                    drive.wrong_length = length
                received_ns = min(now_ns, wall_ns - core.wall_offset_ns)
                drive.received = complete
                return _answer(core, k, data if complete else 0, complete, received_ns)
    elif core.stage == _SYNC_AWAITED and can_id == core.sync_id:
        # Of a master that stood still, the SYNCs have waited; only the kernel knows how long.
        core.deadline_ns = min(now_ns, wall_ns - core.wall_offset_ns) + core.period_ns
        since_ns = stamp_ns - core.sync_stamp_ns if stamp_ns and core.sync_stamp_ns else 0
        core.sync_stamp_ns = stamp_ns
        _begin_cycle(core, now_ns, since_ns)
        return _await_tpdos(core, now_ns)
    # Before a SYNC this may be a late or duplicate TPDO. Mistaken for the next one, it would delay
    # all following positions by a cycle.
    _note_late_tpdo(core, can_id, min(now_ns, wall_ns - core.wall_offset_ns))
    _hand_over(core, wall_ns, can_id, length, data)
    if core.stage == _DRAINING:
        return _DRAIN
    return _urgent(core) or _FRAME


@compiled
def _note_late_tpdo(core: Record, can_id: int, received_ns: int) -> None:
    """Note a TPDO that comes too late for its SYNC, or besides another one."""
    drives = elements(core.drives, core.drives_length, DRIVE_FRAMES)
    for k in range(len(drives)):
        drive: Record = drives[k]
        if can_id == drive.tpdo_id and core.sync_ns and not drive.awaited:
            if not drive.received:
                drive.late_tpdo += 1
                drive.late_tpdo_ns = received_ns - core.sync_ns
            else:
                elements(drive.cycle, 1, CYCLE)[0].overtaken = True


@compiled
def _start(core: Record, now_ns: int) -> int:
    """Begin a cycle, or end the requested cycles."""
    if core.left <= 0:
        return _DONE
    if _record_is_behind(core):
        return _WRITER
    if core.external_sync:
        # In real time, SYNCs that have waited since the bus was opened are over.
        if core.sync_ns or not core.real_time:
            return _await_sync(core, now_ns)
    elif core.real_time:
        if core.deadline_ns == 0:
            core.deadline_ns = now_ns
        if core.deadline_ns - now_ns > SPIN_NS:
            core.until_ns = core.deadline_ns - SPIN_NS
            return _SLEEP
    core.stage = _DRAINING
    return _DRAIN


@compiled
def _await_sync(core: Record, now_ns: int) -> int:
    """Wait for the SYNC of another producer."""
    core.until_ns = now_ns + core.sync_patience_ns
    core.stage = _SYNC_AWAITED
    return _FRAME


@compiled
def _send_sync(core: Record, now_ns: int) -> int:
    """Send the SYNC when it is due, after all earlier frames were processed."""
    if core.stage == _DRAINING:
        if core.urgent:
            core.stage = _BEFORE
            return _urgent(core)
        if core.external_sync:
            return _await_sync(core, now_ns)
        core.stage = _SYNC_DUE
    if core.real_time:
        if now_ns - core.deadline_ns > core.period_ns // 2:
            # The master stood still: the SYNCs keep to their grid, on which the drive may insist.
            core.deadline_ns = next_deadline(core.deadline_ns, now_ns, core.period_ns)
            core.stage = _BEFORE
            return _start(core, now_ns)
        if now_ns < core.deadline_ns:
            return _SPIN
        core.deadline_ns = next_deadline(core.deadline_ns, now_ns, core.period_ns)
    length = 0
    if core.sync_overflow:
        # CiA 301, 7.2.5.3: the counter runs from 1 to the overflow value.
        core.sync_counter = core.sync_counter % core.sync_overflow + 1
        length = 1
    core.sending_ns = now_ns
    core.stage = _SYNC_SENT
    return _send(core, core.sync_id, length, core.sync_counter)


@compiled
def next_deadline(deadline_ns: int, now_ns: int, period_ns: int) -> int:
    """Return the next instant of the time grid in the future; missed ones are skipped."""
    return deadline_ns + (max(0, now_ns - deadline_ns) // period_ns + 1) * period_ns


@compiled
def _begin_cycle(core: Record, sync_ns: int, since_ns: int) -> None:
    """Begin to wait for the TPDOs of a SYNC.

    since_ns: time since the SYNC before on the bus, if it is known, for the SYNCs skipped between.
    """
    interval = sync_ns - core.sync_ns if core.sync_ns else 0
    if interval:
        observe_ns(elements(core.sync_interval, 1, HISTOGRAM), interval)
        observe_ns(elements(core.sync_error, 1, HISTOGRAM), abs(interval - core.period_ns))
    skipped = 0
    if core.real_time and core.sync_ns:  # simulated time stands still with the master
        skipped = max(0, (since_ns + core.period_ns // 2) // core.period_ns - 1)
    core.sync_ns = sync_ns
    core.sync_interval_s = interval * 1e-9
    timeout = core.timeout_ns
    drives = elements(core.drives, core.drives_length, DRIVE_FRAMES)
    for k in range(len(drives)):
        drives[k].awaited = True
        drives[k].received = False
        cycle: Record = elements(drives[k].cycle, 1, CYCLE)[0]
        cycle.skipped = skipped
        if cycle.missed_in_a_row:
            timeout = core.missing_timeout_ns
    core.tpdo_until_ns = sync_ns + timeout
    core.looked_again = core.real_time
    core.stage = _TPDO_AWAITED


@compiled
def _await_tpdos(core: Record, now_ns: int) -> int:
    """Wait for the missing TPDOs; answer without them after the timeout."""
    core.stage = _TPDO_AWAITED
    drives = elements(core.drives, core.drives_length, DRIVE_FRAMES)
    for k in range(len(drives)):
        if drives[k].awaited:
            if now_ns >= core.tpdo_until_ns and not core.looked_again:
                # In simulated time it is the machine that was away, not the TPDO.
                core.looked_again = True
                core.tpdo_until_ns = now_ns + _SECOND_LOOK_NS
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
    cycles, rows = elements(drive.cycle, 1, CYCLE), elements(drive.row, 1, ROW)
    if drive.controls and load_acquire(elements(drive.controls, 1, CONTROLS)[0], "stop"):
        stop(cycles[0])
    answer = step_at(drive.step, cycles, rows, data, received)
    if core.retired:
        return _DONE
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
    """Send the next heartbeat or guarding frame that is due; without one, end the cycle."""
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
    """Return HAND_OVER once for each arrival of frames that may end the wall, else 0."""
    if not core.urgent:
        return 0
    core.urgent = False
    return _HAND_OVER


@compiled
def _flags(can_id: int) -> int:
    """Convert the flags of an identifier to those of a frame in the record."""
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
    """Hand a frame to Python, at the latest before the next cycle."""
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
    """Return True if the writer of the record is behind, which only simulated time waits for."""
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
    """Return True if Python has to act before the next cycle (a request, trip, strike or frame)."""
    inbox: Record = elements(core.inbox_header, 1, HEADER)[0]
    if core.single or inbox.frame_head != inbox.frame_tail:
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
