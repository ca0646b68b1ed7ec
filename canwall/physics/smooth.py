"""Motion between two events (an oscillator under a ramp and a decaying lag), and their search.

Newton's method finds a root in a bracket. No root is missed or found twice because the function is
monotone on each bracket. The ends of the brackets are the zeros of its derivative, which are found
in the same way, down to a function whose zeros can be counted: after two derivatives have removed
the ramp, and (D + rate) the lag, any function of position, velocity and acceleration is a damped
oscillation, which has at most one zero in a quarter of its period.
"""

import math
from typing import NamedTuple

import numpy as np

from canwall.compiled import compiled
from canwall.physics.oscillator import flow, lag_response

_MAX_ITERATIONS = 200


class Force(NamedTuple):
    """Force constant + slope·t − excess·(1 − exp(−rate·t)), whose excess decays at `rate` [1/s].

    This is the torque of a first-order current loop: it starts at `constant` and tends to the
    demand, constant − excess.
    """

    constant: float
    slope: float
    excess: float
    rate: float


class SmoothMotion(NamedTuple):
    """Motion mass·ÿ + viscous·ẏ + spring·y = F(t) from (y, v), F as in `Force`, spring of any sign.

    Forces that are constant between two events, such as friction, are part of `constant`.
    """

    mass: float
    viscous: float
    spring: float
    y: float
    v: float
    constant: float
    slope: float
    excess: float
    rate: float


class EventFunction(NamedTuple):
    """Function constant + slope·t + position·y + velocity·ẏ + acceleration·ÿ, zero at events."""

    constant: float
    slope: float
    position: float
    velocity: float
    acceleration: float


VELOCITY = EventFunction(0.0, 0.0, 0.0, 1.0, 0.0)
ACCELERATION = EventFunction(0.0, 0.0, 0.0, 0.0, 1.0)


@compiled
def shifted(force: Force, t: float) -> Force:
    """Return the same force with its time starting at t."""
    constant = force.constant + force.slope * t
    if force.excess == 0.0:
        return Force(constant, force.slope, 0.0, force.rate)
    gone = -math.expm1(-force.rate * t) * force.excess
    return Force(constant - gone, force.slope, force.excess - gone, force.rate)


@compiled
def _lagged_state(motion: SmoothMotion, t: float) -> tuple[float, float]:
    m = motion
    kappa = m.spring / m.mass
    h1, h0, g1, g2, r1, r0 = lag_response(m.viscous / m.mass, kappa, m.rate, t)
    a0 = (m.constant - m.spring * m.y) / m.mass
    a1 = m.slope / m.mass
    lag = m.excess / m.mass
    return (
        m.y + m.v * h0 + a0 * g1 + a1 * g2 + lag * r0,
        m.v * h1 + a0 * h0 + a1 * g1 + lag * r1,
    )


@compiled
def state_at(motion: SmoothMotion, t: float) -> tuple[float, float]:
    """Return (y, ẏ) at time t."""
    m = motion
    if m.excess == 0.0:
        return flow(m.mass, m.viscous, m.spring, m.y, m.v, m.constant, m.slope, t)
    return _lagged_state(motion, t)


@compiled
def deviation(motion: SmoothMotion, t: float) -> tuple[float, float]:
    """Return (y − y(0) − ẏ(0)·t, ẏ − ẏ(0)) at time t, without cancellation for small t."""
    m = motion
    _, h0, g1, g2, r1, r0 = lag_response(m.viscous / m.mass, m.spring / m.mass, m.rate, t)
    a0 = (m.constant - m.viscous * m.v - m.spring * m.y) / m.mass
    a1 = (m.slope - m.spring * m.v) / m.mass
    lag = m.excess / m.mass
    return a0 * g1 + a1 * g2 + lag * r0, a0 * h0 + a1 * g1 + lag * r1


@compiled
def largest_acceleration(motion: SmoothMotion, span: float) -> float:
    """Return a bound of |ÿ| over [0, span].

    ÿ = ÿ(0)·h' + (slope − spring·ẏ(0))/m·h + the lag's part, with |h'| ≤ 1 for an oscillator and
    ≤ cosh for a negative spring, |h| at most its integral, and the lag's part at most what has
    decayed of it.
    """
    m = motion
    growth = math.cosh(math.sqrt(max(-m.spring / m.mass, 0.0)) * span)
    a0 = abs(m.constant - m.viscous * m.v - m.spring * m.y)
    a1 = abs(m.slope - m.spring * m.v) * span
    lag = abs(m.excess) * -math.expm1(-m.rate * span)
    return growth * (a0 + a1 + lag) / m.mass


@compiled
def event_value(
    motion: SmoothMotion, event: EventFunction, order: int, t: float
) -> tuple[float, float]:
    """Return the derivative of an event function of this order, and its slope, at time t.

    Order 3 stands for (D + rate)·D², which turns any event function into a damped oscillation.
    """
    m = motion
    w = event
    y0, y1 = state_at(m, t)
    left = m.excess * math.exp(-m.rate * t) if m.excess != 0.0 else 0.0
    force = m.constant + m.slope * t
    if m.excess != 0.0:
        force -= m.excess - left
    y2 = (force - m.viscous * y1 - m.spring * y0) / m.mass
    left *= -m.rate
    y3 = (m.slope + left - m.viscous * y2 - m.spring * y1) / m.mass
    value = w.position * y0 + w.velocity * y1 + w.acceleration * y2
    first = w.position * y1 + w.velocity * y2 + w.acceleration * y3
    if order == 0:
        return w.constant + w.slope * t + value, w.slope + first
    left *= -m.rate
    y4 = (left - m.viscous * y3 - m.spring * y2) / m.mass
    second = w.position * y2 + w.velocity * y3 + w.acceleration * y4
    if order == 1:
        return w.slope + first, second
    left *= -m.rate
    y5 = (left - m.viscous * y4 - m.spring * y3) / m.mass
    third = w.position * y3 + w.velocity * y4 + w.acceleration * y5
    if order == 2:
        return second, third
    left *= -m.rate
    y6 = (left - m.viscous * y5 - m.spring * y4) / m.mass
    fourth = w.position * y4 + w.velocity * y5 + w.acceleration * y6
    return third + m.rate * second, fourth + m.rate * third


@compiled
def find_root(
    motion: SmoothMotion, event: EventFunction, order: int, low: float, high: float, rising: bool
) -> float:
    """Return the root of an event function in (low, high], by Newton's method in a bracket."""
    rounding = 4e-16 * high
    t = 0.5 * (low + high)
    for _ in range(_MAX_ITERATIONS):
        value, slope = event_value(motion, event, order, t)
        if (value < 0.0) == rising:
            low = t
        else:
            high = t
        step = value / slope if slope != 0.0 else math.inf
        if abs(step) <= rounding:
            return t
        proposal = t - step
        if not low < proposal < high:
            proposal = 0.5 * (low + high)
        if abs(proposal - t) <= rounding or proposal in (low, high):
            return proposal
        t = proposal
    return t


@compiled
def first_sign_change(
    motion: SmoothMotion, event: EventFunction, sign: float, span: float
) -> float:
    """Return the first time in (0, span] at which an event function changes its sign, else inf.

    `sign` is its sign at the start; span is at most a quarter period of the oscillator.
    """
    edges = np.empty(6)
    zeros = np.empty(6)
    edges[0], edges[1] = 0.0, span
    count = 2
    for order in range(3 if motion.excess != 0.0 else 2, -1, -1):
        # The function of this order has exactly one zero between two edges with a sign change.
        zeros[0] = 0.0
        found = 1
        before = sign if order == 0 else event_value(motion, event, order, 0.0)[0]
        since = 0.0
        for i in range(1, count):
            value, _ = event_value(motion, event, order, edges[i])
            if value * before < 0.0:
                zero = find_root(motion, event, order, since, edges[i], before < 0.0)
                if order == 0:
                    return zero
                zeros[found] = zero
                found += 1
            if value != 0.0:
                before, since = value, edges[i]
        zeros[found] = span
        count = found + 1
        edges, zeros = zeros, edges
    return math.inf
