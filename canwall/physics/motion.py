"""Motion of a handle with Coulomb friction and, where there is one, a continuous wall: event-exact.

Between events the handle is the linear oscillator of `oscillator`. Events are the reversal of
the velocity (where friction changes its sign, or the handle sticks) and the crossing of the wall
at y = 0. Each is found as the one root in a bracket on which its function is monotone, so none is
missed and none is found twice.

The same function moves the simulated drive (no wall: the drive's torque is the wall) and the
continuous referent that every law is compared with (a wall of stiffness K and damping B).
"""

import math

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.physics.oscillator import acceleration, flow

#: What moves and what it moves against. Inside the wall (y < 0) stiffness K and damping B join
#: the spring and the viscous damping. Units: any consistent set, SI in this project.
PLANT = np.dtype(
    [
        ("mass", "f8"),
        ("viscous", "f8"),
        ("spring", "f8"),
        ("coulomb", "f8"),
        ("wall_stiffness", "f8"),
        ("wall_damping", "f8"),
    ],
    align=True,
)

#: Events within one call beyond which the motion is taken for lost and returned as NaN rather
#: than followed for ever. A period of a servo loop has a handful.
MAX_EVENTS = 1_000_000

_POSITION, _VELOCITY, _ACCELERATION = 0, 1, 2
_MAX_ITERATIONS = 200


def make_plant(
    mass: float,
    viscous: float = 0.0,
    spring: float = 0.0,
    coulomb: float = 0.0,
    wall_stiffness: float = 0.0,
    wall_damping: float = 0.0,
) -> NDArray[np.void]:
    """One plant as an array of shape (1,) and dtype PLANT, as compiled code takes it.

    Raises ValueError unless mass > 0 and the rest ≥ 0, all finite.
    """
    values = (mass, viscous, spring, coulomb, wall_stiffness, wall_damping)
    if not all(math.isfinite(x) and x >= 0.0 for x in values) or mass == 0.0:
        raise ValueError(f"a plant needs mass > 0 and finite parameters ≥ 0, not {values}")
    return np.array([values], dtype=PLANT)


@compiled
def _derivatives(
    mass: float, viscous: float, spring: float, y: float, v: float, u0: float, u1: float, t: float
) -> tuple[float, float, float, float]:
    """Position, velocity, acceleration and jerk at time t."""
    y, v = flow(mass, viscous, spring, y, v, u0, u1, t)
    a = acceleration(mass, viscous, spring, y, v, u0 + u1 * t)
    return y, v, a, (u1 - viscous * a - spring * v) / mass


@compiled
def _root(
    order: int,
    mass: float,
    viscous: float,
    spring: float,
    y: float,
    v: float,
    u0: float,
    u1: float,
    low: float,
    high: float,
    rising: bool,
) -> float:
    """The root of position, velocity or acceleration in (low, high]: Newton kept in its bracket."""
    rounding = 4e-16 * high
    t = 0.5 * (low + high)
    for _ in range(_MAX_ITERATIONS):
        y_t, v_t, a_t, jerk_t = _derivatives(mass, viscous, spring, y, v, u0, u1, t)
        if order == _POSITION:
            value, slope = y_t, v_t
        elif order == _VELOCITY:
            value, slope = v_t, a_t
        else:
            value, slope = a_t, jerk_t
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
def _reversal(
    mass: float,
    viscous: float,
    spring: float,
    y: float,
    v: float,
    u0: float,
    u1: float,
    direction: float,
    span: float,
) -> float:
    """First time in (0, span] at which the velocity has turned against `direction`, else span.

    span is at most a quarter period, so the acceleration has one zero at the most and the
    velocity is monotone on either side of it.
    """
    _, v_end, a_end, _ = _derivatives(mass, viscous, spring, y, v, u0, u1, span)
    a_start = acceleration(mass, viscous, spring, y, v, u0)
    peak = 0.0
    if a_start * a_end < 0.0:
        peak = _root(_ACCELERATION, mass, viscous, spring, y, v, u0, u1, 0.0, span, a_end > 0.0)
        _, v_peak, _, _ = _derivatives(mass, viscous, spring, y, v, u0, u1, peak)
        if direction * v_peak < 0.0:
            return _root(_VELOCITY, mass, viscous, spring, y, v, u0, u1, 0.0, peak, direction < 0.0)
    if direction * v_end < 0.0:
        return _root(_VELOCITY, mass, viscous, spring, y, v, u0, u1, peak, span, direction < 0.0)
    return span


@compiled
def _is_inside(plant: Record, y: float, v: float, pull: float) -> bool:
    """Whether the wall acts: on the threshold the motion decides, at rest what pulls."""
    if plant.wall_stiffness == 0.0 and plant.wall_damping == 0.0:
        return False
    return y < 0.0 or (y == 0.0 and (v < 0.0 or (v == 0.0 and pull < 0.0)))


@compiled
def _segment(
    plant: Record, y: float, v: float, u0: float, u1: float, remaining: float, inside: bool
) -> tuple[float, float, float]:
    """Motion up to the next event, no longer than `remaining`: (duration, y, ẏ).

    At a crossing of the wall y is 0 exactly, at a reversal ẏ is; both are what the next segment
    recognises them by.
    """
    viscous = plant.viscous + (plant.wall_damping if inside else 0.0)
    spring = plant.spring + (plant.wall_stiffness if inside else 0.0)
    stuck = 0.0
    if v != 0.0:
        direction = 1.0 if v > 0.0 else -1.0
        force = u0 - direction * plant.coulomb
    else:
        pull = u0 - spring * y
        direction = 1.0 if pull > 0.0 else -1.0
        force = u0 - direction * plant.coulomb
        # Asked of what the flow will be given: one that rounds to the other side of the
        # threshold would be turned back at once, and time would stand still.
        if direction * (force - spring * y) <= 0.0:
            # Stuck until the ramp of the external force breaks it loose, if it does.
            if u1 == 0.0:
                return remaining, y, v
            direction = 1.0 if u1 > 0.0 else -1.0
            stuck = max(plant.coulomb - direction * pull, 0.0) / abs(u1)
            if stuck >= remaining:
                return remaining, y, v
            # Friction and spring balance to the last bit here; recomputed from u₀ + u₁·t the
            # acceleration could come out with the wrong sign and end the slip at once.
            force = spring * y
    omega = math.sqrt(spring / plant.mass)
    span = remaining - stuck
    if omega > 0.0:
        span = min(span, 0.5 * math.pi / omega)
    # Up to its reversal the velocity keeps its sign, so the position is monotone.
    dt = _reversal(plant.mass, viscous, spring, y, v, force, u1, direction, span)
    y_end, v_end = flow(plant.mass, viscous, spring, y, v, force, u1, dt)
    leaves = inside and direction > 0.0 and y_end >= 0.0
    enters = not inside and direction < 0.0 and y_end < 0.0
    if leaves or (enters and _is_inside(plant, y_end, v_end, 0.0)):
        dt = _root(
            _POSITION, plant.mass, viscous, spring, y, v, force, u1, 0.0, dt, direction > 0.0
        )
        _, v_end = flow(plant.mass, viscous, spring, y, v, force, u1, dt)
        return stuck + dt, 0.0, v_end
    if dt < span or direction * v_end <= 0.0:
        v_end = 0.0
    return stuck + dt, y_end, v_end


@compiled
def advance(
    plant: Record, y: float, v: float, u0: float, u1: float, duration: float
) -> tuple[float, float, bool]:
    """State (y, ẏ) after `duration` under the external force u₀ + u₁·t, from (y, v).

    plant is a record of dtype PLANT, y is measured from the wall (y < 0 inside). The third value
    tells whether the wall acted at any time. Coulomb friction is set-valued at rest: the handle
    sticks as long as what pulls it stays within ±coulomb, and starts to slip at the very instant
    at which it no longer does.
    """
    t = 0.0
    touched = False
    for _ in range(MAX_EVENTS):
        if not t < duration:
            return y, v, touched
        u = u0 + u1 * t
        inside = _is_inside(plant, y, v, u - plant.spring * y)
        touched = touched or inside
        remaining = duration - t
        dt, y, v = _segment(plant, y, v, u, u1, remaining, inside)
        t = duration if dt >= remaining else t + dt
    return math.nan, math.nan, touched


@compiled
def time_to_wall(plant: Record, y: float, v: float, u: float, duration: float) -> float:
    """When a handle outside (y ≥ 0) that would be inside after `duration` crosses y = 0.

    Free motion under the constant force u, no friction: the one crossing that the sign change at
    the end of the interval vouches for.
    """
    return _root(
        _POSITION, plant.mass, plant.viscous, plant.spring, y, v, u, 0.0, 0.0, duration, False
    )


#: Segments (of a quarter period each, at most) after which a contact is taken for one that does
#: not end: overdamped, it creeps towards its rest without ever turning round.
_CONTACT_SEGMENTS = 64


@compiled
def contact_end(plant: Record, y: float, v: float, u: float, horizon: float) -> tuple[float, float]:
    """Time until the contact that lies ahead, or is on, has ended, and the velocity then.

    From (y, v) under the constant force u. (inf, 0) where no contact begins within `horizon`, or
    where it never ends: a handle that turns round again inside the wall stays there.
    """
    t = 0.0
    entered = False
    for _ in range(_CONTACT_SEGMENTS):
        inside = _is_inside(plant, y, v, u - plant.spring * y)
        if entered and not inside:
            return t, v
        if not inside and t >= horizon:
            break
        outward = v > 0.0
        entered = entered or inside
        remaining = horizon - t
        if inside:
            # A quarter period at a time; without a spring, as far ahead as was asked for.
            swings = plant.spring > 0.0 or plant.wall_stiffness > 0.0
            remaining = math.inf if swings else horizon
        dt, y, v = _segment(plant, y, v, u, 0.0, remaining, inside)
        t += dt
        if inside and v == 0.0 and outward:
            break
    return math.inf, 0.0
