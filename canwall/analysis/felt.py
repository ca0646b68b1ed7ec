"""Felt ripple: what the hand feels of a wall that should be at rest (docs/results.md).

It is the r.m.s. of the force between handle and hand in 20–500 Hz. With no operator, it is the
inertia of the handle times its acceleration.

The force enters as its mean over each period, which follows exactly from the momentum of the hand.
The mean has zeros at all multiples of 1/T. What a rate below 1 kHz cannot show, from 1/(2T) to
500 Hz, is folded into the band by sampling: for a force that is held over the period, the usual
case, nothing is lost, and the r.m.s. counts all of it. At 1 kHz the band is thus everything above
20 Hz, and a ripple just below 500 Hz is over-estimated (a held force, by up to π/2) or, if it is a
pure sine, under-estimated (by up to 2/π; 0.89 at 262 Hz). From 2 kHz on both are at most 11 %.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import compiled
from canwall.physics import HandBody

Array = NDArray[np.float64]

#: Band of the felt ripple [Hz].
FELT_BAND_HZ = (20.0, 500.0)
#: Largest felt ripple of a quiet wall, r.m.s. at the handle [N].
QUIET_N = 0.1
#: Radius of the handle where the configuration has none [m].
HANDLE_RADIUS_M = 0.08

_ORDER = 2


def handle_radius(given: float | None) -> float:
    """Return the radius of the handle [m]: HANDLE_RADIUS_M where the configuration gives none."""
    return given or HANDLE_RADIUS_M


class FeltBand(NamedTuple):
    """Band-pass filter in second-order sections, in the form that compiled code takes.

    Attributes:
        sections: Coefficients as from `scipy.signal.butter`, shape (n, 6).
        steady: State for a constant input of 1, as from `scipy.signal.sosfilt_zi`, shape (n, 2).
    """

    sections: Array
    steady: Array


def felt_band(period: float) -> FeltBand:
    """Design the filter for FELT_BAND_HZ, a Butterworth one of second order at each edge.

    Below 1/(2T) the band has no upper edge; at 40 Hz and below it is empty, and the filter lets
    nothing pass.

    Args:
        period: Sampling period T [s].
    """
    from scipy import signal  # slow to import: not for a run without a judgement

    low, high = FELT_BAND_HZ
    rate = 1.0 / period
    if low >= 0.5 * rate:
        return FeltBand(np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0]]), np.zeros((1, 2)))
    sections = signal.butter(_ORDER, low, "highpass", fs=rate, output="sos")
    if high < 0.5 * rate:
        upper = signal.butter(_ORDER, high, "lowpass", fs=rate, output="sos")
        sections = np.concatenate([sections, upper])
    return FeltBand(np.ascontiguousarray(sections), signal.sosfilt_zi(sections))


@compiled
def filtered(sections: Array, state: Array, value: float) -> float:
    """Pass a value through second-order sections (direct form II, transposed).

    Args:
        sections: Coefficients, shape (n, 6), as from `scipy.signal.butter`.
        state: State, shape (n, 2); changed.
        value: Input.
    """
    for k in range(len(sections)):
        passed = sections[k, 0] * value + state[k, 0]
        state[k, 0] = sections[k, 1] * value - sections[k, 4] * passed + state[k, 1]
        state[k, 1] = sections[k, 2] * value - sections[k, 5] * passed
        value = passed
    return value


@compiled
def band_rms(band: FeltBand, force: Array, start: int, stop: int) -> float:
    """Return the r.m.s. of a force in the band over [start, stop), NaN if that is empty.

    The filter runs from the first value on, from the steady state for it.
    """
    if stop <= start:
        return np.nan
    state = band.steady * force[0]
    power = 0.0
    for j in range(stop):
        value = filtered(band.sections, state, force[j])
        if j >= start:
            power += value * value
    return np.sqrt(power / (stop - start))


def felt_body(hand: HandBody, inertia: float) -> HandBody:
    """Return the body on which the felt force acts: the hand, or without one the handle.

    Args:
        hand: The hand; without any impedance there is no operator.
        inertia: Inertia of drive and handle [kg·m²].
    """
    if hand.mass == 0.0 and hand.viscous == 0.0 and hand.spring == 0.0:
        return hand._replace(mass=inertia)
    return hand


@compiled
def mean_hand_force(
    body: HandBody, y: float, v: float, y_next: float, v_next: float, push: float, period: float
) -> float:
    """Return the mean force on a hand over one period, from its motion [N·m].

    m·Δv/T + b·Δy/T + k·(mean of y) − push, with the mean of y by the corrected trapezoidal rule.

    Args:
        body: The hand.
        y: Position at the start of the period.
        v: Velocity at the start.
        y_next: Position at the end.
        v_next: Velocity at the end.
        push: Mean of its own force over the period.
        period: Length of the period [s].
    """
    mean_y = 0.5 * (y + y_next) - period * (v_next - v) / 12.0
    rate = body.mass * (v_next - v) + body.viscous * (y_next - y)
    return rate / period + body.spring * mean_y - push
