"""Handle and hand by other means than the project's: scipy's integrator and event search.

Every force is written down as a function of time, position and velocity; which of them act is
decided anew after every event.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from canwall.physics import Force, Grasp, HandBody, advance_grasp, make_plant

Array = NDArray[np.float64]

#: Below this a quantity counts as zero throughout, and has no event.
NOTHING = 1e-14


@dataclass(frozen=True)
class Handle:
    """Parameters of the handle, named as in `physics.make_plant`."""

    mass: float
    viscous: float = 0.0
    coulomb: float = 0.0
    cogging: float = 0.0
    cog_pitch: float = 1.0

    def torque(self, y: float, half: int) -> float:
        """Cogging torque, a triangle wave that pulls towards 0 at 0, on its half with that number.

        Each half is a straight line, of slope -4·amplitude/pitch and +4·amplitude/pitch in turn.
        """
        slope = -4.0 * self.cogging / self.cog_pitch * (-1) ** half
        return slope * (y - 0.5 * half * self.cog_pitch)

    def cog_energy(self, y: float) -> float:
        """Energy in the cogging torque, from its integral over each half of a cog."""
        half = 0.5 * self.cog_pitch
        index = math.floor(y / half + 0.5)
        stiffness, off = 2.0 * self.cogging / half, y - index * half
        if index % 2:
            return stiffness * (half * half / 4.0 - 0.5 * off * off)
        return 0.5 * stiffness * off * off


@dataclass
class Log:
    """Numbers of events on the way."""

    partings: int = 0
    impacts: int = 0
    stops: int = 0
    lost: list[float] = field(default_factory=list)


def moved(
    handle: Handle, hand: HandBody, now: Grasp, motor: Force, script: Force, duration: float
) -> Grasp:
    """The motion under test."""
    alone = make_plant(
        handle.mass,
        handle.viscous,
        0.0,
        handle.coulomb,
        cogging=handle.cogging,
        cog_pitch=handle.cog_pitch,
    )
    joined = make_plant(
        handle.mass + hand.mass,
        handle.viscous + hand.viscous,
        hand.spring,
        handle.coulomb,
        cogging=handle.cogging,
        cog_pitch=handle.cog_pitch,
    )
    return Grasp(*advance_grasp(alone[0], joined[0], hand, now, motor, script, duration))


def at(force: Force, t: float) -> float:
    """The force at time t."""
    return force.constant + force.slope * t - force.excess * (1.0 - math.exp(-force.rate * t))


def _event(function: Callable[[float, Array], float], direction: float) -> object:
    function.terminal = True  # type: ignore[attr-defined]
    function.direction = direction  # type: ignore[attr-defined]
    return function


def integrate(
    handle: Handle,
    hand: HandBody,
    now: Grasp,
    motor: Force,
    script: Force,
    duration: float,
    max_step: float,
    log: Log | None = None,
) -> Grasp:
    """Return the result that `physics.advance_grasp` has in closed form."""
    log = log if log is not None else Log()
    y, v, hand_y, hand_v, touching = now
    t, loose = 0.0, 0.0
    half = math.floor(2.0 * y / handle.cog_pitch + 0.5)

    def pull(t: float, y: float, v: float, touching: bool) -> float:
        force = at(motor, t) + handle.torque(y, half) - handle.viscous * v
        if touching:
            force += at(script, t) - hand.spring * y - hand.viscous * v
        return force

    def hand_acceleration(t: float, y: float, v: float) -> float:
        return (at(script, t) - hand.spring * y - hand.viscous * v) / hand.mass

    while t < duration:
        load = pull(t, y, v, touching)
        sense = loose
        if v != 0.0:
            sense = math.copysign(1.0, v)
        elif not loose and abs(load) > handle.coulomb:
            sense = math.copysign(1.0, load)
        loose = 0.0
        moving = handle.mass + (hand.mass if touching else 0.0)

        def acceleration(
            t: float,
            y: float,
            v: float,
            sense: float = sense,
            touching: bool = touching,
            moving: float = moving,
        ) -> float:
            if sense == 0.0:
                return 0.0
            return (pull(t, y, v, touching) - sense * handle.coulomb) / moving

        def press(t: float, state: Array, a: Callable[..., float] = acceleration) -> float:
            inertia = hand.mass * (hand_acceleration(t, state[0], state[1]) - a(t, *state[:2]))
            return hand.side * inertia + NOTHING

        if touching and press(t, np.array([y, v])) < -1e-12:
            touching = False
            log.partings += 1
            continue

        def motion(
            t: float,
            state: Array,
            a: Callable[..., float] = acceleration,
            touching: bool = touching,
            sense: float = sense,
        ) -> list[float]:
            slope = [state[1] if sense else 0.0, a(t, state[0], state[1])]
            return slope + (
                slope if touching else [state[3], hand_acceleration(t, state[2], state[3])]
            )

        def gap(t: float, state: Array) -> float:
            return float(hand.side * (state[0] - state[2])) + NOTHING

        def hold(t: float, state: Array, touching: bool = touching) -> float:
            return handle.coulomb - abs(pull(t, state[0], 0.0, touching)) + NOTHING

        def turn(t: float, state: Array, sense: float = sense) -> float:
            return float(sense * state[1])

        def over(t: float, state: Array, half: int = half) -> float:
            return float(state[0] - 0.5 * (half + 0.5) * handle.cog_pitch)

        def under(t: float, state: Array, half: int = half) -> float:
            return float(state[0] - 0.5 * (half - 0.5) * handle.cog_pitch)

        corners = [_event(over, 1.0), _event(under, -1.0)] if handle.cogging else []
        found = solve_ivp(
            motion,
            (t, duration),
            [y, v, hand_y, hand_v],
            "DOP853",
            events=[
                _event(press if touching else gap, -1.0),
                _event(turn if sense else hold, -1.0),
                *corners,
            ],
            rtol=1e-12,
            atol=1e-14,
            max_step=max_step,
        )
        assert found.success
        t = float(found.t[-1])
        y, v, hand_y, hand_v = (float(x) for x in found.y[:, -1])
        if found.status == 0:
            break
        if found.t_events[0].size and touching:
            touching = False
            log.partings += 1
        elif found.t_events[0].size:
            mean = (handle.mass * v + hand.mass * hand_v) / (handle.mass + hand.mass)
            reduced = handle.mass * hand.mass / (handle.mass + hand.mass)
            log.lost.append(0.5 * reduced * (v - hand_v) ** 2)
            hand_y, v, hand_v, touching = y, mean, mean, True
            log.impacts += 1
        elif not found.t_events[1].size:
            # Over a corner; there it is exactly, lest it is found again.
            rises = bool(found.t_events[2].size)
            y = 0.5 * (half + (0.5 if rises else -0.5)) * handle.cog_pitch
            half += 1 if rises else -1
        elif sense:
            v = 0.0
            log.stops += 1
        else:
            loose = math.copysign(1.0, pull(t, y, 0.0, touching))
        if touching:
            hand_y, hand_v = y, v
    return Grasp(y, v, hand_y, hand_v, touching)
