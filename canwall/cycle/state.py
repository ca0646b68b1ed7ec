"""Record of one wall on one drive (settings, state and results), and functions that set it.

The step (`step.py`) works on it; the functions here are for use between two cycles.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from canwall.analysis.felt import handle_radius
from canwall.analysis.metrics import STRIKE_GAP_S
from canwall.config import ConfigError, Guard, Limits, Operator, Settings, Wall
from canwall.cycle.guard import GUARD, change_guard, set_guard
from canwall.drive import DriveSetup, PdoLayout
from canwall.drive import objects as od
from canwall.walls import (
    BANK,
    ESTIMATOR,
    LATCH,
    MAX_DELAY,
    TENSION,
    WALL,
    ElasticShaft,
    Law,
    WallLoop,
    clear_memory,
    find_law,
    force_walk_of,
    hand_damping,
    lightest_bandwidth,
    reset_bank,
    reset_estimator,
    reset_latch,
    set_bank,
    set_estimator,
    set_latch,
    set_plant,
    set_referent,
    stiffest_wall,
    stiffest_walls,
)

#: Largest number of laws in a run.
MAX_LAWS = 16

#: Cycles that count for the question if TPDOs have been missing of late.
RECENT_CYCLES = 50

#: Delay of a torque carried by a synchronous RPDO (docs/laws.md).
SYNCHRONOUS_DELAY = 1.0

#: Largest bandwidth of a filter on an elastic shaft, as a part of the resonance.
_FILTER_PART = 0.125
#: What the model has more than the delay that is told, but for a plain filter [periods].
_DELAY_MARGIN = 0.1
#: Missed motion below this is ignored, since a coarse encoder stays on one count for long [counts].
_STUCK_COUNTS = 8
#: Tolerance for rounding, one count at each end of a cycle.
_JUMP_COUNTS = 2
#: Defaults of [limits] torque_error_nm: part of torque_nm, and per mille of the rated torque.
_TORQUE_ERROR_PART, _TORQUE_ERROR_PER_MILLE = 0.1, 50.0

_FIELD = [("shift", "i8"), ("bits", "i8")]

#: No law: the wall is absent and gives no force.
NO_LAW = -1

#: A wall on the drive's axis, and the law that renders it.
RENDERED = np.dtype(
    [
        ("law", "i8"),  # index into the laws of the cycle
        ("sampled", "?"),  # it goes by no model
        ("position", "f8"),
        ("estimated_velocity", "?"),
        ("divider", "i8"),  # cycles from one evaluation of the law to the next
        ("wall", WALL, (1,)),
        # DriveState: cycles since the law was evaluated, its force, its sample, the time since.
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
        # Positions of the values in the frames' data; bits = 0: not carried.
        ("in_position", _FIELD, (1,)),
        ("in_statusword", _FIELD, (1,)),
        ("in_torque", _FIELD, (1,)),
        ("out_controlword", _FIELD, (1,)),
        ("out_torque", _FIELD, (1,)),
        # Scales and limits.
        ("period", "f8"),
        # Scales of the drive, both above zero: on reversed drives a wall would pull.
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
        # The wall, and the previous one while they are blended.
        ("orientation", "f8"),
        ("laws", "u8", (MAX_LAWS,)),
        ("rendered", RENDERED, (1,)),
        ("faded", RENDERED, (1,)),
        ("evaluated", "i8"),  # law that is being evaluated, counted from 1; 0: none
        ("fade_cycles", "i8"),
        ("fade_left", "i8"),
        # The wall as it goes on without TPDOs, at the positions that the estimator predicts.
        ("blind", RENDERED, (1,)),
        ("is_blind", "?"),
        ("guard", GUARD, (1,)),
        ("estimator", ESTIMATOR, (1,)),
        ("bank", BANK, (1,)),
        ("latch", LATCH, (1,)),
        ("shaft", "f8", (5,)),  # fields of ElasticShaft; zero: rigid
        # The estimator for TPDOs that are a cycle late since one was missing, and the one for a
        # TPDO that was lost, both without the bank: while they are being compared, how much
        # likelier the first has been; the number of cycles that was found. A mass that was known
        # is kept meanwhile: what the bank finds now rests on one of the two.
        ("lagging", ESTIMATOR, (1,)),
        ("losing", ESTIMATOR, (1,)),
        ("compares_lag", "?"),
        ("keeps_mass", "?"),
        ("lag_evidence", "f8"),
        ("lag_noise", "f8"),  # mean square of what neither explains [rad²]
        ("lag", "i8"),
        # Requests of the loop.
        ("phase", "i8"),
        ("controlword", "i8"),
        ("test_per_mille", "i8"),
        # Part of the wall's force that is left, and how much of it goes in a cycle, as the wall
        # is withdrawn.
        ("share", "f8"),
        ("share_falls", "f8"),
        # Reports of the transport: SYNCs skipped before this one; a second TPDO since the last one.
        ("skipped", "i8"),
        ("overtaken", "?"),
        # DriveState.
        ("j", "i8"),
        ("counts", "i8"),
        ("statusword", "i8"),
        ("torque_actual", "i8"),
        ("torque_per_mille", "i8"),
        ("missed_in_a_row", "i8"),
        ("missed_recently", "i8"),  # a bit for each of the last RECENT_CYCLES, 1 if missing
        # True once the estimator has a position; its last prediction error.
        ("started", "?"),
        ("innovation", "f8"),
        # Cycles since the position last changed, the last two changes [counts per cycle], and the
        # travel in that direction that the model has predicted since [rad].
        ("frozen", "i8"),
        ("change", "i8"),
        ("change_before", "i8"),
        ("motion_missed", "f8"),
        # Highest and lowest recently commanded torque [per mille]; cycles for which the torque
        # actual value has been outside this range, and by how much [N·m].
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
        ("skipped_sync", "i8"),
        ("strikes", "i8"),
    ],
    align=True,
)


def make_cycle(settings: Settings, setup: DriveSetup, laws: Sequence[Law]) -> NDArray[np.void]:
    """Return the record of one wall, ready for its first cycle; shape (1,), dtype CYCLE.

    `laws` are the laws of the run; the `law` in a row is an index into them. Raises
    UnknownLawError for options that a law does not have.
    """
    cycle = np.zeros(1, CYCLE)
    cycle["share"] = 1.0
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
    set_delay(cycle, settings, modelled_delay(settings))
    set_limits(cycle, settings.limits)
    set_guard(cycle["guard"][0], settings.guard.action, period, setup.units.rad_per_count)
    mass, viscous, spring = _model(settings)
    if _plain_walk(settings) is None:
        masses, dampings = _hands(settings)
        mass, viscous = masses[0], dampings[0]
    device = settings.mechanics.viscous_nm_s_per_rad
    set_plant(cycle["rendered"][0]["wall"][0], mass, viscous, spring, period, device)
    cycle["rendered"]["law"] = NO_LAW
    set_wall(cycle, settings.wall, laws)
    return cycle


def _model(settings: Settings) -> tuple[float, float, float]:
    """Return mass, viscous damping and spring of `[mechanics]`."""
    mechanics = settings.mechanics
    return mechanics.inertia_kg_m2, mechanics.viscous_nm_s_per_rad, mechanics.spring_nm_per_rad


def modelled_delay(settings: Settings) -> float:
    """Return D as configured, with the drive's own cycle and current loop added [periods].

    A first-order lag counts as its time constant (docs/laws.md). Raises ConfigError for a
    delay of more than MAX_DELAY.
    """
    drive, delay = settings.drive, settings.estimator.delay_cycles
    lag_s = 0.0
    if drive.current_bandwidth_hz:
        lag_s = 1.0 / (2.0 * math.pi * drive.current_bandwidth_hz)
    bus, period = SYNCHRONOUS_DELAY if delay is None else delay, settings.bus.cycle_s
    delay = bus + (drive.drive_cycle_s + lag_s) / period
    if delay > MAX_DELAY:
        raise ConfigError(
            f"a torque acts {delay:.3g} cycles after its sample, {MAX_DELAY} at most: {bus:.3g} of "
            f"estimator.delay_cycles, {drive.drive_cycle_s / period:.3g} of drive.drive_cycle_s, "
            f"{lag_s / period:.3g} of drive.current_bandwidth_hz; correct what is wrong of them, "
            f"or give a longer bus.cycle_s"
        )
    return delay


def _plain_walk(settings: Settings) -> float | None:
    """Return the random walk of the force in a plain filter, None where there is a bank."""
    return None if settings.operator.adapt else settings.estimator.force_walk_nm_per_sqrt_s


def _hands(settings: Settings) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return masses and viscous dampings of the bank: the drive with lighter and heavier hands.

    Of a hand that is known they are those of `[mechanics]`.
    """
    operator, mechanics = settings.operator, settings.mechanics
    if not operator.adapt:
        mass, viscous, _ = _model(settings)
        return np.array([mass]), np.array([viscous])
    masses = np.geomspace(*settings.masses, operator.filters)
    hands = [
        hand_damping(max(mass - mechanics.inertia_kg_m2, 0.0), operator.damping_nm_s_per_rad)
        for mass in masses.tolist()
    ]
    return masses, mechanics.viscous_nm_s_per_rad + np.array(hands)


def set_delay(cycle: NDArray[np.void], settings: Settings, delay: float) -> None:
    """Reset the estimator for a delay of `delay` periods, and its margin. Raises ValueError."""
    margin = settings.estimator.delay_margin_cycles
    if margin is None:
        margin = _DELAY_MARGIN if _plain_walk(settings) is None else 0.0
    margin = max(min(margin, MAX_DELAY - delay), 0.0)
    delay += margin
    mass, viscous, spring = _model(settings)
    coulomb, period = settings.mechanics.coulomb_nm, settings.bus.cycle_s
    count = float(cycle["rad_per_count"][0])
    shaft = _shaft(settings)
    cycle["shaft"] = shaft or 0.0
    bandwidth = _FILTER_PART * 2.0 * math.pi * shaft.resonance_hz if shaft else math.inf
    force_walk = _plain_walk(settings)
    if force_walk is None:
        masses, dampings = _hands(settings)
        mass, viscous, coulomb = masses[0], dampings[0], 0.0
        lightest = lightest_bandwidth(delay, period)
        if bandwidth < lightest:
            # The shaft makes the filters slow. With a damping that a hand lacks they would let it
            # swing in the wall.
            dampings[:] = viscous
        bandwidth = min(bandwidth, lightest)
        force_walk = force_walk_of(bandwidth, mass, period, count)
        set_bank(
            cycle["bank"][0],
            masses,
            dampings,
            spring,
            period,
            count,
            force_walk,
            delay,
            shaft,
            margin,
            handle_radius(settings.mechanics.handle_radius_m),
        )
    set_estimator(
        cycle["estimator"][0],
        mass,
        viscous,
        spring,
        coulomb,
        period,
        count,
        force_walk,
        delay,
        margin,
    )
    set_latch(cycle["latch"][0, 0], period, settings.drive.drive_cycle_s, count)
    _bound_stiffness(cycle)
    _reset(cycle, float(cycle["oriented"][0]))


def _shaft(settings: Settings) -> ElasticShaft | None:
    """Return the shaft of the model, None for a rigid one."""
    mechanics = settings.mechanics
    if not mechanics.shaft_hz:
        return None
    assert mechanics.rotor_inertia_kg_m2 is not None
    # A model that is told a hand has its damping, which is beyond the shaft.
    viscous = mechanics.viscous_nm_s_per_rad if settings.operator.adapt else 0.0
    return ElasticShaft(
        mechanics.inertia_kg_m2,
        mechanics.rotor_inertia_kg_m2,
        mechanics.shaft_hz,
        mechanics.shaft_damping_ratio,
        viscous,
    )


def _bound_stiffness(cycle: NDArray[np.void]) -> None:
    """Set the stiffness of the stiffest wall, where there is a cap: on a shaft for each hand."""
    shaft = ElasticShaft(*cycle["shaft"][0].tolist())
    rendered, bank, estimator = (cycle[name][0, 0] for name in ("rendered", "bank", "estimator"))
    wall, n = rendered["wall"], bank["count"].item()
    if not wall["cap"][0]:
        return
    if shaft.resonance_hz:
        before, period = estimator["before"]["duration"], cycle["period"].item()
        closing = (
            bool(rendered["sampled"]),
            wall["asked_damping"].item(),
            wall["damping_ratio"].item(),
            period,
            estimator["delay_periods"].item() + before.item() / period,
        )
        for i in range(n):
            mass = math.exp(bank["log_lightest"] + i * bank["log_step"])
            gain = tuple(bank["steady_gain"][:, i].tolist())
            loop = WallLoop(mass, bank["viscous"][i].item(), gain, *closing)
            bank["stiffest"][i] = stiffest_wall(shaft, loop, identified=n > 1)
        if not n:
            known = estimator["mass"].item(), estimator["viscous"].item()
            gain = tuple(estimator["steady_gain"].tolist())
            wall["stiffest"] = stiffest_wall(shaft, WallLoop(*known, gain, *closing))
    if n:
        wall["stiffest"] = np.interp(bank["place"], np.arange(n), bank["stiffest"][:n])


def stiffest_for(cycle: NDArray[np.void], settings: Settings, mass: float) -> float:
    """Return the stiffness of the stiffest wall in a hand, inf where nothing bounds it.

    Args:
        cycle: An array of dtype CYCLE, shape (1,).
        settings: Those of which it was made.
        mass: Inertia of all that moves [kg·m²]; on an elastic shaft without operator.adapt it is
            taken for the one told.
    """
    bank, wall = cycle["bank"][0, 0], cycle["rendered"][0, 0]["wall"]
    if not (wall["cap"][0] and (n := bank["count"].item())):
        return float(wall["stiffest"][0])
    if n == 1 and not settings.mechanics.shaft_hz:
        period, count = cycle["period"].item(), cycle["rad_per_count"].item()
        radius = handle_radius(settings.mechanics.handle_radius_m)
        delay = bank["delay"].item()
        return float(stiffest_walls(np.array([mass]), delay, period, count, radius)[0])
    log_masses = bank["log_lightest"] + bank["log_step"] * np.arange(n)
    return float(np.interp(math.log(mass), log_masses, bank["stiffest"][:n]))


def _reset(cycle: NDArray[np.void], oriented: float) -> None:
    """Reset the estimator at a position [rad]; TPDOs are what its delay takes them for."""
    reset_estimator(cycle["estimator"][0], oriented)
    reset_bank(cycle["bank"][0], oriented)
    reset_latch(cycle["latch"][0, 0])
    cycle["compares_lag"] = False
    cycle["lag"] = 0


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
    cycle["jump_limit"] = jump + _JUMP_COUNTS * count
    stuck = max(limits.stuck_rad, _STUCK_COUNTS * count)
    shaft = ElasticShaft(*cycle["shaft"][0].tolist())
    if shaft.rotor:
        # What stops a handle slowly stops a rotor in no time.
        stuck *= shaft.inertia / shaft.rotor
    cycle["stuck_limit"] = stuck if limits.stuck_rad else math.inf
    cycle["stuck_cycles"] = limits.stuck_cycles
    error = limits.torque_error_nm
    if error is None:
        rated_part = _TORQUE_ERROR_PER_MILLE * cycle["nm_per_mille"].item()
        error = max(_TORQUE_ERROR_PART * limits.torque_nm, rated_part)
    cycle["torque_error_limit"] = error or math.inf
    cycle["torque_error_cycles"] = limits.torque_error_cycles
    cycle["hold_cycles"] = limits.hold_cycles
    cycle["ramp_cycles"] = limits.ramp_cycles


def set_wall(cycle: NDArray[np.void], wall: Wall, laws: Sequence[Law]) -> None:
    """Change the wall between two cycles; `laws` contains its law. Raises UnknownLawError."""
    law = find_law(wall.law, wall.deadbeat)
    options = law.option_values(wall.options)
    index = [known.name for known in laws].index(law.name)
    cycle["orientation"] = wall.orientation
    cycle["is_blind"] = False
    rendered = cycle["rendered"][0]
    known = rendered["wall"][0]
    # That the wall moves is no work of the operator's.
    known["y_before"] += cycle["orientation"][0] * (rendered["position"] - wall.position_rad)
    rendered["position"] = wall.position_rad
    rendered["sampled"] = law.sampled
    rendered["estimated_velocity"] = wall.velocity == "estimated"
    if wall.divider != rendered["divider"]:
        # The law's torques are held until it is evaluated again.
        rendered["divider"] = rendered["waited"] = wall.divider
        names = ("mass", "viscous", "spring", "device_viscous")
        mass, viscous, spring, device = (known[name].item() for name in names)
        set_plant(known, mass, viscous, spring, cycle["period"].item() * wall.divider, device)
    set_referent(known, wall.stiffness_nm_per_rad, wall.damping_nm_s_per_rad, options)
    known["damping_ratio"], known["cap"] = wall.damping_ratio, wall.cap
    known["tension"] = TENSION[wall.tension]
    known["passivity_damping"] = wall.passivity_nm_s_per_rad
    _bound_stiffness(cycle)
    if index != rendered["law"]:
        rendered["law"] = index
        clear_memory(known)


def set_watching(cycle: NDArray[np.void], guard: Guard, operator: Operator) -> None:
    """Change what observes wall and hand between two cycles."""
    change_guard(cycle["guard"][0, 0], guard.action, cycle["oriented"].item())
    cycle["bank"]["holds"] = not operator.adapt


def withdraw_wall(cycle: NDArray[np.void], cycles: int) -> None:
    """Let the wall's force fall to zero within `cycles` or, at the torque rate, later; then trip.

    The whole force falls, whatever is being blended into it. Another thread may call this.
    """
    torque = abs(cycle["torque_per_mille"].item() * cycle["nm_per_mille"].item())
    rate = cycle["torque_rate"].item() * cycle["period"].item()
    cycle["share_falls"] = 1.0 / max(cycles, math.ceil(torque / rate), 1)


def fade_over(cycle: NDArray[np.void], cycles: int) -> None:
    """Blend the present wall into the next one without a bump, within `cycles`.

    To be called before `set_wall`. The forces of both walls are blended linearly.
    """
    cycle["faded"] = cycle["rendered"]
    cycle["fade_cycles"] = cycle["fade_left"] = cycles


def fade_in(cycle: NDArray[np.void], cycles: int) -> None:
    """Fade the wall in from zero force within `cycles`, since the handle may be inside it."""
    fade_over(cycle, cycles)
    cycle["faded"]["law"] = NO_LAW


def start_at(cycle: NDArray[np.void], counts: int) -> None:
    """Begin at rest at a position, the first that the drive reports."""
    oriented = cycle["orientation"][0] * counts * cycle["rad_per_count"][0]
    _reset(cycle, oriented)
    cycle["oriented"] = cycle["rendered"]["y_before"] = oriented
    cycle["started"] = True
