"""A hand on the handle that can let go: two bodies and a contact that presses but never pulls.

While the hand presses, the two move as one. They part at the instant at which the contact would
have to pull, and meet again at the instant at which the gap between them closes; what is left of
their relative velocity is lost there (a plastic impact: momentum stays, energy goes).
"""

import math
from typing import NamedTuple

from canwall.compiled import Record, compiled
from canwall.physics.motion import (
    MAX_EVENTS,
    onset,
    passed,
    piece_at,
    quarter_period,
    slide,
)
from canwall.physics.smooth import (
    EventFunction,
    Force,
    Smooth,
    departure,
    event_value,
    first_turn,
    largest_acceleration,
    later,
    state,
)


class HandBody(NamedTuple):
    """The hand as a body, about where its force law puts it; side −1.0 presses down, 1.0 up."""

    mass: float
    viscous: float
    spring: float
    side: float


class Grasp(NamedTuple):
    """Handle and hand: position and velocity of each, and whether they touch.

    Where they touch, both move alike.
    """

    y: float
    v: float
    hand_y: float
    hand_v: float
    touching: bool


#: Steps towards the closing of a gap after which it is closed to the last bit.
_MAX_STEPS = 10_000
#: Share of its span below which a flight is not looked at: right after parting, the gap is zero
#: and opens.
_SHORTEST_FLIGHT = 2.0**-20


@compiled
def _time_to_close(handle: Smooth, hand: Smooth, side: float, span: float) -> float:
    """First time in (0, span] at which the gap between them is closed and closing, else inf.

    The gap is stepped along no further than the largest relative acceleration could close it:
    each step ends before the gap does, and the last ones are Newton's.
    """
    gap0 = side * (handle.y - hand.y)
    speed0 = side * (handle.v - hand.v)
    most = largest_acceleration(handle, span) + largest_acceleration(hand, span)
    gap, speed, t = gap0, speed0, 0.0
    for _ in range(_MAX_STEPS):
        room = math.sqrt(speed * speed + 2.0 * most * max(gap, 0.0))
        if speed >= 0.0:
            step = max((speed + room) / most if most > 0.0 else math.inf, _SHORTEST_FLIGHT * span)
        else:
            step = 2.0 * max(gap, 0.0) / (room - speed)
            if step <= 1e-15 * span:
                return t
        t += step
        if t > span:
            return math.inf
        moved, accelerated = departure(handle, t)
        hand_moved, hand_accelerated = departure(hand, t)
        gap = gap0 + speed0 * t + side * (moved - hand_moved)
        speed = speed0 + side * (accelerated - hand_accelerated)
    return t


@compiled
def contact_force(hand: HandBody, script: Force, y: float, v: float, a: float) -> float:
    """What the hand presses with while it moves with the handle; negative where it would pull."""
    push = script.constant - hand.viscous * v - hand.spring * y - hand.mass * a
    return hand.side * push


@compiled
def _pressing(hand: HandBody, script: Force) -> EventFunction:
    """`contact_force` as a function of time, to be event_value along the motion of both."""
    side = hand.side
    return EventFunction(
        side * script.constant,
        side * script.slope,
        -side * hand.spring,
        -side * hand.viscous,
        -side * hand.mass,
    )


@compiled
def _together(
    joined: Record, hand: HandBody, now: Grasp, motor: Force, script: Force, remaining: float
) -> tuple[float, Grasp]:
    """Motion of both as one up to the next event: (duration, grasp then)."""
    total = Force(
        motor.constant + script.constant, motor.slope + script.slope, motor.excess, motor.rate
    )
    y, v = now.y, now.v
    piece, _ = piece_at(joined, y, v, total.constant)
    stuck, motion, direction = onset(joined, piece, y, v, total, remaining)
    if stuck > 0.0:
        # At rest the hand's own force alone decides whether it stays.
        press = contact_force(hand, script, y, 0.0, 0.0)
        fading = -hand.side * script.slope
        if press < 0.0:
            return 0.0, Grasp(y, v, y, v, False)
        if fading > 0.0 and press / fading < min(stuck, remaining):
            return press / fading, Grasp(y, v, y, v, False)
        if stuck >= remaining:
            return remaining, Grasp(y, v, y, v, True)
    event = _pressing(hand, later(script, stuck))
    if event_value(motion, event, 0, 0.0)[0] < 0.0:
        return stuck, Grasp(y, v, y, v, False)
    dt, y, v = slide(piece, motion, direction, remaining - stuck)
    parting = first_turn(motion, event, 1.0, dt)
    if parting < dt:
        y, v = state(motion, parting)
        return stuck + parting, Grasp(y, v, y, v, False)
    return stuck + dt, Grasp(y, v, y, v, True)


@compiled
def _impact(handle: Smooth, hand: Smooth, t: float) -> Grasp:
    """Both as one after the gap between them has closed at time t."""
    y, v = state(handle, t)
    _, hand_v = state(hand, t)
    v += (hand_v - v) * hand.mass / (handle.mass + hand.mass)
    return Grasp(y, v, y, v, True)


@compiled
def _apart(
    handle: Record, hand: HandBody, now: Grasp, motor: Force, script: Force, remaining: float
) -> tuple[float, Grasp]:
    """Motion of each alone up to the next event: (duration, grasp then)."""
    y, v = now.y, now.v
    piece, _ = piece_at(handle, y, v, motor.constant)
    stuck, motion, direction = onset(handle, piece, y, v, motor, remaining)
    span = min(remaining, quarter_period(hand.mass, hand.spring))
    flight = Smooth(
        hand.mass,
        hand.viscous,
        hand.spring,
        now.hand_y,
        now.hand_v,
        script.constant,
        script.slope,
        0.0,
        0.0,
    )
    if stuck > 0.0:
        still = Smooth(handle.mass, 0.0, 0.0, y, 0.0, 0.0, 0.0, 0.0, 0.0)
        wait = min(stuck, span)
        closing = _time_to_close(still, flight, hand.side, wait)
        if closing <= wait:
            return closing, _impact(still, flight, closing)
        hand_y, hand_v = state(flight, wait)
        if stuck >= span:
            return wait, Grasp(y, 0.0, hand_y, hand_v, False)
        script = later(script, stuck)
        flight = Smooth(
            hand.mass,
            hand.viscous,
            hand.spring,
            hand_y,
            hand_v,
            script.constant,
            script.slope,
            0.0,
            0.0,
        )
    dt, y, v = slide(piece, motion, direction, span - stuck)
    closing = _time_to_close(motion, flight, hand.side, dt)
    if closing <= dt:
        return stuck + closing, _impact(motion, flight, closing)
    hand_y, hand_v = state(flight, dt)
    return stuck + dt, Grasp(y, v, hand_y, hand_v, False)


@compiled
def advance_grasp(
    handle: Record,
    joined: Record,
    hand: HandBody,
    now: Grasp,
    motor: Force,
    script: Force,
    duration: float,
) -> Grasp:
    """Handle and hand after `duration`.

    handle and joined are records of dtype PLANT: the handle alone, and both as one (their masses,
    dampings and springs added). motor is what acts on the handle, script what acts on the hand
    but for its own damper and spring (a ramp: it has no excess).
    """
    t = 0.0
    for _ in range(MAX_EVENTS):
        if not t < duration:
            return now
        remaining = duration - t
        if now.touching:
            dt, now = _together(joined, hand, now, later(motor, t), later(script, t), remaining)
        else:
            dt, now = _apart(handle, hand, now, later(motor, t), later(script, t), remaining)
        t = passed(t, dt, duration)
    return Grasp(math.nan, math.nan, math.nan, math.nan, False)
