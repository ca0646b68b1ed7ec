"""Motion of a handle with Coulomb friction, cogging and, optionally, a continuous wall.

The motion is exact up to its events. Between them the handle is the linear oscillator of `smooth`.
Events are a reversal of the velocity (friction changes its sign, or the handle sticks), breaking
loose, and crossing the wall at y = 0 or the edge between two halves of a cog. Each is found as the
only root in a bracket on which its function is monotone, so none is missed or found twice.

The same functions move the simulated drive (without a wall: its torque is the wall) and the
continuous referent that every law is compared with (with a wall of stiffness K and damping B).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.physics.oscillator import acceleration
from canwall.physics.smooth import (
    ACCELERATION,
    VELOCITY,
    EventFunction,
    Force,
    SmoothMotion,
    find_root,
    first_sign_change,
    largest_acceleration,
    shifted,
    state_at,
)

#: Parameters of a handle. It moves against `coulomb`, and from rest once the force on it exceeds
#: `stiction`. Inside the wall (y < 0) wall_stiffness K and wall_damping B add to spring
#: and viscous damping. The cogging torque is a triangle wave over y + cog_origin with amplitude
#: `cogging` and period `cog_pitch`; it pulls towards 0 about 0 and conserves energy. Units are any
#: consistent set, SI in this project.
PLANT = np.dtype(
    [
        ("mass", "f8"),
        ("viscous", "f8"),
        ("spring", "f8"),
        ("coulomb", "f8"),
        ("stiction", "f8"),
        ("wall_stiffness", "f8"),
        ("wall_damping", "f8"),
        ("cogging", "f8"),
        ("cog_pitch", "f8"),
        ("cog_origin", "f8"),
    ],
    align=True,
)

#: Largest number of events in one call, beyond which the result is NaN. A period of a servo loop
#: has a handful.
MAX_EVENTS = 1_000_000

_ROUNDING = 2.0**-52


def make_plant(
    mass: float,
    viscous: float = 0.0,
    spring: float = 0.0,
    coulomb: float = 0.0,
    wall_stiffness: float = 0.0,
    wall_damping: float = 0.0,
    cogging: float = 0.0,
    cog_pitch: float = 1.0,
    stiction: float | None = None,
) -> NDArray[np.void]:
    """Make a plant for compiled code.

    Args:
        mass: Mass or inertia.
        viscous: Viscous damping.
        spring: Spring about y = 0.
        coulomb: Coulomb friction.
        wall_stiffness: Stiffness K of the wall in y < 0.
        wall_damping: Damping B of the wall.
        cogging: Amplitude of the cogging torque.
        cog_pitch: Its period.
        stiction: Friction that holds at rest. Default: Coulomb friction.

    Returns:
        Array of shape (1,), dtype PLANT.

    Raises:
        ValueError: Unless mass and cog_pitch are > 0, the rest ≥ 0, all finite, and stiction ≥
            coulomb.
    """
    holds = coulomb if stiction is None else stiction
    wall = (wall_stiffness, wall_damping)
    values = (mass, viscous, spring, coulomb, holds, *wall, cogging, cog_pitch)
    if holds < coulomb:
        raise ValueError(f"a plant needs a stiction of at least {coulomb}, not {holds}")
    if not all(math.isfinite(x) and x >= 0.0 for x in values) or mass == 0.0 or cog_pitch == 0.0:
        raise ValueError(f"a plant needs mass > 0 and finite parameters ≥ 0, not {values}")
    return np.array([(*values, 0.0)], dtype=PLANT)


class Piece(NamedTuple):
    """Range of positions over which the forces on the handle are linear.

    viscous and spring are the sums of all that act there, force is their force at y = 0.
    """

    viscous: float
    spring: float
    force: float
    lower: float
    upper: float


@compiled
def _is_inside(plant: Record, y: float, v: float, pull: float) -> bool:
    """Return whether the wall acts; on the threshold velocity decides, at rest the force."""
    if plant.wall_stiffness == 0.0 and plant.wall_damping == 0.0:
        return False
    return y < 0.0 or (y == 0.0 and (v < 0.0 or (v == 0.0 and pull < 0.0)))


@compiled
def _upper_edge(plant: Record, index: int) -> float:
    """Return the upper edge of half a cog; a single formula lets edges compare exactly."""
    return (index + 0.5) * (0.5 * plant.cog_pitch) - plant.cog_origin


@compiled
def _half_cog(plant: Record, y: float, v: float, u: float) -> Piece:
    """Return the half of a cog at y: a spring about its middle, positive or negative."""
    half = 0.5 * plant.cog_pitch
    index = math.floor((y + plant.cog_origin) / half + 0.5)
    # The edges decide, not the rounded quotient.
    if y < _upper_edge(plant, index - 1):
        index -= 1
    elif y >= _upper_edge(plant, index):
        index += 1
    if y == _upper_edge(plant, index - 1):
        # On an edge velocity decides, at rest the force; the torque is the same on both sides.
        torque = plant.cogging if index % 2 == 0 else -plant.cogging
        if v < 0.0 or (v == 0.0 and u + torque - plant.spring * y < 0.0):
            index -= 1
    stiffness = 2.0 * plant.cogging / half
    if index % 2 != 0:
        stiffness = -stiffness
    return Piece(
        plant.viscous,
        plant.spring + stiffness,
        stiffness * (index * half - plant.cog_origin),
        _upper_edge(plant, index - 1),
        _upper_edge(plant, index),
    )


@compiled
def linear_piece(plant: Record, y: float, v: float, u: float) -> tuple[Piece, bool]:
    """Return the linear piece at y under the external force u, and whether the wall acts."""
    piece = Piece(plant.viscous, plant.spring, 0.0, -math.inf, math.inf)
    if plant.cogging > 0.0:
        piece = _half_cog(plant, y, v, u)
    if plant.wall_stiffness == 0.0 and plant.wall_damping == 0.0:
        return piece, False
    inside = _is_inside(plant, y, v, u + piece.force - piece.spring * y)
    if inside:
        return Piece(
            piece.viscous + plant.wall_damping,
            piece.spring + plant.wall_stiffness,
            piece.force,
            piece.lower,
            min(piece.upper, 0.0),
        ), True
    return Piece(
        piece.viscous, piece.spring, piece.force, max(piece.lower, 0.0), piece.upper
    ), False


@compiled
def _time_to_break_loose(
    pull: float, stiction: float, force: Force, horizon: float
) -> tuple[float, float]:
    """Return when the force on a stuck handle exceeds its friction, and in which direction.

    pull is that force now, `force` its change over time. The time is inf if it never does.
    """
    if force.excess == 0.0:
        if force.slope == 0.0:
            return math.inf, 0.0
        direction = 1.0 if force.slope > 0.0 else -1.0
        return max(stiction - direction * pull, 0.0) / abs(force.slope), direction
    # What decays is monotone: within these bounds the force stays.
    ramp = force.slope * horizon
    decay = force.excess * -math.expm1(-force.rate * horizon)
    lowest = pull + min(ramp, 0.0) - max(decay, 0.0)
    highest = pull + max(ramp, 0.0) - min(decay, 0.0)
    if -stiction < lowest and highest < stiction:
        return math.inf, 0.0
    # The acceleration of a free unit mass is the force, so the remaining friction is an event
    # function of its motion.
    free = SmoothMotion(1.0, 0.0, 0.0, 0.0, 0.0, pull, force.slope, force.excess, force.rate)
    up = first_sign_change(free, EventFunction(stiction, 0.0, 0.0, 0.0, -1.0), 1.0, horizon)
    down = first_sign_change(free, EventFunction(stiction, 0.0, 0.0, 0.0, 1.0), 1.0, horizon)
    return (up, 1.0) if up <= down else (down, -1.0)


@compiled
def motion_from(
    plant: Record, piece: Piece, y: float, v: float, force: Force, horizon: float
) -> tuple[float, SmoothMotion, float]:
    """Return the motion from a state on: (time for which it sticks, motion after it, direction).

    The time is at least `horizon` if the handle sticks that long.
    """
    spring = piece.spring
    u = force.constant + piece.force
    stuck = 0.0
    if v != 0.0:
        direction = 1.0 if v > 0.0 else -1.0
        constant = u - direction * plant.coulomb
    else:
        pull = u - spring * y
        direction = 1.0 if pull > 0.0 else -1.0
        constant = u - direction * plant.coulomb
        # Test the values that the flow will get: one that rounds to the other side of the
        # threshold would reverse at once, and time would not advance.
        if direction * (u - direction * plant.stiction - spring * y) <= 0.0:
            # Stuck until the external force breaks it loose, if ever.
            stuck, direction = _time_to_break_loose(pull, plant.stiction, force, horizon)
            if stuck < horizon:
                force = shifted(force, stuck)
            # Stiction and spring balance exactly here; recomputed from the force, the acceleration
            # could have the wrong sign by rounding and end the slip at once.
            constant = spring * y + direction * (plant.stiction - plant.coulomb)
    motion = SmoothMotion(
        plant.mass,
        piece.viscous,
        spring,
        y,
        v,
        constant,
        force.slope,
        force.excess,
        force.rate,
    )
    return stuck, motion, direction


@compiled
def _reversal(
    motion: SmoothMotion, direction: float, span: float, y_end: float, v_end: float
) -> float:
    """Return the first time in (0, span] at which the velocity reverses, else span.

    span is at most a quarter period, (y_end, v_end) the state at its end.
    """
    if motion.excess != 0.0:
        if abs(motion.v) > largest_acceleration(motion, span) * span:
            return span
        return min(first_sign_change(motion, VELOCITY, direction, span), span)
    # Without a lag the acceleration has at most one zero, and the velocity is monotone on either
    # side of it.
    m = motion
    a_start = acceleration(m.mass, m.viscous, m.spring, m.y, m.v, m.constant)
    a_end = acceleration(m.mass, m.viscous, m.spring, y_end, v_end, m.constant + m.slope * span)
    peak = 0.0
    if a_start * a_end < 0.0:
        peak = find_root(motion, ACCELERATION, 0, 0.0, span, a_end > 0.0)
        _, v_peak = state_at(motion, peak)
        if direction * v_peak < 0.0:
            return find_root(motion, VELOCITY, 0, 0.0, peak, direction < 0.0)
    if direction * v_end < 0.0:
        return find_root(motion, VELOCITY, 0, peak, span, direction < 0.0)
    return span


@compiled
def quarter_period(mass: float, spring: float) -> float:
    """Return a quarter of the undamped period, for |spring|; inf without a spring."""
    omega = math.sqrt(abs(spring) / mass)
    return 0.5 * math.pi / omega if omega > 0.0 else math.inf


@compiled
def move_to_event(
    piece: Piece, motion: SmoothMotion, direction: float, horizon: float
) -> tuple[float, float, float]:
    """Move to the next event, no further than `horizon`: (duration, y, ẏ).

    At the edge of a piece y is exactly that edge, at a reversal ẏ is 0: the next motion recognises
    them by these values.
    """
    span = min(horizon, quarter_period(motion.mass, motion.spring))
    # Up to its reversal the velocity keeps its sign, so the position is monotone.
    y_end, v_end = state_at(motion, span)
    dt = _reversal(motion, direction, span, y_end, v_end)
    if dt < span:
        y_end, v_end = state_at(motion, dt)
    edge = piece.upper if direction > 0.0 else piece.lower
    if (direction > 0.0 and y_end >= edge) or (direction < 0.0 and y_end < edge):
        dt = find_root(
            motion, EventFunction(-edge, 0.0, 1.0, 0.0, 0.0), 0, 0.0, dt, direction > 0.0
        )
        _, v_end = state_at(motion, dt)
        return dt, edge, v_end
    if dt < span or direction * v_end <= 0.0:
        v_end = 0.0
    return dt, y_end, v_end


@compiled
def _segment(
    plant: Record, y: float, v: float, force: Force, remaining: float
) -> tuple[float, float, float, bool]:
    """Move to the next event, no further than `remaining`: (duration, y, ẏ, wall acts)."""
    piece, inside = linear_piece(plant, y, v, force.constant)
    stuck, motion, direction = motion_from(plant, piece, y, v, force, remaining)
    if stuck >= remaining:
        return remaining, y, v, inside
    dt, y, v = move_to_event(piece, motion, direction, remaining - stuck)
    return stuck + dt, y, v, inside


@compiled
def time_after(t: float, dt: float, duration: float) -> float:
    """Return the time after a step; it always advances, however short the step."""
    if dt >= duration - t:
        return duration
    return t + dt if t + dt > t else t + _ROUNDING * duration


@compiled
def advance(
    plant: Record,
    y: float,
    v: float,
    u0: float,
    u1: float,
    duration: float,
    excess: float = 0.0,
    rate: float = 0.0,
) -> tuple[float, float, bool]:
    """Return the state after `duration` under u₀ + u₁·t − excess·(1 − exp(−rate·t)).

    Friction is set-valued at rest: the handle sticks while the force on it stays within
    ±stiction, and starts to slip at the instant at which it no longer does.

    Args:
        plant: Handle and wall, a record of dtype PLANT.
        y: Position at the start, from the wall, y < 0 inside.
        v: Velocity at the start.
        u0: External force at the start.
        u1: Slope of the external force.
        duration: Time [s].
        excess: Part of the force that decays.
        rate: Rate of the decay [1/s].

    Returns:
        (y, ẏ), and whether the wall acted at any time.
    """
    t = 0.0
    touched = False
    force = Force(u0, u1, excess, rate)
    for _ in range(MAX_EVENTS):
        if not t < duration:
            return y, v, touched
        dt, y, v, inside = _segment(plant, y, v, shifted(force, t), duration - t)
        touched = touched or inside
        t = time_after(t, dt, duration)
    return math.nan, math.nan, touched


@compiled
def time_to_wall(plant: Record, y: float, v: float, u: float, duration: float) -> float:
    """Return when a handle outside (y ≥ 0) that would be inside after `duration` crosses y = 0.

    Under the constant force u and without friction; the sign change guarantees a crossing.
    """
    motion = SmoothMotion(plant.mass, plant.viscous, plant.spring, y, v, u, 0.0, 0.0, 0.0)
    return find_root(motion, EventFunction(0.0, 0.0, 1.0, 0.0, 0.0), 0, 0.0, duration, False)


#: Segments, each a quarter period at most, after which a contact counts as one without an end:
#: overdamped, it creeps towards its rest and never reverses.
_CONTACT_SEGMENTS = 64


@compiled
def contact_end(plant: Record, y: float, v: float, u: float, horizon: float) -> tuple[float, float]:
    """Return the time until the present or next contact has ended, and the velocity then.

    From (y, v) under the constant force u. (inf, 0) if no contact begins within `horizon`, or if
    it never ends: a handle that reverses inwards inside the wall stays there.
    """
    t = 0.0
    entered = False
    force = Force(u, 0.0, 0.0, 0.0)
    for _ in range(_CONTACT_SEGMENTS):
        _, inside = linear_piece(plant, y, v, u)
        if entered and not inside:
            return t, v
        if not inside and t >= horizon:
            break
        outward = v > 0.0
        entered = entered or inside
        remaining = horizon - t
        if inside:
            # With a spring the segment ends after a quarter period, without one at the horizon.
            swings = plant.spring > 0.0 or plant.wall_stiffness > 0.0
            remaining = math.inf if swings else horizon
        dt, y, v, _ = _segment(plant, y, v, force, remaining)
        t += dt
        if inside and v == 0.0 and outward:
            break
    return math.inf, 0.0
