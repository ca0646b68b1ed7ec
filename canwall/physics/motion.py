"""Motion of a handle with Coulomb friction, cogging and, where there is one, a continuous wall.

Event-exact: between events the handle is the linear oscillator of `smooth`. Events are the
reversal of the velocity (where friction changes its sign, or the handle sticks), its breaking
loose, and the crossing of the wall at y = 0 or from one half of a cog to the next. Each is found
as the one root in a bracket on which its function is monotone, so none is missed and none is
found twice.

The same function moves the simulated drive (no wall: the drive's torque is the wall) and the
continuous referent that every law is compared with (a wall of stiffness K and damping B).
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
    Smooth,
    first_turn,
    later,
    root,
    state,
)

#: What moves and what it moves against. Inside the wall (y < 0) stiffness K and damping B join
#: the spring and the viscous damping. The cogging torque is a triangle wave over y + cog_origin
#: with amplitude `cogging` and period `cog_pitch`, pulling towards 0 at 0: it stores and returns
#: energy. Units: any consistent set, SI in this project.
PLANT = np.dtype(
    [
        ("mass", "f8"),
        ("viscous", "f8"),
        ("spring", "f8"),
        ("coulomb", "f8"),
        ("wall_stiffness", "f8"),
        ("wall_damping", "f8"),
        ("cogging", "f8"),
        ("cog_pitch", "f8"),
        ("cog_origin", "f8"),
    ],
    align=True,
)

#: Events within one call beyond which the motion is taken for lost and returned as NaN rather
#: than followed for ever. A period of a servo loop has a handful.
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
) -> NDArray[np.void]:
    """One plant as an array of shape (1,) and dtype PLANT, as compiled code takes it.

    Raises ValueError unless mass and cog_pitch > 0 and the rest ≥ 0, all finite.
    """
    values = (mass, viscous, spring, coulomb, wall_stiffness, wall_damping, cogging, cog_pitch)
    if not all(math.isfinite(x) and x >= 0.0 for x in values) or mass == 0.0 or cog_pitch == 0.0:
        raise ValueError(f"a plant needs mass > 0 and finite parameters ≥ 0, not {values}")
    return np.array([(*values, 0.0)], dtype=PLANT)


class Piece(NamedTuple):
    """A stretch of positions over which what the handle moves against is linear.

    viscous and spring are the sums of what acts there, force is what they pull with at y = 0.
    """

    viscous: float
    spring: float
    force: float
    lower: float
    upper: float


@compiled
def _is_inside(plant: Record, y: float, v: float, pull: float) -> bool:
    """Whether the wall acts: on the threshold the motion decides, at rest what pulls."""
    if plant.wall_stiffness == 0.0 and plant.wall_damping == 0.0:
        return False
    return y < 0.0 or (y == 0.0 and (v < 0.0 or (v == 0.0 and pull < 0.0)))


@compiled
def _upper_edge(plant: Record, index: int) -> float:
    """Where a half of a cog ends. One formula for all that is compared with it, to the last bit."""
    return (index + 0.5) * (0.5 * plant.cog_pitch) - plant.cog_origin


@compiled
def _half_cog(plant: Record, y: float, v: float, u: float) -> Piece:
    """The half of a cog at y: a spring about its middle that pulls back, or pushes away."""
    half = 0.5 * plant.cog_pitch
    index = math.floor((y + plant.cog_origin) / half + 0.5)
    # The edges decide, not the rounding of the division.
    if y < _upper_edge(plant, index - 1):
        index -= 1
    elif y >= _upper_edge(plant, index):
        index += 1
    if y == _upper_edge(plant, index - 1):
        # On an edge the motion decides, at rest what pulls; the torque is the same on both sides.
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
def piece_at(plant: Record, y: float, v: float, u: float) -> tuple[Piece, bool]:
    """What the handle moves against at y under the external force u, and whether the wall acts."""
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
    pull: float, coulomb: float, force: Force, horizon: float
) -> tuple[float, float]:
    """When what pulls a stuck handle exceeds its friction, and in which direction; else inf.

    pull is what pulls it now, `force` how that changes.
    """
    if force.excess == 0.0:
        if force.slope == 0.0:
            return math.inf, 0.0
        direction = 1.0 if force.slope > 0.0 else -1.0
        return max(coulomb - direction * pull, 0.0) / abs(force.slope), direction
    # A free unit mass is accelerated by what pulls: what is left of the friction is event_value.
    free = Smooth(1.0, 0.0, 0.0, 0.0, 0.0, pull, force.slope, force.excess, force.rate)
    up = first_turn(free, EventFunction(coulomb, 0.0, 0.0, 0.0, -1.0), 1.0, horizon)
    down = first_turn(free, EventFunction(coulomb, 0.0, 0.0, 0.0, 1.0), 1.0, horizon)
    return (up, 1.0) if up <= down else (down, -1.0)


@compiled
def onset(
    plant: Record, piece: Piece, y: float, v: float, force: Force, horizon: float
) -> tuple[float, Smooth, float]:
    """How it goes on from here: (time it stays stuck, motion after that, its direction).

    A handle that stays stuck beyond `horizon` has a time of at least that.
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
        # Asked of what the flow will be given: one that rounds to the other side of the
        # threshold would be turned back at once, and time would stand still.
        if direction * (constant - spring * y) <= 0.0:
            # Stuck until the external force breaks it loose, if it does.
            stuck, direction = _time_to_break_loose(pull, plant.coulomb, force, horizon)
            if stuck < horizon:
                force = later(force, stuck)
            # Friction and spring balance to the last bit here; recomputed from the force the
            # acceleration could come out with the wrong sign and end the slip at once.
            constant = spring * y
    motion = Smooth(
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
def _reversal(motion: Smooth, direction: float, span: float, y_end: float, v_end: float) -> float:
    """First time in (0, span] at which the velocity has turned against `direction`, else span.

    span is at most a quarter period, (y_end, v_end) the state then.
    """
    if motion.excess != 0.0:
        return min(first_turn(motion, VELOCITY, direction, span), span)
    # Without a lag the acceleration has one zero at the most, and the velocity is monotone on
    # either side of it.
    m = motion
    a_start = acceleration(m.mass, m.viscous, m.spring, m.y, m.v, m.constant)
    a_end = acceleration(m.mass, m.viscous, m.spring, y_end, v_end, m.constant + m.slope * span)
    peak = 0.0
    if a_start * a_end < 0.0:
        peak = root(motion, ACCELERATION, 0, 0.0, span, a_end > 0.0)
        _, v_peak = state(motion, peak)
        if direction * v_peak < 0.0:
            return root(motion, VELOCITY, 0, 0.0, peak, direction < 0.0)
    if direction * v_end < 0.0:
        return root(motion, VELOCITY, 0, peak, span, direction < 0.0)
    return span


@compiled
def quarter_period(mass: float, spring: float) -> float:
    """Of the undamped oscillator; the time in which a negative spring has its say; else inf."""
    omega = math.sqrt(abs(spring) / mass)
    return 0.5 * math.pi / omega if omega > 0.0 else math.inf


@compiled
def slide(
    piece: Piece, motion: Smooth, direction: float, horizon: float
) -> tuple[float, float, float]:
    """Motion up to the next event, no longer than horizon: (duration, y, ẏ).

    At the edge of a piece y is that edge exactly, at a reversal ẏ is 0; both are what the next
    motion recognises them by.
    """
    span = min(horizon, quarter_period(motion.mass, motion.spring))
    # Up to its reversal the velocity keeps its sign, so the position is monotone.
    y_end, v_end = state(motion, span)
    dt = _reversal(motion, direction, span, y_end, v_end)
    if dt < span:
        y_end, v_end = state(motion, dt)
    edge = piece.upper if direction > 0.0 else piece.lower
    if (direction > 0.0 and y_end >= edge) or (direction < 0.0 and y_end < edge):
        dt = root(motion, EventFunction(-edge, 0.0, 1.0, 0.0, 0.0), 0, 0.0, dt, direction > 0.0)
        _, v_end = state(motion, dt)
        return dt, edge, v_end
    if dt < span or direction * v_end <= 0.0:
        v_end = 0.0
    return dt, y_end, v_end


@compiled
def _segment(
    plant: Record, y: float, v: float, force: Force, remaining: float
) -> tuple[float, float, float, bool]:
    """Motion up to the next event, no longer than `remaining`: (duration, y, ẏ, wall acts)."""
    piece, inside = piece_at(plant, y, v, force.constant)
    stuck, motion, direction = onset(plant, piece, y, v, force, remaining)
    if stuck >= remaining:
        return remaining, y, v, inside
    dt, y, v = slide(piece, motion, direction, remaining - stuck)
    return stuck + dt, y, v, inside


@compiled
def passed(t: float, dt: float, duration: float) -> float:
    """The time after an event; it never stands still, however short the event."""
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
    """State (y, ẏ) after `duration` under u₀ + u₁·t − excess·(1 − exp(−rate·t)), from (y, v).

    plant is a record of dtype PLANT, y is measured from the wall (y < 0 inside). The third value
    tells whether the wall acted at any time. Coulomb friction is set-valued at rest: the handle
    sticks as long as what pulls it stays within ±coulomb, and starts to slip at the very instant
    at which it no longer does.
    """
    t = 0.0
    touched = False
    force = Force(u0, u1, excess, rate)
    for _ in range(MAX_EVENTS):
        if not t < duration:
            return y, v, touched
        dt, y, v, inside = _segment(plant, y, v, later(force, t), duration - t)
        touched = touched or inside
        t = passed(t, dt, duration)
    return math.nan, math.nan, touched


@compiled
def time_to_wall(plant: Record, y: float, v: float, u: float, duration: float) -> float:
    """When a handle outside (y ≥ 0) that would be inside after `duration` crosses y = 0.

    Free motion under the constant force u, no friction: the one crossing that the sign change at
    the end of the interval vouches for.
    """
    motion = Smooth(plant.mass, plant.viscous, plant.spring, y, v, u, 0.0, 0.0, 0.0)
    return root(motion, EventFunction(0.0, 0.0, 1.0, 0.0, 0.0), 0, 0.0, duration, False)


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
    force = Force(u, 0.0, 0.0, 0.0)
    for _ in range(_CONTACT_SEGMENTS):
        _, inside = piece_at(plant, y, v, u)
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
        dt, y, v, _ = _segment(plant, y, v, force, remaining)
        t += dt
        if inside and v == 0.0 and outward:
            break
    return math.inf, 0.0
