"""Text of a trip: event, cycle, amount, and a hint for the user."""

from canwall.cycle.axis import WallAxis
from canwall.cycle.exchange import Exchange
from canwall.cycle.state import RECENT_CYCLES
from canwall.cycle.trips import Trip
from canwall.drive import status_text
from canwall.walls import failed_how

#: Trips to which wrong or missing positions lead.
_FROM_POSITIONS = (Trip.SPEED, Trip.POSITION, Trip.JUMP, Trip.STUCK, Trip.TORQUE, Trip.ENERGY)


def shown_state(axis: WallAxis) -> str:
    """Return the state in the drive's latest statusword."""
    return status_text(int(axis.cycle["statusword"][0]))


def latest_emergency(axis: WallAxis) -> str:
    """Return the drive's latest EMCY as a suffix of a message; empty if there was none."""
    if not axis.node.emergencies:
        return ""
    latest = axis.node.emergencies[-1]
    return f"; EMCY {latest.code:#06x} ({latest.get_desc() or 'no description'})"


def suspected(axis: WallAxis) -> str:
    """Return what was heard while enabling as a suffix of a message; empty if there was nothing."""
    return f"; {axis.suspected}" if axis.suspected else ""


def trip_text(axis: WallAxis, exchange: Exchange) -> str:
    """Describe the trip with its cycle, its value and the key of the limit."""
    cycle, row = axis.cycle[0], axis.row[0]
    j = int(row["j"])
    trip = Trip(int(cycle["trip"]))
    position = float(row["position_rad"])
    jump = trip is Trip.JUMP
    if jump and not cycle["position_low"] <= position <= cycle["position_high"]:
        trip = Trip.POSITION  # which says more
    match trip:
        case Trip.SPEED:
            speed = float(cycle["orientation"] * cycle["estimator"]["v"][0])
            what = f"speed {speed:.3g} rad/s beyond limits.speed_rad_s"
        case Trip.POSITION:
            what = f"position {position:.4g} rad outside limits.position_rad"
            if jump and not _missing_recently(axis):
                way = abs(float(cycle["innovation"]))
                what += f", by a jump of {way:.3g} rad: look to the encoder and its cable"
        case Trip.JUMP:
            what = (
                f"the position jumped by {abs(float(cycle['innovation'])):.3g} rad, more than "
                f"{_jump_key(axis)} allows"
            )
            if not _missing_recently(axis):
                simulated = axis.settings.simulation is not None
                model = "[mechanics] and [simulation]" if simulated else "[mechanics]"
                what += f": look to the encoder and its cable, and to {model}"
        case Trip.STUCK:
            what = (
                f"the position has not changed for {int(cycle['frozen'])} cycles, in which the "
                f"handle should have moved by {float(cycle['motion_missed']):.2g} rad "
                f"(limits.stuck_rad): look to the encoder"
            )
        case Trip.TORQUE:
            what = (
                f"the drive's torque (0x6077) has been {float(cycle['torque_error']):.3g} N·m off "
                f"the target torque for {int(cycle['unfollowed'])} cycles, beyond "
                f"limits.torque_error_nm"
            )
        case Trip.ENERGY:
            energy = float(cycle["energy_out"])
            what = f"the wall has put out {energy:.3g} J in this contact, beyond limits.energy_j"
        case Trip.MISSED_TPDO:
            what = f"no TPDO for {int(cycle['missed_in_a_row'])} cycles"
            what += _too_short(axis) + _too_late(axis)
        case Trip.NOT_ENABLED:
            what = f"the drive left OPERATION ENABLED: {shown_state(axis)}{latest_emergency(axis)}"
        case Trip.REPORTED:
            what = axis.reported
        case Trip.STOPPED:
            what = "stopped by another process, the panel or a script"
        case _:
            what = _failed_law(axis)
    if trip in _FROM_POSITIONS:
        what += _missing_recently(axis)
    if trip in (Trip.NOT_ENABLED, Trip.REPORTED):
        what += _pause(axis, exchange)
    return f"cycle {j} ({j * float(cycle['period']):.3f} s): {what}"


def _failed_law(axis: WallAxis) -> str:
    """Describe what went wrong in the law, or in the one before while they are blended."""
    present, before = (int(axis.cycle[wall]["law"][0, 0]) for wall in ("rendered", "faded"))
    for law in (axis.laws[i] for i in (present, before) if i >= 0):
        if failure := law.failure():
            return f"law {law.name} {failed_how(failure)}"
    return f"law {axis.laws[present].name} {failed_how('')}"


def _missing_recently(axis: WallAxis) -> str:
    """Name missing TPDOs as the likely reason of a trip; empty if there were none."""
    missing = int(axis.cycle["missed_recently"][0]).bit_count()
    if not missing:
        return ""
    return (
        f"; {missing} of the last {RECENT_CYCLES} TPDOs were missing: look to the bus, its load "
        f"and its termination, first"
    )


def _jump_key(axis: WallAxis) -> str:
    return "limits.jump_rad" if axis.limits.jump_rad else "limits.speed_rad_s"


def _too_short(axis: WallAxis) -> str:
    if axis.wrong_length is None:
        return ""
    tpdo = axis.setup.tpdo
    return (
        f" (0x{tpdo.cob_id:03X} came with {axis.wrong_length} bytes, {tpdo.length} carry what is "
        f"mapped)"
    )


def _too_late(axis: WallAxis) -> str:
    late, after_ns = (int(axis.frames[name][0]) for name in ("late_tpdo", "late_tpdo_ns"))
    if not late or not axis.settings.real_time:
        return ""
    return (
        f"; {late} came too late, the last one {after_ns * 1e-6:.3g} ms after its SYNC: "
        f"bus.cycle_s is too short for the drive or the bus"
    )


def _pause(axis: WallAxis, exchange: Exchange) -> str:
    """Explain a drive that left OPERATION ENABLED because of a pause of the master."""
    watchdog, pause_s = axis.setup.watchdog, exchange.longest_pause_s()
    # The last sign of life may have been one period old when the pause began.
    before_s = watchdog.period_s if watchdog.error_control else 0.0
    if pause_s + before_s <= watchdog.time_s:
        return ""
    every = f" for a frame every {before_s * 1e3:.0f} ms" if watchdog.error_control else ""
    return (
        f"; the master had stood still for {pause_s:.3g} s, the drive's watchdog "
        f"({watchdog.kind}) waits {watchdog.time_s * 1e3:g} ms{every}"
    )
