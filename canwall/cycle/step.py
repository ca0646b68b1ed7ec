"""One cycle from TPDO to RPDO, as one compiled function on one record.

Counts → y → estimator → state at the instant of actuation → law → tension → limits → per mille.
"""

import math

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.cycle.trips import Trip, check_limits, compare_position, compare_torque
from canwall.record import Phase
from canwall.units import to_per_mille
from canwall.walls import (
    acting_force,
    actuation_state,
    correct,
    predict,
    predict_open_loop,
    restart_estimate,
    set_applied_force,
    wall_force,
)

# The enums' values as plain numbers for the compiled code.
_MISSED = int(Trip.MISSED_TPDO)
_NAN = int(Trip.NOT_A_NUMBER)
_RENDERING = int(Phase.RENDERING)
_MEASURING = int(Phase.MEASURING)

#: Cycles without a sample after which the estimator starts again.
_BLIND_CYCLES = 5


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
    """Read position, statusword and torque from a TPDO's data (little-endian number)."""
    cycle: Record = cycles[0]
    cycle.counts = _signed(data, cycle.in_position[0])
    cycle.statusword = _unsigned(data, cycle.in_statusword[0])
    if cycle.in_torque[0].bits:
        cycle.torque_actual = _signed(data, cycle.in_torque[0])
    else:
        cycle.torque_actual = cycle.torque_per_mille


@compiled
def _set_wall_inputs(cycle: Record, rendered: Record, due: bool) -> None:
    """Set position, velocity and bias force relative to the wall.

    The estimator works on the drive's axis, oriented towards the wall, so moving the wall does not
    disturb it. due: True if the law will be evaluated on a new sample.
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
def _advance_divider(rendered: Record, received: bool) -> bool:
    """Count the cycle; return True if the law is due, on every n-th cycle that has a sample."""
    rendered.waited += 1
    if not received or rendered.waited < rendered.divider:
        return False
    rendered.waited = 0
    return True


@compiled
def _force_of(cycle: Record, rendered: Record, due: bool) -> float:
    """Return the force of a wall, evaluated now or held since the last evaluation."""
    if rendered.law < 0:
        return 0.0
    if due:
        # A law that does not return is named by what looks at this cycle from beside it.
        cycle.evaluated = rendered.law + 1
        rendered.force = wall_force(cycle.laws[rendered.law], rendered.wall[0])
        cycle.evaluated = 0
    return rendered.force


@compiled
def _faded_force(cycle: Record, force: float, received: bool) -> float:
    """Blend the force of the previous wall into that of the present one."""
    faded = cycle.faded[0]
    due = _advance_divider(faded, received)
    _set_wall_inputs(cycle, faded, due)
    before = _force_of(cycle, faded, due)
    share = cycle.fade_left / (cycle.fade_cycles + 1.0)
    cycle.fade_left -= 1
    if force == 0.0 and before == 0.0:
        cycle.fade_left = 0
    return force + share * (before - force)


@compiled
def _held_force(cycle: Record) -> float:
    """Return the force without a TPDO, which is held, then ramped to zero, then ends in a trip."""
    held = cycle.orientation * cycle.torque_per_mille * cycle.nm_per_mille
    overdue = cycle.missed_in_a_row - cycle.hold_cycles
    if overdue <= 0:
        return held
    if overdue >= cycle.ramp_cycles:
        cycle.trip = _MISSED
        return 0.0
    return held * (cycle.ramp_cycles - overdue) / (cycle.ramp_cycles - overdue + 1.0)


@compiled
def _wanted_force(cycle: Record, received: bool, due: bool) -> float:
    """Return the force out of the wall from the instant of actuation on; set a trip if any."""
    if received:
        check_limits(cycle)
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
    # The torque rate is limited in both directions.
    before = cycle.orientation * cycle.torque_per_mille * cycle.nm_per_mille
    most = cycle.torque_rate * cycle.period
    return min(max(force, before - most), before + most)


@compiled
def _account_contact(cycle: Record, received: bool) -> None:
    """Account for the energy put out in this contact, and count the strikes that are over.

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
    """Return RPDO data for TPDO data (little-endian numbers), and fill the row of this cycle.

    cycles has dtype CYCLE and shape (1,), rows ROW and (1,). Without a TPDO (`received` False),
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
        compare_torque(cycle)
        cycle.missed_in_a_row = 0
    else:
        cycle.torque_actual = cycle.torque_per_mille
        cycle.missed_in_a_row += 1
        cycle.missed_tpdo += 1
    came_from = cycle.oriented
    _account_contact(cycle, received)
    if received:
        compare_position(cycle, cycle.counts - before, missed)
        if missed > _BLIND_CYCLES:
            pause = (1 + missed) * cycle.period
            restart_estimate(estimator, cycle.oriented, (cycle.oriented - came_from) / pause)
        correct(estimator, cycle.oriented)
    active = cycle.phase == _RENDERING or cycle.phase == _MEASURING
    due = _advance_divider(rendered, received) or (received and not active)
    _set_wall_inputs(cycle, rendered, due)

    force = 0.0
    if active:
        force = _wanted_force(cycle, received, due)
    per_mille = to_per_mille(cycle.orientation * force, cycle.nm_per_mille, cycle.torque_limit)
    torque = per_mille * cycle.nm_per_mille
    sent = cycle.orientation * torque
    if cycle.frozen and cycle.frozen < cycle.stuck_cycles:
        predict_open_loop(estimator, sent)
    predict(estimator, sent)
    cycle.force_applied = acting_force(estimator)
    if due:
        set_applied_force(wall, sent)
        set_applied_force(cycle.faded[0].wall[0], sent)
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
