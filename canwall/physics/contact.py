"""Contact of hand and handle as two bodies: it can press but not pull.

While the hand presses, the two move as one. They part when the contact would have to pull, and
meet again when the gap between them closes. The impact is plastic: momentum is conserved, the
energy of the relative motion is lost.
"""

import math
import sys
from typing import NamedTuple

from canwall.compiled import Record, compiled
from canwall.physics.motion import (
    MAX_EVENTS,
    linear_piece,
    motion_from,
    move_to_event,
    quarter_period,
    time_after,
)
from canwall.physics.smooth import (
    EventFunction,
    Force,
    SmoothMotion,
    deviation,
    event_value,
    first_sign_change,
    largest_acceleration,
    shifted,
    state_at,
)


class HandBody(NamedTuple):
    """The hand as a body of its own.

    The rest position of its spring is part of the force of its script. side is the direction in
    which it presses: −1.0 down, 1.0 up.
    """

    mass: float
    viscous: float
    spring: float
    side: float


class Grasp(NamedTuple):
    """Position and velocity of handle and hand, which are equal while they touch."""

    y: float
    v: float
    hand_y: float
    hand_v: float
    touching: bool


#: Speed of a handle that has just broken loose; small enough to add nothing.
_LEAST_SPEED = sys.float_info.min

#: Bound of the steps towards the closing of a gap; far more than rounding allows.
_MAX_STEPS = 10_000
#: Shortest step of a flight, as a share of its span: right after parting the gap is zero and opens.
_SHORTEST_FLIGHT = 2.0**-20


@compiled
def _time_to_close(handle: SmoothMotion, hand: SmoothMotion, side: float, span: float) -> float:
    """Return the first time in (0, span] at which the gap closes, else inf.

    A step is no longer than the largest relative acceleration would need to close the gap, so no
    closing is stepped over; near it the steps are those of Newton's method.
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
        moved, accelerated = deviation(handle, t)
        hand_moved, hand_accelerated = deviation(hand, t)
        gap = gap0 + speed0 * t + side * (moved - hand_moved)
        speed = speed0 + side * (accelerated - hand_accelerated)
    return t


@compiled
def contact_force(hand: HandBody, script: Force, y: float, v: float, a: float) -> float:
    """Return the force with which a hand that moves with the handle presses; negative: it pulls."""
    push = script.constant - hand.viscous * v - hand.spring * y - hand.mass * a
    return hand.side * push


@compiled
def _contact_force_event(hand: HandBody, script: Force) -> EventFunction:
    """Return `contact_force` as an event function of the joint motion."""
    side = hand.side
    return EventFunction(
        side * script.constant,
        side * script.slope,
        -side * hand.spring,
        -side * hand.viscous,
        -side * hand.mass,
    )


@compiled
def _move_together(
    joined: Record, hand: HandBody, now: Grasp, motor: Force, script: Force, remaining: float
) -> tuple[float, Grasp]:
    """Move both as one to the next event: (duration, grasp at its end)."""
    total = Force(
        motor.constant + script.constant, motor.slope + script.slope, motor.excess, motor.rate
    )
    y, v = now.y, now.v
    piece, _ = linear_piece(joined, y, v, total.constant)
    stuck, motion, direction = motion_from(joined, piece, y, v, total, remaining)
    if stuck > 0.0:
        # At rest the contact force is the hand's own force.
        press = contact_force(hand, script, y, 0.0, 0.0)
        fading = -hand.side * script.slope
        if press < 0.0:
            return 0.0, Grasp(y, v, y, v, False)
        if fading > 0.0 and press / fading < min(stuck, remaining):
            return press / fading, Grasp(y, v, y, v, False)
        if stuck >= remaining:
            return remaining, Grasp(y, v, y, v, True)
    event = _contact_force_event(hand, shifted(script, stuck))
    if event_value(motion, event, 0, 0.0)[0] < 0.0:
        # Loose from its stiction, the handle would stick anew if it were at rest without the hand.
        v = direction * _LEAST_SPEED if stuck > 0.0 else v
        return stuck, Grasp(y, v, y, v, False)
    dt, y, v = move_to_event(piece, motion, direction, remaining - stuck)
    parting = first_sign_change(motion, event, 1.0, dt)
    if parting < dt:
        y, v = state_at(motion, parting)
        return stuck + parting, Grasp(y, v, y, v, False)
    return stuck + dt, Grasp(y, v, y, v, True)


@compiled
def _impact(handle: SmoothMotion, hand: SmoothMotion, t: float) -> Grasp:
    """Return both as one after the impact at time t."""
    y, v = state_at(handle, t)
    _, hand_v = state_at(hand, t)
    v += (hand_v - v) * hand.mass / (handle.mass + hand.mass)
    return Grasp(y, v, y, v, True)


@compiled
def _move_apart(
    handle: Record, hand: HandBody, now: Grasp, motor: Force, script: Force, remaining: float
) -> tuple[float, Grasp]:
    """Move each alone to the next event: (duration, grasp at its end)."""
    y, v = now.y, now.v
    piece, _ = linear_piece(handle, y, v, motor.constant)
    stuck, motion, direction = motion_from(handle, piece, y, v, motor, remaining)
    span = min(remaining, quarter_period(hand.mass, hand.spring))
    flight = SmoothMotion(
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
        still = SmoothMotion(handle.mass, 0.0, 0.0, y, 0.0, 0.0, 0.0, 0.0, 0.0)
        wait = min(stuck, span)
        closing = _time_to_close(still, flight, hand.side, wait)
        if closing <= wait:
            return closing, _impact(still, flight, closing)
        hand_y, hand_v = state_at(flight, wait)
        if stuck >= span:
            return wait, Grasp(y, 0.0, hand_y, hand_v, False)
        script = shifted(script, stuck)
        flight = SmoothMotion(
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
    dt, y, v = move_to_event(piece, motion, direction, span - stuck)
    closing = _time_to_close(motion, flight, hand.side, dt)
    if closing <= dt:
        return stuck + closing, _impact(motion, flight, closing)
    hand_y, hand_v = state_at(flight, dt)
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
    """Return handle and hand after `duration`.

    Args:
        handle: Plant of the handle alone, a record of dtype PLANT.
        joined: Plant of both as one, with masses, dampings and springs added.
        hand: The hand alone.
        now: State at the start.
        motor: Force on the handle.
        script: Force on the hand, besides its damper and spring; a ramp without excess.
        duration: Time [s].
    """
    t = 0.0
    for _ in range(MAX_EVENTS):
        if not t < duration:
            return now
        remaining = duration - t
        if now.touching:
            dt, now = _move_together(
                joined, hand, now, shifted(motor, t), shifted(script, t), remaining
            )
        else:
            dt, now = _move_apart(
                handle, hand, now, shifted(motor, t), shifted(script, t), remaining
            )
        t = time_after(t, dt, duration)
    return Grasp(math.nan, math.nan, math.nan, math.nan, False)
