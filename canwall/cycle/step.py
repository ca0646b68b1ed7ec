"""One cycle between the two frames: TPDO in, RPDO out, as one compiled function over one record.

Counts → y → estimator → state at the instant of actuation → law → tension → limits → per mille.
"""

import math
from collections.abc import Sequence
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.config import Limits, Settings, Wall
from canwall.drive import DriveSetup, PdoLayout, State
from canwall.drive import objects as od
from canwall.metrics import STRIKE_GAP_S
from canwall.record import Phase
from canwall.units import to_per_mille
from canwall.walls import (
    ESTIMATOR,
    TENSION,
    WALL,
    Law,
    acting_force,
    actuation_state,
    commit,
    find_law,
    forget,
    note_force,
    observe,
    pick_up,
    reset_estimator,
    set_estimator,
    set_plant,
    set_referent,
    wall_force,
)

#: Laws among which a run can change.
MAX_LAWS = 16

#: Delay of a torque carried by a synchronous RPDO (theory, section 3).
SYNCHRONOUS_DELAY = 1.0


class Trip(IntEnum):
    """Why the wall was given up."""

    NONE = 0
    SPEED = 1
    POSITION = 2
    MISSED_TPDO = 3
    NOT_ENABLED = 4
    NOT_A_NUMBER = 5
    ENERGY = 6
    REPORTED = 7
    """Something that came over the bus beside the cycle: EMCY, heartbeat, error frame."""
    JUMP = 8
    """A position far from where the handle can have gone since the one before."""
    STUCK = 9
    """A position that stays the same to the count though the handle is moving."""
    TORQUE = 10
    """A torque actual value (0x6077) that does not follow the target torque."""


# The enums' values as plain numbers for the compiled code.
_RENDERING = int(Phase.RENDERING)
_SPEED = int(Trip.SPEED)
_POSITION = int(Trip.POSITION)
_MISSED = int(Trip.MISSED_TPDO)
_NOT_ENABLED = int(Trip.NOT_ENABLED)
_NAN = int(Trip.NOT_A_NUMBER)
_ENERGY = int(Trip.ENERGY)
_JUMP = int(Trip.JUMP)
_STUCK = int(Trip.STUCK)
_TORQUE = int(Trip.TORQUE)
_MEASURING = int(Phase.MEASURING)
_LEAVING = int(Phase.LEAVING)
_ENABLED_MASK, _ENABLED_VALUE = State.OPERATION_ENABLED.value
#: Statusword bit 11, internal limit active: the drive says itself that it gives less.
_INTERNAL_LIMIT = 1 << 11

#: A coarse encoder rests on one count for long: less than so many counts are no motion missed.
_STUCK_COUNTS = 8
#: Rounding may be a count on either side of a cycle.
_JUMP_COUNTS = 2
#: Without [limits] torque_error_nm: parts of torque_nm, and per mille of the rated torque.
_TORQUE_ERROR_PART, _TORQUE_ERROR_PER_MILLE = 0.1, 50.0

#: After more cycles than this without a sample the estimate is taken up anew.
_BLIND_CYCLES = 5

_FIELD = [("shift", "i8"), ("bits", "i8")]

#: No law: a wall that is not there and gives no force.
_NO_LAW = -1

#: A wall on the drive's axis, and the law that renders it.
RENDERED = np.dtype(
    [
        ("law", "i8"),  # index into the laws of the cycle
        ("position", "f8"),
        ("estimated_velocity", "?"),
        ("divider", "i8"),  # the law is asked every so many cycles
        ("wall", WALL, (1,)),
        # State: cycles since the law was asked, its force, its sample, the time since then.
        ("waited", "i8"),
        ("force", "f8"),
        ("y_before", "f8"),
        ("elapsed", "f8"),
    ],
    align=True,
)

#: Settings, state and results of one wall on one drive.
CYCLE = np.dtype(
    [
        # Where the values lie in the frames' data; bits = 0: not carried.
        ("in_position", _FIELD, (1,)),
        ("in_statusword", _FIELD, (1,)),
        ("in_torque", _FIELD, (1,)),
        ("out_controlword", _FIELD, (1,)),
        ("out_torque", _FIELD, (1,)),
        # Scales and limits.
        ("period", "f8"),
        ("rad_per_count", "f8"),
        ("nm_per_mille", "f8"),
        ("drive_torque_limit", "f8"),
        ("torque_limit", "f8"),
        ("torque_rate", "f8"),
        ("speed_limit", "f8"),
        ("position_low", "f8"),
        ("position_high", "f8"),
        ("energy_limit", "f8"),
        ("jump_limit", "f8"),
        ("stuck_limit", "f8"),
        ("stuck_cycles", "i8"),
        ("torque_error_limit", "f8"),
        ("torque_error_cycles", "i8"),
        ("hold_cycles", "i8"),
        ("ramp_cycles", "i8"),
        ("strike_gap", "i8"),
        # The wall, and the one that it takes over from, cycle by cycle.
        ("orientation", "f8"),
        ("laws", "u8", (MAX_LAWS,)),
        ("rendered", RENDERED, (1,)),
        ("faded", RENDERED, (1,)),
        ("fade_cycles", "i8"),
        ("fade_left", "i8"),
        ("estimator", ESTIMATOR, (1,)),
        # What the loop asks for.
        ("phase", "i8"),
        ("controlword", "i8"),
        ("test_per_mille", "i8"),
        # State.
        ("j", "i8"),
        ("counts", "i8"),
        ("statusword", "i8"),
        ("torque_actual", "i8"),
        ("torque_per_mille", "i8"),
        ("missed_in_a_row", "i8"),
        # Whether the estimator knows where the handle is, and how far off it was this time.
        ("started", "?"),
        ("innovation", "f8"),
        # Cycles since the position last changed, its last changes before [counts per cycle], and
        # the motion that was missed in them.
        ("frozen", "i8"),
        ("change", "i8"),
        ("change_before", "i8"),
        ("motion_missed", "f8"),
        # Highest and lowest torque commanded of late [per mille]; cycles for which the torque
        # actual value has been outside of them, and how far [N·m].
        ("highest_sent", "f8"),
        ("lowest_sent", "f8"),
        ("unfollowed", "i8"),
        ("torque_error", "f8"),
        ("oriented", "f8"),
        ("force_applied", "f8"),
        ("energy_out", "f8"),
        ("touched", "?"),
        ("outside", "i8"),
        # Results.
        ("trip", "i8"),
        ("missed_tpdo", "i8"),
        ("strikes", "i8"),
    ],
    align=True,
)


def make_cycle(settings: Settings, setup: DriveSetup, laws: Sequence[Law]) -> NDArray[np.void]:
    """The record of one wall, ready for its first cycle; shape (1,), dtype CYCLE.

    `laws` are the laws of the run; a row's `law` is an index into them. Raises UnknownLawError
    for options that a law does not have.
    """
    cycle = np.zeros(1, CYCLE)
    for name, layout, index in (
        ("in_position", setup.tpdo, od.POSITION_ACTUAL_VALUE),
        ("in_statusword", setup.tpdo, od.STATUSWORD),
        ("in_torque", setup.tpdo, od.TORQUE_ACTUAL_VALUE),
        ("out_controlword", setup.rpdo, od.CONTROLWORD),
        ("out_torque", setup.rpdo, od.TARGET_TORQUE),
    ):
        _set_field(cycle, name, layout, index)
    period = settings.bus.cycle_s
    cycle["period"] = period
    cycle["rad_per_count"] = setup.units.rad_per_count
    cycle["nm_per_mille"] = setup.units.nm_per_mille
    cycle["strike_gap"] = round(STRIKE_GAP_S / period)
    cycle["drive_torque_limit"] = setup.torque_limit_nm
    for i, law in enumerate(laws):
        cycle["laws"][0, i] = law.address
    delay = settings.estimator.delay_cycles
    set_delay(cycle, settings, SYNCHRONOUS_DELAY if delay is None else delay)
    set_limits(cycle, settings.limits)
    set_plant(cycle["rendered"][0]["wall"][0], *_model(settings), period)
    cycle["rendered"]["law"] = _NO_LAW
    set_wall(cycle, settings.wall, laws)
    return cycle


def _model(settings: Settings) -> tuple[float, float, float]:
    """Mass, viscous damping and spring of `[mechanics]`."""
    mechanics = settings.mechanics
    return mechanics.inertia_kg_m2, mechanics.viscous_nm_s_per_rad, mechanics.spring_nm_per_rad


def set_delay(cycle: NDArray[np.void], settings: Settings, delay: float) -> None:
    """Write the estimator for a delay of `delay` periods; it starts anew. Raises ValueError."""
    set_estimator(
        cycle["estimator"][0],
        *_model(settings),
        settings.mechanics.coulomb_nm,
        settings.bus.cycle_s,
        count=float(cycle["rad_per_count"][0]),
        force_walk=settings.estimator.force_walk_nm_per_sqrt_s,
        delay=delay,
    )
    reset_estimator(cycle["estimator"][0], float(cycle["oriented"][0]))


def _set_field(cycle: NDArray[np.void], name: str, layout: PdoLayout, index: int) -> None:
    field = layout.field(index)
    if field is not None:
        cycle[name]["shift"], cycle[name]["bits"] = field.shift, field.bits


def set_limits(cycle: NDArray[np.void], limits: Limits) -> None:
    """Change the limits between two cycles."""
    cycle["torque_limit"] = min(limits.torque_nm, cycle["drive_torque_limit"].item())
    cycle["torque_rate"] = limits.torque_rate_nm_per_s or math.inf
    cycle["speed_limit"] = limits.speed_rad_s
    cycle["position_low"], cycle["position_high"] = limits.position_rad
    cycle["energy_limit"] = limits.energy_j or math.inf
    period, count = cycle["period"].item(), cycle["rad_per_count"].item()
    jump = limits.jump_rad or limits.speed_rad_s * period
    cycle["jump_limit"] = jump + _JUMP_COUNTS * abs(count)
    stuck = max(limits.stuck_rad, _STUCK_COUNTS * abs(count))
    cycle["stuck_limit"] = stuck if limits.stuck_rad else math.inf
    cycle["stuck_cycles"] = limits.stuck_cycles
    error = limits.torque_error_nm
    if error is None:
        rated_part = _TORQUE_ERROR_PER_MILLE * abs(cycle["nm_per_mille"].item())
        error = max(_TORQUE_ERROR_PART * limits.torque_nm, rated_part)
    cycle["torque_error_limit"] = error or math.inf
    cycle["torque_error_cycles"] = limits.torque_error_cycles
    cycle["hold_cycles"] = limits.hold_cycles
    cycle["ramp_cycles"] = limits.ramp_cycles


def set_wall(cycle: NDArray[np.void], wall: Wall, laws: Sequence[Law]) -> None:
    """Change the wall between two cycles; its law is one of `laws`. Raises UnknownLawError."""
    law = find_law(wall.law, wall.deadbeat)
    options = law.option_values(wall.options)
    index = [known.name for known in laws].index(law.name)
    cycle["orientation"] = 1.0 if wall.side == "below" else -1.0
    rendered = cycle["rendered"][0]
    known = rendered["wall"][0]
    rendered["position"] = wall.position_rad
    rendered["estimated_velocity"] = wall.velocity == "estimated"
    if wall.divider != rendered["divider"]:
        # The law's torques are held for as long as it is not asked again.
        rendered["divider"] = rendered["waited"] = wall.divider
        mass, viscous, spring = (known[name].item() for name in ("mass", "viscous", "spring"))
        set_plant(known, mass, viscous, spring, cycle["period"].item() * wall.divider)
    set_referent(known, wall.stiffness_nm_per_rad, wall.damping_nm_s_per_rad, options)
    known["tension"] = TENSION[wall.tension]
    known["passivity_damping"] = wall.passivity_nm_s_per_rad
    if index != rendered["law"]:
        rendered["law"] = index
        forget(known)


def fade_over(cycle: NDArray[np.void], cycles: int) -> None:
    """Let the wall as it is now give way to what is set next, without a bump, within `cycles`.

    To be called before `set_wall`. Force and wall change places linearly; where neither gives a
    force there is nothing to fade.
    """
    cycle["faded"] = cycle["rendered"]
    cycle["fade_cycles"] = cycle["fade_left"] = cycles


def fade_in(cycle: NDArray[np.void], cycles: int) -> None:
    """Let the wall come up out of nothing within `cycles`: the handle may be inside it."""
    fade_over(cycle, cycles)
    cycle["faded"]["law"] = _NO_LAW


def start_at(cycle: NDArray[np.void], counts: int) -> None:
    """Begin at rest at a position: the first that the drive reports."""
    oriented = cycle["orientation"][0] * counts * cycle["rad_per_count"][0]
    reset_estimator(cycle["estimator"][0], oriented)
    cycle["oriented"] = cycle["rendered"]["y_before"] = oriented
    cycle["started"] = True


@compiled
def _signed(data: int, field: Record) -> int:
    value = (data >> field.shift) & ((1 << field.bits) - 1)
    return value - (1 << field.bits) if value >> (field.bits - 1) else value


@compiled
def _unsigned(data: int, field: Record) -> int:
    return (data >> field.shift) & ((1 << field.bits) - 1)


@compiled
def _placed(value: int, field: Record) -> int:
    return (value & ((1 << field.bits) - 1)) << field.shift


@compiled
def read_inputs(cycles: NDArray[np.void], data: int) -> None:
    """Take position, statusword and torque out of a TPDO's data (little-endian number)."""
    cycle: Record = cycles[0]
    cycle.counts = _signed(data, cycle.in_position[0])
    cycle.statusword = _unsigned(data, cycle.in_statusword[0])
    if cycle.in_torque[0].bits:
        cycle.torque_actual = _signed(data, cycle.in_torque[0])
    else:
        cycle.torque_actual = cycle.torque_per_mille


@compiled
def _look(cycle: Record, rendered: Record, due: bool) -> None:
    """Show a wall what there is to be seen of the handle, relative to itself.

    The estimator works on the drive's axis, turned towards the wall: it does not notice when the
    wall is moved. `due` says that a new sample is there and the law will be asked.
    """
    wall, estimator = rendered.wall[0], cycle.estimator[0]
    origin = cycle.orientation * rendered.position
    wall.y_sample = cycle.oriented - origin
    rendered.elapsed += cycle.period
    if due:
        wall.v_sample = (cycle.oriented - rendered.y_before) / rendered.elapsed
        rendered.y_before = cycle.oriented
        rendered.elapsed = 0.0
    if rendered.estimated_velocity:
        wall.v_sample = estimator.v
    y, wall.v = actuation_state(estimator)
    wall.y = y - origin
    wall.d = estimator.d - wall.spring * origin


@compiled
def _is_due(rendered: Record, received: bool) -> bool:
    """Whether the law is asked in this cycle: every so many, and not without a sample."""
    rendered.waited += 1
    if not received or rendered.waited < rendered.divider:
        return False
    rendered.waited = 0
    return True


@compiled
def _force_of(cycle: Record, rendered: Record, due: bool) -> float:
    """Force of a wall: what its law says now, or said when it was last asked."""
    if rendered.law < 0:
        return 0.0
    if due:
        rendered.force = wall_force(cycle.laws[rendered.law], rendered.wall[0])
    return rendered.force


@compiled
def _faded_force(cycle: Record, force: float, received: bool) -> float:
    """The wall's force on its way from the wall before."""
    faded = cycle.faded[0]
    due = _is_due(faded, received)
    _look(cycle, faded, due)
    before = _force_of(cycle, faded, due)
    share = cycle.fade_left / (cycle.fade_cycles + 1.0)
    cycle.fade_left -= 1
    if force == 0.0 and before == 0.0:
        cycle.fade_left = 0
    return force + share * (before - force)


@compiled
def _held_force(cycle: Record) -> float:
    """Without a TPDO: hold the torque, then let go of it along a ramp, then give up."""
    held = cycle.orientation * cycle.torque_per_mille * cycle.nm_per_mille
    overdue = cycle.missed_in_a_row - cycle.hold_cycles
    if overdue <= 0:
        return held
    if overdue >= cycle.ramp_cycles:
        cycle.trip = _MISSED
        return 0.0
    return held * (cycle.ramp_cycles - overdue) / (cycle.ramp_cycles - overdue + 1.0)


@compiled
def _watch(cycle: Record) -> None:
    """Set the trip of a limit that is passed; one that is set stays."""
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
def _is_stuck(cycle: Record) -> bool:
    """Whether a handle that does not move any more was going on a moment ago.

    Two witnesses have to agree: the model, which knows the torques, but may have the wrong mass;
    and the last two changes of the position, carried on: a handle that was stopped slowed down.
    Three positions that are rounded to counts leave 3 counts open of the change to which they
    carry on, 2·(y[j] − y[j−1]) − (y[j−1] − y[j−2]); the least of it counts.
    """
    last, before = abs(cycle.change), abs(cycle.change_before)
    least = min(last - 1, 2 * last - before - 3)
    went = least * abs(cycle.rad_per_count) * cycle.stuck_cycles
    return min(went, abs(cycle.motion_missed)) > cycle.stuck_limit


@compiled
def _compare_position(cycle: Record, change: int, missed: int) -> None:
    """How far the position is from the one expected; a jump is a trip before it is made use of.

    The estimator expects it where the torques on their way and the force estimated take the
    handle, after `missed` cycles without a sample as well. `change`: of the position [counts].
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
        if cycle.frozen <= cycle.stuck_cycles:
            cycle.motion_missed -= cycle.innovation
    jumped = not abs(cycle.innovation) <= cycle.jump_limit * (1 + missed)
    if jumped and cycle.started and cycle.phase != _LEAVING and cycle.trip == 0:
        position = cycle.counts * cycle.rad_per_count
        inside = cycle.position_low <= position <= cycle.position_high
        cycle.trip = _JUMP if inside else _POSITION


@compiled
def _compare_torque(cycle: Record) -> None:
    """Count the cycles in which 0x6077 is beyond everything that was commanded of late.

    What is remembered of the commands fades within torque_error_cycles, so a current loop that
    lags, or a torque actual value that is filtered, stays between its bounds.
    """
    sent = float(cycle.torque_per_mille)
    fading = 2.0 / cycle.torque_error_cycles
    cycle.highest_sent = max(sent, cycle.highest_sent + fading * (sent - cycle.highest_sent))
    cycle.lowest_sent = min(sent, cycle.lowest_sent + fading * (sent - cycle.lowest_sent))
    actual = float(cycle.torque_actual)
    beyond = max(actual - cycle.highest_sent, cycle.lowest_sent - actual)
    cycle.torque_error = beyond * abs(cycle.nm_per_mille)
    limited = cycle.statusword & _INTERNAL_LIMIT
    if cycle.torque_error > cycle.torque_error_limit and not limited:
        cycle.unfollowed += 1
    else:
        cycle.unfollowed = 0


@compiled
def _wanted_force(cycle: Record, received: bool, due: bool) -> float:
    """Force out of the wall from the instant of actuation on; sets the trip that ends it."""
    if received:
        _watch(cycle)
    elif not cycle.trip:
        return _held_force(cycle)
    if cycle.trip:
        return 0.0
    if cycle.phase == _MEASURING:
        return cycle.orientation * cycle.test_per_mille * cycle.nm_per_mille
    force = _force_of(cycle, cycle.rendered[0], due)
    if cycle.fade_left > 0:
        force = _faded_force(cycle, force, received)
    if not math.isfinite(force):
        cycle.trip = _NAN
        return 0.0
    # A torque that may not change faster than this is held back, on either way.
    before = cycle.orientation * cycle.torque_per_mille * cycle.nm_per_mille
    most = cycle.torque_rate * cycle.period
    return min(max(force, before - most), before + most)


@compiled
def _keep_books(cycle: Record, received: bool) -> None:
    """Energy that the wall has put out in this contact, and the strikes that are over.

    W = Σ f_applied[j]·(y[j+1] − y[j]) (theory, section 5), from the beginning of a contact on.
    """
    oriented = cycle.orientation * cycle.counts * cycle.rad_per_count
    if received:
        cycle.energy_out += cycle.force_applied * (oriented - cycle.oriented)
    cycle.oriented = oriented
    inside = oriented < cycle.orientation * cycle.rendered[0].position
    if not inside and cycle.force_applied == 0.0:
        cycle.energy_out = 0.0
    if cycle.phase != _RENDERING:
        return
    if inside:
        cycle.touched = True
        cycle.outside = 0
    elif cycle.touched:
        cycle.outside += 1
        if cycle.outside > cycle.strike_gap:
            cycle.touched = False
            cycle.strikes += 1


@compiled
def step(cycles: NDArray[np.void], rows: NDArray[np.void], data: int, received: bool) -> int:
    """TPDO data in, RPDO data out (little-endian numbers); fills the row of this cycle.

    cycles has dtype CYCLE and shape (1,), rows ROW and (1,). Without a TPDO (`received` false)
    data is ignored.
    """
    cycle: Record = cycles[0]
    row: Record = rows[0]
    rendered = cycle.rendered[0]
    wall = rendered.wall[0]
    estimator = cycle.estimator[0]
    before, missed = cycle.counts, cycle.missed_in_a_row
    if received:
        read_inputs(cycles, data)
        _compare_torque(cycle)
        cycle.missed_in_a_row = 0
    else:
        cycle.torque_actual = cycle.torque_per_mille
        cycle.missed_in_a_row += 1
        cycle.missed_tpdo += 1
    came_from = cycle.oriented
    _keep_books(cycle, received)
    if received:
        _compare_position(cycle, cycle.counts - before, missed)
        if missed > _BLIND_CYCLES:
            pause = (1 + missed) * cycle.period
            pick_up(estimator, cycle.oriented, (cycle.oriented - came_from) / pause)
        observe(estimator, cycle.oriented)
    active = cycle.phase == _RENDERING or cycle.phase == _MEASURING
    due = _is_due(rendered, received) or (received and not active)
    _look(cycle, rendered, due)

    force = 0.0
    if active:
        force = _wanted_force(cycle, received, due)
    per_mille = to_per_mille(cycle.orientation * force, cycle.nm_per_mille, cycle.torque_limit)
    torque = per_mille * cycle.nm_per_mille
    commit(estimator, cycle.orientation * torque)
    cycle.force_applied = acting_force(estimator)
    if due:
        note_force(wall, cycle.orientation * torque)
        note_force(cycle.faded[0].wall[0], cycle.orientation * torque)
    cycle.torque_per_mille = per_mille

    row.j = cycle.j
    row.t_s = cycle.j * cycle.period
    row.phase = cycle.phase
    row.received = received
    row.counts = cycle.counts
    row.statusword = cycle.statusword
    row.controlword = cycle.controlword
    row.position_rad = cycle.counts * cycle.rad_per_count
    row.y = wall.y_sample
    row.y_est = wall.y
    row.v_est = wall.v
    row.d_est = wall.d
    row.force = force
    row.torque_cmd_per_mille = per_mille
    row.torque_cmd = torque
    row.torque_applied = cycle.orientation * cycle.force_applied
    row.torque_actual = cycle.torque_actual * cycle.nm_per_mille
    row.force_applied = cycle.force_applied
    row.law = rendered.law
    row.stiffness = wall.stiffness
    row.damping = wall.damping
    row.wall_position_rad = rendered.position
    cycle.j += 1
    return _placed(cycle.controlword, cycle.out_controlword[0]) | _placed(
        per_mille, cycle.out_torque[0]
    )
