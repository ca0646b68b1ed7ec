"""The bouncing ball by other means: scipy's integrator with its event search, scipy's ZOH."""

import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete

from canwall.workbench import Ball

Array: TypeAlias = NDArray[np.float64]
Event: TypeAlias = Callable[[float, Array], float]


def sample_times(ball: Ball) -> Array:
    return np.arange(ball.periods + 1, dtype=np.float64) * ball.period


def integrated(ball: Ball, times: Array) -> tuple[Array, Array, Array]:
    """(y, ẏ, energy lost so far) of the continuous floor at `times`, which begin at 0.

    Smooth piece by smooth piece: a piece ends where the ball crosses the surface or turns round.
    """
    states = np.empty((3, len(times)))
    t, y, v, lost = 0.0, ball.height, ball.speed, 0.0
    bias = -ball.mass * ball.gravity
    filled = 0
    while filled < len(times):
        pull = v if v != 0.0 else bias - ball.spring * y
        inside = y < 0.0 or (y == 0.0 and pull < 0.0)
        spring = ball.spring + (ball.stiffness if inside else 0.0)
        viscous = ball.viscous + (ball.damping if inside else 0.0)
        if v == 0.0:
            pull = bias - spring * y
        if pull == 0.0:  # at rest
            states[:, filled:] = [[y], [v], [lost]]
            break
        sense = math.copysign(1.0, pull)

        def motion(
            time: float, state: Array, viscous: float = viscous, spring: float = spring
        ) -> list[float]:
            force = bias - viscous * state[1] - spring * state[0]
            return [state[1], force / ball.mass, viscous * state[1] ** 2]

        events = [_terminal(lambda time, state: float(state[1]), -sense)]
        if inside == (sense > 0.0):
            events.append(_terminal(lambda time, state: float(state[0]), sense))
        solution = solve_ivp(
            motion,
            (t, times[-1]),
            [y, v, lost],
            "DOP853",
            events=events,
            rtol=1e-12,
            atol=1e-14,
            dense_output=True,
            max_step=0.1 * math.sqrt(ball.mass / spring) if spring > 0.0 else np.inf,
        )
        if not solution.success or solution.sol is None or solution.t_events is None:
            raise RuntimeError(solution.message)
        t = float(solution.t[-1])
        end = len(times) if solution.status == 0 else int(np.searchsorted(times, t))
        if filled < end:
            states[:, filled:end] = solution.sol(times[filled:end])
        filled = end
        y, v, lost = (float(x) for x in solution.y[:, -1])
        if solution.status == 1 and solution.t_events[0].size:
            v = 0.0
        else:
            y = 0.0
    return states[0], states[1], states[2]


def _terminal(event: Event, direction: float) -> Event:
    event.terminal = True  # type: ignore[attr-defined]
    event.direction = direction  # type: ignore[attr-defined]
    return event


def zoh_of(mass: float, viscous: float, spring: float, period: float) -> tuple[Array, Array]:
    """Φ of shape (2, 2) and Γ of shape (2,) by scipy."""
    a = np.array([[0.0, 1.0], [-spring / mass, -viscous / mass]])
    b = np.array([[0.0], [1.0 / mass]])
    phi, gamma, *_ = cont2discrete((a, b, np.eye(2), np.zeros((2, 1))), period)
    return phi, gamma[:, 0]


def bounces(y: Array) -> int:
    """Return the number of times that the ball left the floor between two samples."""
    return int(np.count_nonzero((y[:-1] < 0.0) & (y[1:] >= 0.0)))
