"""One strike on the simulated drive, through the bus, and what came of it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canwall import metrics
from canwall.config import Hand, Mechanics, Settings, Simulation, Wall
from canwall.cycle import run_laws
from canwall.record import Ring
from canwall.referent import referent_positions
from canwall.run import (
    drive_dictionary,
    make_axis,
    make_exchange,
    on_the_bus,
    render,
)
from canwall.units import DriveUnits

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Operator:
    """Who is at the handle: impedance in shaft coordinates, and how he presses."""

    name: str
    inertia_kg_m2: float
    damping_nm_s_per_rad: float
    stiffness_nm_per_rad: float


_RADIUS_M = 0.08


def _at_radius(name: str, mass_kg: float, damping: float, stiffness: float) -> Operator:
    """Mass [kg], damping [N·s/m] and stiffness [N/m] at a handle of 80 mm."""
    square = _RADIUS_M**2
    return Operator(name, mass_kg * square, damping * square, stiffness * square)


#: Operators within the ranges of theory.md, section 7. A grip is a hand that holds the handle
#: with its fingers: 50 g, as stiff and damped as a stiff finger.
OPERATORS = {
    operator.name: operator
    for operator in (
        Operator("none", 0.0, 0.0, 0.0),
        _at_radius("finger", 0.010, 4.0, 500.0),
        _at_radius("grip", 0.050, 8.0, 1200.0),
        _at_radius("arm", 0.55, 6.5, 135.0),
    )
}

_PRESSING_NM = 0.15
_FIRST_STRIKE_S = 0.05
_START_RAD = 0.03
_PRESS_S = 0.6
_AFTERWARDS_S = 0.25


def strike_settings(
    base: Settings,
    operator: Operator,
    wall: Wall,
    speed_rad_s: float,
    phase: float,
    known_inertia: float = 1.0,
) -> Settings:
    """One strike of an operator, pressing with 0.15 N·m, on a wall, as settings of a run.

    speed_rad_s is the mean speed of the hand's approach; phase, 0 … 1, shifts the start by that
    share of the way of one period, and with it the instant of contact against the SYNC.
    The model of the laws has drive and hand but for the hand's spring: about a hand that moves, it
    is for the estimated force. known_inertia is the share of the inertia that the model knows.
    The servo is an ideal one: what is judged is the law.
    """
    simulation = (base.simulation or Simulation()).with_ideal_servo()
    start = _START_RAD + phase * speed_rad_s * base.bus.cycle_s
    stiffness = operator.stiffness_nm_per_rad
    # A hand with a spring presses by it; without one, by its muscle torque alone.
    depth = _PRESSING_NM / stiffness if stiffness > 0.0 else 0.0
    travel_s = (start + depth) / speed_rad_s
    hand = Hand(
        inertia_kg_m2=operator.inertia_kg_m2,
        damping_nm_s_per_rad=operator.damping_nm_s_per_rad,
        stiffness_nm_per_rad=stiffness,
        strikes=1,
        first_strike_s=_FIRST_STRIKE_S,
        rest_rad=start,
        press_rad=-depth,
        press_torque_nm=0.0 if stiffness > 0.0 else -_PRESSING_NM,
        approach_s=travel_s,
        press_s=_PRESS_S,
        withdraw_s=travel_s,
    )
    moving = simulation.model_copy(update={"hand": hand})
    mechanics = Mechanics(
        inertia_kg_m2=(simulation.inertia_kg_m2 + operator.inertia_kg_m2) * known_inertia,
        viscous_nm_s_per_rad=simulation.viscous_nm_s_per_rad + operator.damping_nm_s_per_rad,
        coulomb_nm=simulation.coulomb_nm,
    )
    duration = _FIRST_STRIKE_S + 2.0 * travel_s + _PRESS_S + _AFTERWARDS_S
    return base.model_copy(
        update={
            "simulation": moving,
            "mechanics": mechanics,
            "wall": wall,
            "schedule": (),
            "run": base.run.model_copy(update={"duration_s": duration}),
        }
    )


@dataclass(frozen=True)
class Verdict:
    """What came of one strike. Energies [J], torque [N·m]."""

    chatters: bool
    reason: str
    energy_out_max: float
    energy_tolerance: float
    peak_torque: float
    trips: tuple[str, ...]


def strike_over_bus(settings: Settings) -> Verdict:
    """Render the wall for one strike, through frames on the embedded bus, and judge it.

    A run that trips (speed, position) counts as chatter: its wall threw the handle away.
    """
    laws = run_laws(settings)
    ring = Ring.create()
    pieces: list[NDArray[np.void]] = []

    def collect(now_s: float) -> None:
        pieces.append(ring.take_rows())
        ring.take_frames()

    try:
        with on_the_bus(settings) as link:
            axis = make_axis(link, settings, drive_dictionary(settings), laws, ring)
            outcome = render(make_exchange(link, [axis]), lambda: False, collect)
        collect(0.0)
    finally:
        ring.close()
    return judge(np.concatenate(pieces), settings, axis.setup.units, tuple(outcome.trips))


def judge(
    rows: NDArray[np.void], settings: Settings, units: DriveUnits, trips: tuple[str, ...]
) -> Verdict:
    """Chatter and energy out over the whole of a strike; rows has dtype record.ROW."""
    y, force = rows["y"], rows["force_applied"]
    referent = referent_positions(
        settings, rows["stiffness"], rows["damping"], rows["wall_position_rad"]
    )
    peak = float(np.abs(rows["torque_cmd"]).max(initial=0.0))
    tolerance = metrics.amplitude_tolerance(
        settings.wall.stiffness_nm_per_rad, units.rad_per_count, units.nm_per_mille
    )
    verdict = metrics.chatter(y, referent, settings.bus.cycle_s, tolerance, units.rad_per_count)
    return Verdict(
        chatters=verdict.chatters or bool(trips),
        reason="; ".join(trips) or verdict.reason,
        energy_out_max=float(metrics.energy_out(y, force).max(initial=0.0)),
        energy_tolerance=units.rad_per_count * peak,
        peak_torque=peak,
        trips=trips,
    )
