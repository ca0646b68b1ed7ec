"""Trend of the push in a bank's filters: how fast it changes, in flight and in contact.

A light hand's filter would be behind a push that grows, and the wall give way. In flight the trend
is estimated, in a blow it is forgotten, and a hand that begins to press shows it again.
"""

import math

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.walls.probe import other_torque_acts
from canwall.walls.regression import HAND_RATE, moves

#: Time without torque but a probe's after which a handle that moves flies, and time constant with
#: which the trend of the push is forgotten in contact [s]: what a blow and the push after it do to
#: an estimate is no trend.
_FLIGHT_S, _TREND_S = 0.04, 0.0028
#: That time constant under the wall's torque [s] if the handle came with no more than this speed
#: [rad/s], since its blow is small and its push goes on growing, and if K·T²/m of the lightest hand
#: is no less than this: a softer wall is as deep as it should be anyway, and a trend that is kept
#: makes its handle swing.
_TREND_PRESSED_S, _SLOW_COMING, _STIFF = 0.007, 2.8, 0.6
#: Time after a flight in which a hand begins to press [s], the sample under the wall's torque from
#: which on it does, and the largest speed at which one tells how its push changes [rad/s]. Earlier
#: and faster it is a blow, whose errors are those of delay and mass; later, with friction, the
#: trend would make the handle hunt.
_LANDING_S, _PRESSED, _SLOW = 0.04, 4, 0.38


def set_trend(bank: NDArray[np.void], lightest: float, period: float) -> None:
    """Write what the trend needs into a BANK array (1,), but for the gains.

    Args:
        bank: The bank.
        lightest: Mass of the first filter.
        period: T [s].
    """
    bank["flight"] = round(_FLIGHT_S / period)
    bank["trend_left_pressed"] = math.exp(-period / _TREND_PRESSED_S)
    bank["trend_left"] = math.exp(-period / _TREND_S)
    bank["stiff_from"] = _STIFF * lightest / period**2
    bank["landing"] = round(_LANDING_S / period)


def reset_trend(bank: NDArray[np.void]) -> None:
    """Begin without a trend, in no flight and no contact."""
    bank["trend"] = 0.0
    bank["alone"], bank["flies"], bank["came_slowly"], bank["stiff"] = 0, False, False, False
    bank["landed"], bank["pressed"], bank["presses"] = bank["landing"], 0, False


@compiled
def note_flight(bank: Record, estimator: Record, y_sample: float) -> None:
    """Note if the handle flies, or is pressed against the wall shortly after a flight.

    A flight is its way far from any contact, under no torque but a probe's.
    """
    probe, now = bank.probe[0], estimator.delay_periods
    bank.alone = 0 if other_torque_acts(probe, estimator.in_flight, now) else bank.alone + 1
    bank.flies = bank.alone > bank.flight and moves(bank.regression[0])
    bank.landed = 0 if bank.flies else bank.landed + 1
    if bank.landed <= 1:  # the first sample of the contact is still the flight's
        way = abs(y_sample - bank.sampled)
        bank.came_slowly = way <= _SLOW_COMING * bank.regression[0].period
    wall_acts = estimator.in_flight[now] != probe.in_flight[now]
    bank.pressed = bank.pressed + 1 if wall_acts else 0
    bank.presses = bank.landed <= bank.landing and bank.pressed >= _PRESSED


@compiled
def follows_trend(bank: Record, y_sample: float) -> bool:
    """Return True while a hand begins to press, slowly enough to tell how its push changes."""
    slow = _SLOW * bank.regression[0].period + bank.regression[0].resolution
    return bool(bank.presses and abs(y_sample - bank.sampled) <= slow)


@compiled
def correct_in_flight(bank: Record, i: int, residual: float) -> None:
    """Correct filter i, and how fast the push changes.

    A light handle is at the wall within a few samples, and what its filter is behind of a push that
    grows is then missing from the first blow.
    """
    state, gain = bank.state, bank.gain_in_flight
    for c in range(3):
        state[c, i] += gain[c, i] * residual
    follow_trend(bank, i, gain[3, i] * residual)


@compiled
def follow_trend(bank: Record, i: int, correction: float) -> None:
    """Correct how fast the push changes: no faster than that of a hand."""
    bank.trend[i] = min(max(bank.trend[i] + correction, -HAND_RATE), HAND_RATE)


@compiled
def trend_left(bank: Record) -> float:
    """Return the share of the trend that is left after a period."""
    if bank.flies or bank.presses:
        return 1.0
    goes_on = bank.stiff and bank.pressed > 0 and bank.came_slowly
    return bank.trend_left_pressed if goes_on else bank.trend_left
