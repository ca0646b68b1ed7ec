"""Steady operation of a drive, from cycle to cycle, while nothing but the torque changes.

The drive is OPERATIONAL and in OPERATION ENABLED and follows the target torque of one synchronous
RPDO, without any fault, ramp, delay or switch. SYNCs and RPDOs then only require arithmetic on its
record: one compiled call per frame, of the same functions that its services call one by one at
other times.
"""

import numpy as np
from numpy.typing import NDArray

from canwall.bus.raw_socket import elements
from canwall.compiled import Record, compiled
from canwall.simdrive.communication.rpdo import keep_until_sync, restart_event_timer
from canwall.simdrive.communication.sync import begin_cycle
from canwall.simdrive.mechanics.motion import MOTION, advance_motion, has_script
from canwall.simdrive.mechanics.servo import SERVO, shows_its_torque
from canwall.simdrive.profile.feedback import latch
from canwall.simdrive.profile.overload import used_after, warns
from canwall.simdrive.profile.torque import demanded_nm, limited, show_torque
from canwall.simdrive.state import (
    CURRENT,
    TARGET_TORQUE,
    TORQUE,
    TORQUE_DEMAND,
    signed,
)

DECLINED = -1
"""The drive itself has to take the frame: nothing has been done."""


@compiled
def take(drives: NDArray[np.void], can_id: int, length: int, data: int) -> int:
    """Take a frame of a drive in steady operation.

    drives has dtype DRIVE and shape (1,); data is that of the frame, as `data_to_number` gives it.
    Returns how many TPDOs the drive sends (`sync_tpdos`; their data stand in `tpdos`), or DECLINED.
    """
    drive: Record = drives[0]
    if drive.steady:
        rpdo = drive.rpdos[drive.sync_rpdo]
        if can_id == rpdo.can_id and length == rpdo.length:
            restart_event_timer(drives, drive.sync_rpdo)
            keep_until_sync(drives, drive.sync_rpdo, data)
            return 0
        if can_id == drive.sync_id and length == 0:
            return _take_sync(drives)
    return DECLINED


@compiled
def _brings_torque_only(drive: Record, rpdo: Record) -> bool:
    """Return True if only the target torque gets a new value."""
    for k in range(rpdo.field_count):
        field = rpdo.fields[k]
        news = drive.values[field.place] ^ (rpdo.data >> field.shift)
        if field.place != TARGET_TORQUE and news & ((1 << field.bits) - 1):
            return False
    return True


@compiled
def _target_torque(drive: Record, rpdo: Record) -> int:
    """Return the target torque from this SYNC on; of several in the RPDO the last counts."""
    target = drive.values[TARGET_TORQUE]
    if rpdo.pending:
        for k in range(rpdo.field_count):
            field = rpdo.fields[k]
            if field.place == TARGET_TORQUE:
                target = signed(rpdo.data >> field.shift, field.bits)
    return target


@compiled
def _take_sync(drives: NDArray[np.void]) -> int:
    """Let a period pass, apply the torque, sample, and make up the TPDOs.

    Declined where an RPDO brought more than a torque, where the statusword changes, and where more
    of the hand's script has to be laid out.
    """
    drive: Record = drives[0]
    values = drive.values
    rpdo = drive.rpdos[drive.sync_rpdo]
    if rpdo.pending and not _brings_torque_only(drive, rpdo):
        return DECLINED
    motions = elements(drive.motion, 1, MOTION)
    motion: Record = motions[0]
    target = _target_torque(drive, rpdo)
    used = used_after(drives, drive.passed + drive.period)
    torque = limited(drives, used, target)
    status_changes = (torque != target) != drive.limited or warns(drives, used) != warns(
        drives, drive.used
    )
    if status_changes or drive.syncs == 0 or motion.share != 0.0 or not has_script(motions):
        return DECLINED

    advance_motion(motions, demanded_nm(drives), drive.period)
    drive.syncs += 1
    drive.passed = drive.without_sync = 0.0
    begin_cycle(drives)
    rpdo.pending = False
    drive.used, drive.held = used, torque
    values[TARGET_TORQUE] = target
    values[TORQUE_DEMAND] = values[TORQUE] = values[CURRENT] = torque
    servos = elements(motion.servo.ctypes.data, 1, SERVO)
    if shows_its_torque(servos):
        show_torque(drives, servos[0].latched_torque)
    latch(drives, motion.counts, motion.counts_per_s)
    for k in range(drive.sync_tpdo_count):
        _pack(drive, drive.tpdos[drive.sync_tpdos[k]])
    return drive.sync_tpdo_count


@compiled
def _pack(drive: Record, tpdo: Record) -> None:
    """Make up the data of a TPDO."""
    data = 0
    for k in range(tpdo.field_count):
        field = tpdo.fields[k]
        data |= (drive.values[field.place] & ((1 << field.bits) - 1)) << field.shift
    tpdo.data = data
