"""One cycle between the two frames: TPDO in, RPDO out, as one compiled function over one record.

Counts → y → estimator → state at the instant of actuation → law → tension → limits → per mille.
"""

import math
from collections.abc import Sequence
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.config import Settings, Wall
from canwall.drive import DriveSetup, PdoLayout, State
from canwall.drive import objects as od
from canwall.record import Phase
from canwall.units import to_per_mille
from canwall.walls import (
    ESTIMATOR,
    TENSION,
    WALL,
    Law,
    actuation_state,
    commit,
    find_law,
    forget,
    note_force,
    observe,
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


# The enums' values as plain numbers for the compiled code.
_RENDERING = int(Phase.RENDERING)
_SPEED = int(Trip.SPEED)
_POSITION = int(Trip.POSITION)
_MISSED = int(Trip.MISSED_TPDO)
_NOT_ENABLED = int(Trip.NOT_ENABLED)
_NAN = int(Trip.NOT_A_NUMBER)
_ENABLED_MASK, _ENABLED_VALUE = State.OPERATION_ENABLED.value

_FIELD = [("shift", "i8"), ("bits", "i8")]

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
        ("torque_limit", "f8"),
        ("speed_limit", "f8"),
        ("position_low", "f8"),
        ("position_high", "f8"),
        ("hold_cycles", "i8"),
        ("ramp_cycles", "i8"),
        # The wall.
        ("orientation", "f8"),
        ("wall_position", "f8"),
        ("estimated_velocity", "?"),
        ("law", "i8"),
        ("laws", "u8", (MAX_LAWS,)),
        ("wall", WALL, (1,)),
        ("estimator", ESTIMATOR, (1,)),
        # What the loop asks for.
        ("phase", "i8"),
        ("controlword", "i8"),
        # State.
        ("j", "i8"),
        ("counts", "i8"),
        ("statusword", "i8"),
        ("torque_actual", "i8"),
        ("y_before", "f8"),
        ("torque_per_mille", "i8"),
        ("missed_in_a_row", "i8"),
        # Results.
        ("trip", "i8"),
        ("missed_tpdo", "i8"),
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
    units, mechanics, limits = setup.units, settings.mechanics, settings.limits
    period = settings.bus.cycle_s
    cycle["period"] = period
    cycle["rad_per_count"] = units.rad_per_count
    cycle["nm_per_mille"] = units.nm_per_mille
    cycle["torque_limit"] = min(limits.torque_nm, setup.torque_limit_nm)
    cycle["speed_limit"] = limits.speed_rad_s
    cycle["position_low"], cycle["position_high"] = limits.position_rad
    cycle["hold_cycles"] = limits.hold_cycles
    cycle["ramp_cycles"] = limits.ramp_cycles
    for i, law in enumerate(laws):
        cycle["laws"][0, i] = law.address
    mass, viscous = mechanics.inertia_kg_m2, mechanics.viscous_nm_s_per_rad
    spring = mechanics.spring_nm_per_rad
    set_plant(cycle["wall"][0], mass, viscous, spring, period)
    set_estimator(
        cycle["estimator"][0],
        mass,
        viscous,
        spring,
        mechanics.coulomb_nm,
        period,
        count=units.rad_per_count,
        force_walk=settings.estimator.force_walk_nm_per_sqrt_s,
        delay=SYNCHRONOUS_DELAY,
    )
    set_wall(cycle, settings.wall, laws)
    return cycle


def _set_field(cycle: NDArray[np.void], name: str, layout: PdoLayout, index: int) -> None:
    field = layout.field(index)
    if field is not None:
        cycle[name]["shift"], cycle[name]["bits"] = field.shift, field.bits


def set_wall(cycle: NDArray[np.void], wall: Wall, laws: Sequence[Law]) -> None:
    """Change the wall between two cycles; its law is one of `laws`. Raises UnknownLawError."""
    cycle["orientation"] = 1.0 if wall.side == "below" else -1.0
    cycle["wall_position"] = wall.position_rad
    cycle["estimated_velocity"] = wall.velocity == "estimated"
    law = find_law(wall.law, wall.deadbeat)
    rendered = cycle["wall"][0]
    set_referent(
        rendered,
        wall.stiffness_nm_per_rad,
        wall.damping_nm_s_per_rad,
        law.option_values(wall.options),
    )
    rendered["tension"] = TENSION[wall.tension]
    rendered["passivity_damping"] = wall.passivity_nm_s_per_rad
    index = [known.name for known in laws].index(law.name)
    if index != cycle["law"][0]:
        cycle["law"] = index
        forget(rendered)


def start_at(cycle: NDArray[np.void], counts: int) -> None:
    """Begin at rest at a position: the first that the drive reports."""
    oriented = cycle["orientation"][0] * counts * cycle["rad_per_count"][0]
    reset_estimator(cycle["estimator"][0], oriented)
    cycle["y_before"] = oriented


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
def _wanted_force(cycle: Record, received: bool) -> float:
    """Force out of the wall from the instant of actuation on; sets the trip that ends it."""
    if not received:
        # Hold the torque, then let go of it along a ramp, then give up.
        held = cycle.orientation * cycle.torque_per_mille * cycle.nm_per_mille
        overdue = cycle.missed_in_a_row - cycle.hold_cycles
        if overdue <= 0:
            return held
        if overdue >= cycle.ramp_cycles:
            cycle.trip = _MISSED
            return 0.0
        return held * (cycle.ramp_cycles - overdue) / (cycle.ramp_cycles - overdue + 1.0)
    position = cycle.counts * cycle.rad_per_count
    if not cycle.position_low <= position <= cycle.position_high:
        cycle.trip = _POSITION
    elif not abs(cycle.estimator[0].v) <= cycle.speed_limit:
        cycle.trip = _SPEED
    elif cycle.statusword & _ENABLED_MASK != _ENABLED_VALUE:
        cycle.trip = _NOT_ENABLED
    if cycle.trip:
        return 0.0
    force = wall_force(cycle.laws[cycle.law], cycle.wall[0])
    if not math.isfinite(force):
        cycle.trip = _NAN
        return 0.0
    return force


@compiled
def step(cycles: NDArray[np.void], rows: NDArray[np.void], data: int, received: bool) -> int:
    """TPDO data in, RPDO data out (little-endian numbers); fills the row of this cycle.

    cycles has dtype CYCLE and shape (1,), rows ROW and (1,). Without a TPDO (`received` false)
    data is ignored.
    """
    cycle: Record = cycles[0]
    row: Record = rows[0]
    wall = cycle.wall[0]
    estimator = cycle.estimator[0]
    elapsed = cycle.period
    if received:
        read_inputs(cycles, data)
        elapsed *= 1 + cycle.missed_in_a_row
        cycle.missed_in_a_row = 0
    else:
        cycle.torque_actual = cycle.torque_per_mille
        cycle.missed_in_a_row += 1
        cycle.missed_tpdo += 1

    # The estimator works on the drive's axis, turned towards the wall: it does not notice when
    # the wall is moved. What the laws see is relative to the wall.
    oriented = cycle.orientation * cycle.counts * cycle.rad_per_count
    origin = cycle.orientation * cycle.wall_position
    if received:
        observe(estimator, oriented)
    wall.y_sample = oriented - origin
    wall.v_sample = (oriented - cycle.y_before) / elapsed
    if cycle.estimated_velocity:
        wall.v_sample = estimator.v
    cycle.y_before = oriented
    y, wall.v = actuation_state(estimator)
    wall.y = y - origin
    wall.d = estimator.d - wall.spring * origin

    force = 0.0
    if cycle.phase == _RENDERING:
        force = _wanted_force(cycle, received)
    torque_applied = cycle.torque_actual * cycle.nm_per_mille
    per_mille = to_per_mille(cycle.orientation * force, cycle.nm_per_mille, cycle.torque_limit)
    torque = per_mille * cycle.nm_per_mille
    commit(estimator, cycle.orientation * torque)
    note_force(wall, cycle.orientation * torque)
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
    row.torque_applied = torque_applied
    row.force_applied = cycle.orientation * torque_applied
    row.law = cycle.law
    row.stiffness = wall.stiffness
    row.damping = wall.damping
    row.wall_position_rad = cycle.wall_position
    cycle.j += 1
    return _placed(cycle.controlword, cycle.out_controlword[0]) | _placed(
        per_mille, cycle.out_torque[0]
    )
