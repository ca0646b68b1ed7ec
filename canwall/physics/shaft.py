"""Motion of a rotor and a load on an elastic shaft, with friction and cogging on the rotor.

Between events this is a linear system of two masses. Its solution is a power series, summed to
rounding over a span in which it converges quickly. The velocity of the rotor and the torque on it
are then polynomials, whose first zeros are found without stepping over any: a step is no longer
than the largest second derivative would need to reach zero. Events are those of `motion`: the rotor
reverses or sticks, breaks loose, or crosses an edge between two halves of a cog.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.physics.motion import (
    MAX_EVENTS,
    PLANT,
    Piece,
    linear_piece,
    make_plant,
    time_after,
)
from canwall.physics.smooth import Force, shifted

#: Rotor (a plant without spring and wall), load, and the shaft between them. SI units.
SHAFT = np.dtype(
    [
        ("rotor", PLANT, (1,)),
        ("load_mass", "f8"),
        ("load_viscous", "f8"),
        ("load_spring", "f8"),
        ("stiffness", "f8"),
        ("damping", "f8"),
    ],
    align=True,
)

#: Terms of the power series. Within the reach the last one is below 2^26/26! ≈ 2e-19.
_TERMS = 27
_REACH = 2.0
_MAX_STEPS = 10_000
#: Share of a span in which a rotor that sets out from rest does not reverse.
_SETTING_OUT = 2.0**-20
#: Share of the torques on a rotor at rest by which rounding may have their sum wrong: a rotor that
#: is in balance would set out and reverse for ever.
_BALANCE = 2.0**-50

Array = NDArray[np.float64]


class TwoMasses(NamedTuple):
    """Position and velocity of rotor and load."""

    y: float
    v: float
    load_y: float
    load_v: float


def shaft_spring(
    inertia: float, rotor: float, resonance_hz: float, damping_ratio: float
) -> tuple[float, float]:
    """Return stiffness and damping of the shaft between two masses that resonate.

    They resonate at √(k/μ), where μ is their reduced mass.

    Args:
        inertia: Inertia of both masses together.
        rotor: That of one of them.
        resonance_hz: Resonance of one against the other [Hz].
        damping_ratio: Its damping ratio.
    """
    reduced = rotor * (inertia - rotor) / inertia
    resonance = 2.0 * math.pi * resonance_hz
    return resonance**2 * reduced, 2.0 * damping_ratio * resonance * reduced


def make_shaft(
    rotor: dict[str, float],
    load_mass: float,
    load_viscous: float,
    load_spring: float,
    stiffness: float,
    damping: float,
) -> NDArray[np.void]:
    """Make a shaft for compiled code.

    Args:
        rotor: Rotor, as keywords of `make_plant`, without spring and wall.
        load_mass: Mass or inertia of the load.
        load_viscous: Viscous damping of the load against the ground.
        load_spring: Spring of the load about 0.
        stiffness: Stiffness of the shaft.
        damping: Its damping.

    Returns:
        Array of shape (1,), dtype SHAFT.
    """
    shaft = np.zeros(1, SHAFT)
    shaft["rotor"] = make_plant(**rotor)
    shaft["load_mass"], shaft["load_viscous"] = load_mass, load_viscous
    shaft["load_spring"] = load_spring
    shaft["stiffness"], shaft["damping"] = stiffness, damping
    return shaft


@compiled
def _span(shaft: Record, piece: Piece, motor: Force, remaining: float) -> float:
    """Return a time in which the power series converges quickly."""
    rotor = shaft.rotor[0]
    stiffness = (shaft.stiffness + abs(piece.spring)) / rotor.mass
    stiffness += (shaft.stiffness + shaft.load_spring) / shaft.load_mass
    damping = (shaft.damping + piece.viscous) / rotor.mass
    damping += (shaft.damping + shaft.load_viscous) / shaft.load_mass
    fastest = math.sqrt(stiffness) + damping
    if motor.excess != 0.0:
        fastest += motor.rate
    return min(remaining, _REACH / fastest) if fastest > 0.0 else remaining


@compiled
def _expand(
    shaft: Record,
    piece: Piece,
    now: TwoMasses,
    motor: Force,
    script: Force,
    span: float,
    friction: float,
    setting_out: bool,
    series: Array,
) -> None:
    """Write the power series of the motion over a span into `series`, shape (5, _TERMS).

    In terms of time divided by span: position and velocity (times span) of rotor and load, and the
    torque on the rotor besides its friction. The rotor sticks where `friction` is NaN. Where it
    sets out from rest that torque is its stiction exactly, and `friction` what is left over.
    """
    rotor = shaft.rotor[0]
    stuck = math.isnan(friction)
    y, v, load_y, load_v, pull = series
    y[0], v[0] = now.y, now.v * span
    load_y[0], load_v[0] = now.load_y, now.load_v * span
    motor_term, script_term = motor.constant + piece.force, script.constant
    lag = motor.excess
    for n in range(_TERMS - 1):
        twist = shaft.stiffness * (load_y[n] - y[n]) + shaft.damping / span * (load_v[n] - v[n])
        pull[n] = motor_term + twist - piece.spring * y[n] - piece.viscous / span * v[n]
        on_load = script_term - twist
        on_load -= shaft.load_spring * load_y[n] + shaft.load_viscous / span * load_v[n]
        on_rotor = 0.0 if stuck else pull[n]
        if n == 0 and not stuck:
            on_rotor = friction if setting_out else pull[0] + friction
        share = 1.0 / (n + 1)
        y[n + 1], load_y[n + 1] = share * v[n], share * load_v[n]
        v[n + 1] = share * span * span / rotor.mass * on_rotor
        load_v[n + 1] = share * span * span / shaft.load_mass * on_load
        lag *= -share * motor.rate * span
        motor_term, script_term = lag, 0.0
        if n == 0:
            motor_term += motor.slope * span
            script_term = script.slope * span
    pull[_TERMS - 1] = 0.0


@compiled
def _value(series: Array, s: float) -> float:
    """Return a polynomial at s."""
    value = 0.0
    for n in range(len(series) - 1, -1, -1):
        value = value * s + series[n]
    return value


@compiled
def _first_zero(series: Array, offset: float, sign: float, start: float, end: float) -> float:
    """Return the first s in [start, end] at which offset + sign·polynomial is not positive, or inf.

    From one that is positive in the beginning, Newton's method with the largest second derivative
    added comes to the first zero from below.
    """
    above = offset + sign * series[0]
    below = most = 0.0
    for n in range(1, len(series)):
        below += abs(series[n])
        most += n * (n - 1) * abs(series[n])
    if above > below:
        return math.inf
    s = start
    for _ in range(_MAX_STEPS):
        value = slope = 0.0
        for n in range(len(series) - 1, -1, -1):
            slope = slope * s + value
            value = value * s + series[n]
        value, slope = offset + sign * value, sign * slope
        if value <= 0.0:
            return s
        room = math.sqrt(slope * slope + 2.0 * most * value)
        if slope < 0.0:
            step = 2.0 * value / (room - slope)
        else:
            step = (slope + room) / most if most > 0.0 else math.inf
        if s + step > end:
            return math.inf
        if step <= 1e-16 * max(s, start):
            return s
        s += step
    return s


@compiled
def _state(series: Array, span: float, s: float) -> TwoMasses:
    return TwoMasses(
        _value(series[0], s),
        _value(series[1], s) / span,
        _value(series[2], s),
        _value(series[3], s) / span,
    )


@compiled
def _slip(
    shaft: Record,
    piece: Piece,
    now: TwoMasses,
    motor: Force,
    script: Force,
    remaining: float,
    direction: float,
    setting_out: bool,
    series: Array,
) -> tuple[float, TwoMasses]:
    """Move a rotor that slips to the next event, no further than a span: (duration, state)."""
    rotor = shaft.rotor[0]
    span = _span(shaft, piece, motor, remaining)
    left = rotor.stiction if setting_out else 0.0
    friction = direction * (left - rotor.coulomb)
    _expand(shaft, piece, now, motor, script, span, friction, setting_out, series)
    start = _SETTING_OUT if now.v == 0.0 else 0.0
    s = _first_zero(series[1], 0.0, direction, start, 1.0)
    reverses = s <= 1.0
    s = min(s, 1.0)
    edge = piece.upper if direction > 0.0 else piece.lower
    y = _value(series[0], s)
    if (direction > 0.0 and y >= edge) or (direction < 0.0 and y < edge):
        # Up to its reversal the rotor moves one way, so that it is beyond the edge but once.
        s = min(s, _first_zero(series[0], direction * edge, -direction, 0.0, s))
        end = _state(series, span, s)
        return s * span, TwoMasses(edge, end.v, end.load_y, end.load_v)
    end = _state(series, span, s)
    if reverses or direction * end.v <= 0.0:
        end = TwoMasses(end.y, 0.0, end.load_y, end.load_v)
    return s * span, end


@compiled
def _segment(
    shaft: Record,
    now: TwoMasses,
    motor: Force,
    script: Force,
    remaining: float,
    series: Array,
) -> tuple[float, TwoMasses]:
    """Move to the next event, no further than a span: (duration, state)."""
    rotor = shaft.rotor[0]
    pull = motor.constant + shaft.stiffness * (now.load_y - now.y)
    pull += shaft.damping * (now.load_v - now.v)
    piece, _ = linear_piece(rotor, now.y, now.v, pull)
    if now.v != 0.0:
        direction = 1.0 if now.v > 0.0 else -1.0
        return _slip(shaft, piece, now, motor, script, remaining, direction, False, series)
    pull += piece.force - piece.spring * now.y
    terms = abs(motor.constant) + abs(piece.force) + abs(piece.spring * now.y)
    terms += shaft.stiffness * (abs(now.load_y) + abs(now.y))
    rounding = _BALANCE * terms
    direction = 1.0 if pull > 0.0 else -1.0
    if abs(pull) > rotor.stiction + rounding:
        return _slip(shaft, piece, now, motor, script, remaining, direction, False, series)

    span = _span(shaft, piece, motor, remaining)
    _expand(shaft, piece, now, motor, script, span, math.nan, False, series)
    # Above what it is held by: the series may begin at the other side of that, and fall.
    loose = rotor.stiction + 2.0 * rounding
    up = _first_zero(series[4], loose, -1.0, 0.0, 1.0)
    down = _first_zero(series[4], loose, 1.0, 0.0, 1.0)
    s = min(up, down)
    end = _state(series, span, min(s, 1.0))
    if s > 1.0:
        return span, end
    stuck = s * span
    direction = 1.0 if up <= down else -1.0
    motor, script = shifted(motor, stuck), shifted(script, stuck)
    dt, end = _slip(shaft, piece, end, motor, script, remaining - stuck, direction, True, series)
    return stuck + dt, end


@compiled
def advance_shaft(
    shaft: Record, now: TwoMasses, motor: Force, script: Force, duration: float
) -> TwoMasses:
    """Return rotor and load after `duration`.

    Args:
        shaft: Rotor, load and shaft, a record of dtype SHAFT.
        now: State at the start.
        motor: Force on the rotor.
        script: Force on the load, besides its damper and spring; a ramp without excess.
        duration: Time [s].
    """
    t = 0.0
    series = np.empty((5, _TERMS))
    for _ in range(MAX_EVENTS):
        if not t < duration:
            return now
        dt, now = _segment(shaft, now, shifted(motor, t), shifted(script, t), duration - t, series)
        t = time_after(t, dt, duration)
    return TwoMasses(math.nan, math.nan, math.nan, math.nan)
