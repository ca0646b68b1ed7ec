"""Trips: the limits that the step checks in every cycle."""

from enum import IntEnum

from canwall.compiled import Record, compiled
from canwall.drive import DriveState
from canwall.record import Phase
from canwall.walls import start_open_loop


class Trip(IntEnum):
    """Reason for giving up the wall."""

    NONE = 0
    SPEED = 1
    POSITION = 2
    MISSED_TPDO = 3
    NOT_ENABLED = 4
    NOT_A_NUMBER = 5
    ENERGY = 6
    REPORTED = 7
    """A frame outside the cycle (EMCY, heartbeat, error frame)."""
    JUMP = 8
    """A position that the handle cannot have reached since the previous one."""
    STUCK = 9
    """A position that does not change by a single count although the handle is moving."""
    TORQUE = 10
    """A torque actual value (0x6077) that does not follow the target torque."""
    STOPPED = 11
    """The word of control with which another process stops the wall."""


# The enums' values as plain numbers for the compiled code.
_SPEED = int(Trip.SPEED)
_POSITION = int(Trip.POSITION)
_NOT_ENABLED = int(Trip.NOT_ENABLED)
_ENERGY = int(Trip.ENERGY)
_JUMP = int(Trip.JUMP)
_STUCK = int(Trip.STUCK)
_TORQUE = int(Trip.TORQUE)
_REPORTED = int(Trip.REPORTED)
_STOPPED = int(Trip.STOPPED)
_LEAVING = int(Phase.LEAVING)
_ENABLED_MASK, _ENABLED_VALUE = DriveState.OPERATION_ENABLED.value
#: Statusword bit 11, internal limit active: the drive itself reports a reduced torque.
_INTERNAL_LIMIT = 1 << 11
#: A handle that stops within two cycles, with a speed that falls as half a period of a cosine,
#: travels 0.82 and 0.18 of the distance in them. Below 5.5 counts per cycle, the latter is less
#: than one count and not observable; the former, extrapolated, yields 3.5.
_LEAST_COUNTS = 4
#: Torque of a hand or friction [per mille of the rated torque] that may stop the handle unnoticed:
#: at 100 Hz the stop takes less than a cycle and leaves no trace in the positions.
_UNMODELLED = 100.0


@compiled
def check_limits(cycle: Record) -> None:
    """Set the trip of a limit that is exceeded, unless a trip is already set."""
    if cycle.trip:
        return
    position = cycle.counts * cycle.rad_per_count
    if not cycle.position_low <= position <= cycle.position_high:
        cycle.trip = _POSITION
    elif cycle.frozen == cycle.stuck_cycles and _is_stuck(cycle):
        cycle.trip = _STUCK
    elif not abs(cycle.estimator[0].v) <= cycle.speed_limit:
        cycle.trip = _SPEED
    elif cycle.statusword & _ENABLED_MASK != _ENABLED_VALUE:
        cycle.trip = _NOT_ENABLED
    elif cycle.energy_out > cycle.energy_limit:
        cycle.trip = _ENERGY
    elif cycle.unfollowed >= cycle.torque_error_cycles:
        cycle.trip = _TORQUE


@compiled
def stop(cycle: Record) -> None:
    """Set the trip of a wall that another process stops, in any phase but the way out."""
    if cycle.trip == 0 and cycle.phase != _LEAVING:
        cycle.trip = _STOPPED


@compiled
def withdraw(cycle: Record) -> None:
    """Let the wall's force fall, if it is withdrawn, and set the trip at the end."""
    if cycle.share_falls == 0.0 or cycle.phase == _LEAVING:
        return
    cycle.share = max(0.0, cycle.share - cycle.share_falls)
    if cycle.share == 0.0 and cycle.trip == 0:
        cycle.trip = _REPORTED


@compiled
def _is_stuck(cycle: Record) -> bool:
    """Return True if the encoder has stopped although the handle is still moving.

    Two predictions have to agree, in direction as well: the open-loop model, which knows the
    torques but may have the wrong mass; and the extrapolation of the last two changes of the
    position, since a handle that is stopped slows down, unless _UNMODELLED stops it within a cycle.
    Three positions rounded to counts leave the extrapolated change,
    2·(y[j] − y[j−1]) − (y[j−1] − y[j−2]), uncertain by 3 counts: its lower bound is used. A handle
    slower than _LEAST_COUNTS may have come to a stop within a count, which is not observable.
    """
    last, before = abs(cycle.change), abs(cycle.change_before)
    least = min(last - 1.0, 2.0 * last - before - 3.0)
    if least < _LEAST_COUNTS:
        return False
    unmodelled = _UNMODELLED * cycle.nm_per_mille / cycle.estimator[0].mass
    went = least * cycle.rad_per_count - unmodelled * cycle.period**2
    return min(went * cycle.stuck_cycles, cycle.motion_missed) > cycle.stuck_limit


@compiled
def compare_position(cycle: Record, change: int, missed: int) -> None:
    """Compare the position with the one predicted; a jump trips before the estimator uses it.

    The prediction follows the torques in flight and the estimated force, also through `missed`
    cycles without a sample. Thereafter it is uncertain, and a position counts as possible if the
    last one is near enough. change: change of the position since the last sample [counts].
    """
    cycle.innovation = cycle.oriented - cycle.estimator[0].y
    if missed or not cycle.started:
        cycle.change = cycle.change_before = 0
        cycle.frozen = 0
        cycle.motion_missed = 0.0
    elif change:
        cycle.change_before = cycle.change
        cycle.change = change
        cycle.frozen = 0
        cycle.motion_missed = 0.0
    else:
        cycle.frozen += 1
        if cycle.frozen == 1:
            start_open_loop(cycle.estimator[0])
        if cycle.frozen <= cycle.stuck_cycles:
            ahead = cycle.estimator[0].open_loop_y - cycle.oriented
            if cycle.orientation * cycle.rad_per_count * cycle.change < 0.0:
                ahead = -ahead
            cycle.motion_missed = max(cycle.motion_missed, ahead)
    limit = cycle.jump_limit * (1 + missed)
    jumped = not abs(cycle.innovation) <= limit
    if not cycle.estimator[0].settled:
        jumped = jumped and not abs(change * cycle.rad_per_count) <= limit
    if jumped and cycle.started and cycle.phase != _LEAVING and cycle.trip == 0:
        cycle.trip = _JUMP


@compiled
def compare_torque(cycle: Record) -> None:
    """Count the cycles in which 0x6077 is outside the range of the recent commands.

    The range decays within torque_error_cycles, so that a current loop with a lag, or a filtered
    torque actual value, stays inside it.
    """
    sent = float(cycle.torque_per_mille)
    fading = 2.0 / cycle.torque_error_cycles
    cycle.highest_sent = max(sent, cycle.highest_sent + fading * (sent - cycle.highest_sent))
    cycle.lowest_sent = min(sent, cycle.lowest_sent + fading * (sent - cycle.lowest_sent))
    actual = float(cycle.torque_actual)
    beyond = max(actual - cycle.highest_sent, cycle.lowest_sent - actual)
    cycle.torque_error = beyond * cycle.nm_per_mille
    limited = cycle.statusword & _INTERNAL_LIMIT
    if cycle.torque_error > cycle.torque_error_limit and not limited:
        cycle.unfollowed += 1
    else:
        cycle.unfollowed = 0
