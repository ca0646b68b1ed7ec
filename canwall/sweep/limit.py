"""The K-limit: the largest stiffness at which no strike chatters (theory, section 5)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from canwall.config import Settings, Wall
from canwall.sweep.strike import Operator, Verdict, strike_over_bus, strike_settings

#: Mean approach speeds [rad/s], and shares of a period by which the contact is shifted.
SPEEDS_RAD_S = (0.5, 1.0, 2.0)
PHASES = (0.0, 0.35, 0.7)


@dataclass(frozen=True)
class Limit:
    """K-limit of one law with one operator.

    stiffness [N·m/rad] is the largest K found free of chatter; normalised is K·T²/m with the
    inertia that really moves. The energies are the worst over all strikes at that K.
    """

    stiffness: float
    normalised: float
    energy_out_max: float
    energy_in_tolerances: float
    peak_torque: float
    beyond: str


def worst_strike(
    base: Settings,
    operator: Operator,
    wall: Wall,
    speeds: Sequence[float] = SPEEDS_RAD_S,
    phases: Sequence[float] = PHASES,
    known_inertia: float = 1.0,
    strike: Callable[[Settings], Verdict] = strike_over_bus,
) -> list[Verdict]:
    """Verdicts over all approach speeds and phases, up to the first that chatters."""
    verdicts = []
    for speed in speeds:
        for phase in phases:
            settings = strike_settings(base, operator, wall, speed, phase, known_inertia)
            verdicts.append(strike(settings))
            if verdicts[-1].chatters:
                return verdicts
    return verdicts


def k_limit(
    base: Settings,
    operator: Operator,
    wall: Wall,
    largest_normalised: float = 4.0,
    resolution: float = 0.03,
    known_inertia: float = 1.0,
) -> Limit:
    """Bisect log K between a wall free of chatter and one that is not.

    K goes up by factors of two from K·T²/m = 1/512 until a strike chatters (down, where the first
    does already), then the bracket is halved until it is narrower than `resolution`. The search
    ends at `largest_normalised`. wall gives everything but the stiffness.
    """
    assert base.simulation is not None
    mass = base.simulation.inertia_kg_m2 + operator.inertia_kg_m2
    unit = mass / base.bus.cycle_s**2

    def verdicts(normalised: float) -> list[Verdict]:
        stiff = wall.model_copy(update={"stiffness_nm_per_rad": normalised * unit})
        return worst_strike(base, operator, stiff, known_inertia=known_inertia)

    free, chattering = 0.0, math.inf
    at_free: list[Verdict] = []
    reason = f"none up to K·T²/m = {largest_normalised:g}"
    normalised = 1.0 / 512.0
    while normalised <= largest_normalised and normalised > 1e-5:
        found = verdicts(normalised)
        if found[-1].chatters:
            chattering, reason = normalised, found[-1].reason
        else:
            free, at_free = normalised, found
        if free and chattering < math.inf:
            if math.log(chattering / free) < resolution:
                break
            normalised = math.sqrt(free * chattering)
        else:
            normalised *= 0.5 if found[-1].chatters else 2.0
    return Limit(
        stiffness=free * unit,
        normalised=free,
        energy_out_max=max((v.energy_out_max for v in at_free), default=0.0),
        energy_in_tolerances=max(
            (v.energy_out_max / v.energy_tolerance for v in at_free if v.energy_tolerance > 0.0),
            default=0.0,
        ),
        peak_torque=max((v.peak_torque for v in at_free), default=0.0),
        beyond=reason,
    )
