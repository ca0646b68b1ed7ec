"""Handles to test with, and their motion by other means than the project's.

The reference integrates smooth pieces with scipy, and finds their ends with scipy's event search.
"""

import math
from collections.abc import Callable
from dataclasses import astuple, dataclass

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from canwall.physics import advance, make_plant

Array = NDArray[np.float64]
Event = Callable[[float, Array], float]


@dataclass(frozen=True)
class Handle:
    """Moving mass and the forces on it; the fields are those of `physics.make_plant`."""

    mass: float
    viscous: float = 0.0
    spring: float = 0.0
    coulomb: float = 0.0
    wall_stiffness: float = 0.0
    wall_damping: float = 0.0

    @property
    def has_wall(self) -> bool:
        return self.wall_stiffness > 0.0 or self.wall_damping > 0.0

    def energy(self, y: float, v: float) -> float:
        """Kinetic energy and that of the springs [J]."""
        wall = self.wall_stiffness if y < 0.0 else 0.0
        return 0.5 * self.mass * v * v + 0.5 * (self.spring + wall) * y * y


def moved(
    handle: Handle, y: float, v: float, u0: float, u1: float, duration: float
) -> tuple[float, float]:
    """The motion under test."""
    y, v, _ = advance(make_plant(*astuple(handle))[0], y, v, u0, u1, duration)
    return y, v


def touches(handle: Handle, y: float, v: float, u0: float, u1: float, duration: float) -> bool:
    """Return True if the wall acts in the motion under test."""
    return advance(make_plant(*astuple(handle))[0], y, v, u0, u1, duration)[2]


def thousandths(low: float, high: float) -> st.SearchStrategy[float]:
    """Numbers of an ordinary size: what nearly vanishes takes the reference for ever."""
    return st.integers(round(low * 1000), round(high * 1000)).map(lambda n: n / 1000)


@dataclass
class Reference:
    """End of the motion, and events on the way."""

    y: float
    v: float
    bounces: int = 0
    stops: int = 0


def terminal(event: Event, direction: float = 0.0) -> Event:
    event.terminal = True  # type: ignore[attr-defined]
    event.direction = direction  # type: ignore[attr-defined]
    return event


def integrate(
    handle: Handle, y: float, v: float, u0: float, u1: float, duration: float
) -> Reference:
    """The end of the motion that `physics.advance` gives in closed form."""
    now = Reference(y, v)
    t = 0.0
    while t < duration:
        force = u0 + u1 * t
        pressed_in = now.v < 0.0 or (now.v == 0.0 and force < handle.spring * now.y)
        inside = handle.has_wall and (now.y < 0.0 or (now.y == 0.0 and pressed_in))
        spring = handle.spring + (handle.wall_stiffness if inside else 0.0)
        viscous = handle.viscous + (handle.wall_damping if inside else 0.0)
        pull = force - spring * now.y
        if now.v == 0.0 and abs(pull) <= handle.coulomb:
            away = math.copysign(1.0, u1)
            wait = (handle.coulomb - away * pull) / abs(u1) if u1 != 0.0 else math.inf
            t += wait
            if t >= duration:
                break
            sense = away
        else:
            sense = math.copysign(1.0, now.v if now.v != 0.0 else pull)

        def motion(
            time: float,
            state: Array,
            viscous: float = viscous,
            spring: float = spring,
            friction: float = sense * handle.coulomb,
        ) -> list[float]:
            total = u0 + u1 * time - friction - viscous * state[1] - spring * state[0]
            return [state[1], total / handle.mass]

        def crossing(time: float, state: Array) -> float:
            return float(state[0])

        def reversal(time: float, state: Array) -> float:
            return float(state[1])

        events = [terminal(reversal, -sense)]
        if handle.has_wall and inside == (sense > 0.0):
            events.append(terminal(crossing, sense))
        start = np.array([now.y, now.v])
        # Steps this short keep the interpolation that events are searched on as good as the
        # integration, and a turn and its return from falling into one step.
        omega = math.sqrt(spring / handle.mass)
        solution = solve_ivp(
            motion,
            (t, duration),
            start,
            "DOP853",
            events=events,
            rtol=1e-12,
            atol=1e-14,
            max_step=0.1 / max(omega, 1.0),
        )
        if not solution.success or solution.t_events is None:
            raise RuntimeError(solution.message)
        t = float(solution.t[-1])
        now.y, now.v = (float(x) for x in solution.y[:, -1])
        if solution.status == 1:
            if solution.t_events[0].size:
                now.v = 0.0
                now.stops += 1
            else:
                now.y = 0.0
                now.bounces += not inside
    return now
