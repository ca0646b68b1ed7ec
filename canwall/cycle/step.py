"""One cycle from TPDO to RPDO, as one compiled function on one record.

Counts → y → latch → estimator and bank → state at the instant of actuation → law → tension →
passivity → guard → probe → limits → per mille.

It is the largest compiled function. Compiled code calls it by its address: with it compiled into
each of its callers a first start takes 1.4 times as long (docs/results.md).
"""

import functools
import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from canwall.bus.raw_socket import elements
from canwall.compiled import Record, compiled, compiled_for_c
from canwall.cycle.guard import watch
from canwall.cycle.state import CYCLE, RECENT_CYCLES
from canwall.cycle.trips import Trip, check_limits, compare_position, compare_torque, withdraw
from canwall.record import Phase
from canwall.record.columns import ROW
from canwall.units import to_per_mille
from canwall.walls import (
    acting_force,
    actuation_state,
    age_at,
    at_sync,
    change_plant,
    correct,
    correct_bank,
    doubt,
    end_lag,
    expect_torques,
    follow_estimator,
    is_probe_in_flight,
    knows_mass,
    likelier,
    may_lag,
    note_missing_sample,
    other_torque_acts,
    predict,
    predict_bank,
    predict_open_loop,
    put_in_force,
    set_applied_force,
    set_pace,
    spread_in_force,
    stand_still,
    start_lagging,
    stiffest,
    take_over,
    unexplained,
    wall_force,
    with_probe,
)

# The enums' values as plain numbers for the compiled code.
_MISSED = int(Trip.MISSED_TPDO)
_NAN = int(Trip.NOT_A_NUMBER)
_RENDERING = int(Phase.RENDERING)
_MEASURING = int(Phase.MEASURING)
#: A bit for each of the cycles that count as recent.
_RECENT = (1 << RECENT_CYCLES) - 1
#: Logarithm of the likelihood ratio at which it is decided if TPDOs have begun to be a cycle late:
#: at least two samples.
_LAG_EVIDENCE = 15.0
#: Share of it that counts in a contact of a hand whose mass was not known: both models are off.
_LAG_SHARE_OF_UNKNOWN = 0.75
#: Share of what neither explains that is exchanged with a sample.
_LAG_NOISE_SHARE = 0.15
#: Deviation of ln(mass) below which a mass that was not known then is, in spite of the doubt about
#: the delay.
_WELL_KNOWN_SPREAD = 0.05

#: Addresses of cycle and row, data, and `received`, as `_step` takes them.
_STEP_ARGUMENTS = types.uint64, types.uint64, types.int64, types.boolean


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
def _unwrapped(value: int, before: int, bits: int) -> int:
    """Return the value that is nearest to the one before, of all that have the same bits."""
    half = 1 << (bits - 1)
    return before + ((value - before + half) & ((1 << bits) - 1)) - half


@compiled
def read_inputs(cycles: NDArray[np.void], data: int) -> None:
    """Read position, statusword and torque from a TPDO's data (little-endian number).

    A position that overflows goes on: a motor that always turns one way reaches the end of
    0x6064's 32 bits.
    """
    cycle: Record = cycles[0]
    counts = _signed(data, cycle.in_position[0])
    if cycle.started:
        counts = _unwrapped(counts, cycle.counts, cycle.in_position[0].bits)
    cycle.counts = counts
    cycle.statusword = _unsigned(data, cycle.in_statusword[0])
    if cycle.in_torque[0].bits:
        cycle.torque_actual = _signed(data, cycle.in_torque[0])
    else:
        cycle.torque_actual = cycle.torque_per_mille


@compiled
def _surface(cycle: Record, rendered: Record) -> float:
    """Return the position of the surface on the drive's axis, oriented towards the wall [rad]."""
    return cycle.orientation * rendered.position


@compiled
def _set_wall_inputs(cycle: Record, rendered: Record, sample: float, due: bool) -> None:
    """Set position, velocity and bias force relative to the wall.

    The estimator works on the drive's axis, oriented towards the wall, so moving the wall does not
    disturb it. sample: position on that axis [rad]. due: True if the law will be evaluated on a new
    sample.
    """
    wall, estimator = rendered.wall[0], cycle.estimator[0]
    origin = _surface(cycle, rendered)
    wall.y_sample = sample - origin
    rendered.elapsed += cycle.period
    if due:
        wall.v_sample = (sample - rendered.y_before) / rendered.elapsed
        rendered.y_before = sample
        rendered.elapsed = 0.0
    if rendered.estimated_velocity:
        wall.v_sample = estimator.v
    y, wall.v = actuation_state(estimator)
    wall.y = y - origin
    wall.d = estimator.d - wall.spring * origin
    if due:
        put_in_force(wall)


@compiled
def _identify_operator(cycle: Record, sample: float) -> None:
    """Let the bank learn from the sample; the walls' laws get the mass that it finds."""
    bank, estimator, rendered = cycle.bank[0], cycle.estimator[0], cycle.rendered[0]
    wall = rendered.wall[0]
    set_pace(bank, wall.stiffness, _surface(cycle, rendered))
    if correct_bank(bank, estimator, sample):
        change_plant(wall, estimator.mass, estimator.viscous)
        wall.stiffest = stiffest(bank)
        if cycle.fade_left > 0:
            faded = cycle.faded[0].wall[0]
            change_plant(faded, estimator.mass, estimator.viscous)
            faded.stiffest = min(faded.stiffest, wall.stiffest)
        if cycle.compares_lag and not cycle.keeps_mass:
            take_over(bank, cycle.lagging[0])
            take_over(bank, cycle.losing[0])
            cycle.keeps_mass = 0.0 < bank.spread < _WELL_KNOWN_SPREAD
    wall.doubt = doubt(bank)


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
    return cycle.share * cycle.guard[0].factor * rendered.force


@compiled
def _faded_force(cycle: Record, force: float) -> float:
    """Blend the force of the previous wall into that of the present one."""
    faded = cycle.faded[0]
    due = _advance_divider(faded, True)
    _set_wall_inputs(cycle, faded, cycle.oriented, due)
    before = _force_of(cycle, faded, due)
    share = cycle.fade_left / (cycle.fade_cycles + 1.0)
    cycle.fade_left -= 1
    outside = faded.wall[0].y_sample >= 0.0 and cycle.rendered[0].wall[0].y_sample >= 0.0
    if outside and force == 0.0 and before == 0.0:
        cycle.fade_left = 0
    return force + share * (before - force)


@compiled
def _blind_force(cycle: Record, held: float) -> float:
    """Return the force of the law at the position that the estimator predicts.

    To hold the force of a handle that is on its way out would put energy into it, and so would a
    force that begins only after the handle has gone in.
    """
    if cycle.phase != _RENDERING or cycle.fade_left > 0:
        return held
    if not cycle.is_blind:
        cycle.blind[0] = cycle.rendered[0]
        # Counted with the wall in this cycle already.
        cycle.blind[0].elapsed -= cycle.period
        cycle.blind[0].waited -= 1
        cycle.is_blind = True
    blind = cycle.blind[0]
    due = _advance_divider(blind, True)
    _set_wall_inputs(cycle, blind, cycle.estimator[0].y, due)
    force = _force_of(cycle, blind, due)
    if due:
        set_applied_force(blind.wall[0], force)
    return force if math.isfinite(force) else held


@compiled
def _force_without_tpdo(cycle: Record) -> float:
    """Return the force of the blind law, which after hold_cycles only falls, and ends in a trip."""
    held = cycle.orientation * cycle.torque_per_mille * cycle.nm_per_mille
    overdue = cycle.missed_in_a_row - cycle.hold_cycles
    if overdue >= cycle.ramp_cycles:
        cycle.trip = _MISSED
        return 0.0
    force = _blind_force(cycle, held)
    if overdue <= 0:
        return force
    ramped = held * (cycle.ramp_cycles - overdue) / (cycle.ramp_cycles - overdue + 1.0)
    return min(max(force, min(ramped, 0.0)), max(ramped, 0.0))


@compiled
def _force_with_tpdo(cycle: Record, due: bool) -> float:
    """Return the force of the law on a new sample, or of the test; set a trip if any."""
    check_limits(cycle)
    if cycle.trip:
        return 0.0
    if cycle.phase == _MEASURING:
        return cycle.orientation * cycle.test_per_mille * cycle.nm_per_mille
    force = _force_of(cycle, cycle.rendered[0], due)
    if cycle.fade_left > 0:
        force = _faded_force(cycle, force)
    if not math.isfinite(force):
        cycle.trip = _NAN
        return 0.0
    if cycle.bank[0].count > 0 and not cycle.rendered[0].sampled:
        force = with_probe(cycle.bank[0], cycle.rendered[0].wall[0], force)
    return force


@compiled
def _wanted_force(cycle: Record, received: bool, due: bool) -> float:
    """Return the force out of the wall from the instant of actuation on; set a trip if any."""
    if received:
        force = _force_with_tpdo(cycle, due)
    elif not cycle.trip:
        force = _force_without_tpdo(cycle)
    else:
        force = 0.0
    ramping = cycle.missed_in_a_row > cycle.hold_cycles
    if cycle.trip or ramping or cycle.phase == _MEASURING:
        return force
    # The torque rate is limited in both directions.
    before = cycle.orientation * cycle.torque_per_mille * cycle.nm_per_mille
    most = cycle.torque_rate * cycle.period
    return min(max(force, before - most), before + most)


@compiled
def _torque_limit(cycle: Record) -> float:
    """Return the limit of this torque; one that has been lowered is reached at the torque rate."""
    before = abs(cycle.torque_per_mille * cycle.nm_per_mille)
    return max(cycle.torque_limit, before - cycle.torque_rate * cycle.period)


@compiled
def _account_contact(cycle: Record, received: bool) -> None:
    """Account for the energy put out in this contact, and count the strikes that are over.

    W = Σ f_applied[j]·(y[j+1] − y[j]) (docs/results.md), from the beginning of a contact on.
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
def _stand_still(cycle: Record) -> int:
    """Let the handle go on through SYNCs that were skipped; return their number."""
    skipped = cycle.skipped
    if skipped:
        cycle.skipped = 0
        cycle.skipped_sync += skipped
        cycle.rendered[0].elapsed += skipped * cycle.period
        cycle.faded[0].elapsed += skipped * cycle.period
        cycle.blind[0].elapsed += skipped * cycle.period
        stand_still(cycle.estimator[0], skipped)
        # A TPDO that is a cycle late has come meanwhile.
        cycle.compares_lag = False
    return skipped


@compiled
def _may_begin_to_lag(cycle: Record) -> bool:
    """Keep the estimator as it would be if the TPDO that is missing comes with the next SYNC.

    If all later ones are as late, only the motion shows it: there is one TPDO for each SYNC again.
    """
    estimator = cycle.estimator[0]
    known = cycle.compares_lag and cycle.lag_evidence > 0.0
    if known:
        note_missing_sample(cycle.lagging[0])
        note_missing_sample(cycle.losing[0])
    if known or not cycle.started or not may_lag(estimator):
        return False
    cycle.lagging[0] = estimator
    cycle.compares_lag = True
    cycle.keeps_mass = knows_mass(cycle.bank[0])
    cycle.lag_evidence = cycle.lag_noise = 0.0
    return True


@compiled
def _sync_of_sample(cycle: Record) -> int:
    """Return the number of the SYNC at which this cycle's sample was taken, as the drive counts."""
    return cycle.j + cycle.skipped_sync - cycle.lag


@compiled
def _go_on_lagging(cycle: Record) -> None:
    """Put the estimator for TPDOs that are late in force, with the bank's mass."""
    cycle.estimator[0] = cycle.lagging[0]
    if cycle.bank[0].count > 0:
        take_over(cycle.bank[0], cycle.estimator[0])


@compiled
def _compare_lag(cycle: Record, moves: bool) -> None:
    """Compare the sample with both predictions, and go on with the likelier one in the end.

    moves: True if the sample is another one than the last: a handle that sticks stays where it is,
    whatever either expects.
    """
    lagging, losing = cycle.lagging[0], cycle.losing[0]
    probe, estimator = cycle.bank[0].probe[0], cycle.estimator[0]
    pressed = other_torque_acts(probe, estimator.in_flight, estimator.delay_periods)
    # What a probe alone moves tells who is at the handle, whom neither model knows yet.
    if moves and (pressed or not is_probe_in_flight(probe)):
        square = unexplained(lagging, losing, cycle.oriented)
        cycle.lag_noise += _LAG_NOISE_SHARE * (square - cycle.lag_noise)
        share = _LAG_SHARE_OF_UNKNOWN if pressed and not cycle.keeps_mass else 1.0
        cycle.lag_evidence += share * likelier(lagging, losing, cycle.oriented, cycle.lag_noise)
    if cycle.lag_evidence > _LAG_EVIDENCE:
        _go_on_lagging(cycle)
        follow_estimator(cycle.bank[0], lagging)
        cycle.lag += 1
    if abs(cycle.lag_evidence) > _LAG_EVIDENCE:
        cycle.compares_lag = False
    else:
        correct(lagging, cycle.oriented)
        correct(losing, cycle.oriented)


@compiled
def _end_lag(cycle: Record) -> None:
    """Let the lag end with a second TPDO in a cycle: the first was one of the SYNC before."""
    if not cycle.overtaken:
        return
    cycle.overtaken = False
    if cycle.compares_lag:
        cycle.compares_lag = False
        if cycle.lag_evidence > 0.0:
            _go_on_lagging(cycle)
            end_lag(cycle.estimator[0])
    elif cycle.lag:
        end_lag(cycle.estimator[0])
        cycle.lag -= 1


@compiled
def _fill_row(cycle: Record, row: Record, received: bool, demanded: float, applied: float) -> None:
    """Fill the row of this cycle.

    demanded: force of the law, without the probe [N·m]. applied: force in force, with it [N·m].
    """
    rendered, estimator = cycle.rendered[0], cycle.estimator[0]
    wall = rendered.wall[0]
    row.j = cycle.j
    row.t_s = cycle.j * cycle.period
    row.phase = cycle.phase
    row.received = received
    row.counts = cycle.counts
    row.statusword = cycle.statusword
    row.controlword = cycle.controlword
    row.position_rad = cycle.counts * cycle.rad_per_count
    row.y = wall.y_sample
    # To the estimator the first position of all is a jump.
    row.y_est = wall.y if cycle.started else wall.y_sample
    row.v_est = wall.v if cycle.started else 0.0
    row.d_est = wall.d if cycle.started else 0.0
    row.force = demanded
    row.torque_cmd_per_mille = cycle.torque_per_mille
    row.torque_cmd = cycle.torque_per_mille * cycle.nm_per_mille
    row.torque_applied = cycle.orientation * applied
    row.torque_actual = cycle.torque_actual * cycle.nm_per_mille
    row.force_applied = cycle.force_applied
    row.law = rendered.law
    row.stiffness = wall.asked_stiffness
    row.damping = wall.damping
    row.damping_ratio = wall.damping_ratio
    row.cap = wall.cap
    row.stiffness_in_force = cycle.share * cycle.guard[0].factor * wall.stiffness
    row.mass_est = estimator.mass
    row.mass_spread = cycle.bank[0].spread
    row.delay_est = estimator.told + cycle.bank[0].regression[0].excess
    row.wall_position_rad = rendered.position
    row.guard = cycle.guard[0].factor


def step(cycles: NDArray[np.void], rows: NDArray[np.void], data: int, received: bool) -> int:
    """Return RPDO data for TPDO data (little-endian numbers), and fill the row of this cycle.

    cycles has dtype CYCLE and shape (1,), rows ROW and (1,). Without a TPDO (`received` False),
    data is ignored. Compiled code calls `step_at`.
    """
    return step_at(step_address(), cycles, rows, data, received)


def step_address() -> int:
    """Return the address of the compiled step in this process; compiled or loaded at first use."""
    return int(_step_function().address)


@functools.cache
def _step_function() -> Any:
    """Return `_step` as a C function, which lives as long as this process."""
    return compiled_for_c(_step, types.int64(*_STEP_ARGUMENTS))


@intrinsic  # type: ignore[untyped-decorator]
def _call_step(typingctx: Any, address: Any, cycle: Any, row: Any, data: Any, received: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        taken = [context.get_value_type(argument) for argument in _STEP_ARGUMENTS]
        function = ir.FunctionType(context.get_value_type(types.int64), taken)
        return builder.call(builder.inttoptr(arguments[0], function.as_pointer()), arguments[1:])

    return types.int64(types.uint64, *_STEP_ARGUMENTS), codegen


@compiled
def step_at(
    address: int, cycles: NDArray[np.void], rows: NDArray[np.void], data: int, received: bool
) -> int:
    """Call `step`, which is at `step_address()`, from compiled code."""
    return _call_step(address, cycles.ctypes.data, rows.ctypes.data, data, received)


@compiled
def _step(cycle_address: int, row_address: int, data: int, received: bool) -> int:
    """Do what `step` says, for the records at these addresses."""
    cycles, rows = elements(cycle_address, 1, CYCLE), elements(row_address, 1, ROW)
    cycle: Record = cycles[0]
    rendered = cycle.rendered[0]
    wall = rendered.wall[0]
    estimator = cycle.estimator[0]
    skipped = _stand_still(cycle)
    _end_lag(cycle)
    withdraw(cycle)
    before, missed = cycle.counts, cycle.missed_in_a_row + skipped
    cycle.missed_recently = (cycle.missed_recently << 1) & _RECENT
    if received:
        read_inputs(cycles, data)
        compare_torque(cycle)
        cycle.missed_in_a_row = 0
        cycle.is_blind = False
    else:
        cycle.torque_actual = cycle.torque_per_mille
        cycle.faded[0].elapsed += cycle.period
        cycle.faded[0].waited += 1
        cycle.missed_in_a_row += 1
        cycle.missed_tpdo += 1
        cycle.missed_recently |= 1
    _account_contact(cycle, received)
    watch(
        cycle.guard[0],
        cycle.j,
        cycle.oriented,
        _surface(cycle, rendered),
        cycle.force_applied,
        received and cycle.phase == _RENDERING,
    )
    begins_lag = False
    if received:
        compare_position(cycle, cycle.counts - before, missed)
        if cycle.compares_lag:
            _compare_lag(cycle, cycle.counts != before)
        spread = spread_in_force(cycle.bank[0])
        sample = at_sync(cycle.latch[0], estimator, spread, _sync_of_sample(cycle), cycle.oriented)
        correct(estimator, sample)
        if cycle.bank[0].count > 0:
            _identify_operator(cycle, sample)
    else:
        begins_lag = _may_begin_to_lag(cycle)
        note_missing_sample(estimator)
    active = cycle.phase == _RENDERING or cycle.phase == _MEASURING
    due = _advance_divider(rendered, received) or (received and not active)
    _set_wall_inputs(cycle, rendered, cycle.oriented, due)

    force = 0.0
    if active:
        force = _wanted_force(cycle, received, due)
    demanded = 0.0 if cycle.bank[0].probe[0].acts else force
    limit = _torque_limit(cycle)
    per_mille = to_per_mille(cycle.orientation * force, cycle.nm_per_mille, limit)
    sent = cycle.orientation * per_mille * cycle.nm_per_mille
    if cycle.frozen and cycle.frozen < cycle.stuck_cycles:
        predict_open_loop(estimator, sent)
    excess = cycle.bank[0].regression[0].excess
    expect_torques(cycle.latch[0], estimator, estimator.told + excess, sent)
    if cycle.bank[0].count > 0:
        age = age_at(cycle.latch[0], _sync_of_sample(cycle))
        predict_bank(cycle.bank[0], estimator, sent, age)
    predict(estimator, sent)
    if begins_lag:
        start_lagging(cycle.lagging[0], sent)
        cycle.losing[0] = estimator
    elif cycle.compares_lag:
        predict(cycle.lagging[0], sent)
        predict(cycle.losing[0], sent)
    applied = acting_force(estimator, estimator.in_flight)
    probes = cycle.bank[0].probe[0].in_flight
    # What shows who is coming is no force of the wall, nor is what shows the delay.
    measures = cycle.phase == _MEASURING
    cycle.force_applied = 0.0 if measures else applied - acting_force(estimator, probes)
    if due:
        set_applied_force(wall, sent - probes[0])
        set_applied_force(cycle.faded[0].wall[0], sent - probes[0])
    cycle.torque_per_mille = per_mille

    _fill_row(cycle, rows[0], received, demanded, applied)
    cycle.j += 1
    return _placed(cycle.controlword, cycle.out_controlword[0]) | _placed(
        per_mille, cycle.out_torque[0]
    )
