"""Gains in force of a bank's filters: by stiffness, delay and motion, out of those made beforehand.

A filter is as quick as it may be while the handle moves, and shortly after; at rest the stiffness
of the wall decides.
"""

import math

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.walls.bank_gains import PACES, QUICKER, SHORTEST_DELAY

#: Least speed of a handle that moves [rad/s], and the time after it for which filters are as quick
#: as they may be, if their noise is felt and if not [s]: noise is felt at rest alone, and a filter
#: that is slow to find the push after a blow makes a heavy hand bounce. After the latter time the
#: handle is calm.
_MOVES, _LIVELY_S, _CALM_S = 0.28, 0.05, 0.2
#: Times for which samples are equal of a handle that sticks, within which it breaks loose, and for
#: which it settles after that and after it moved [s]; way by which it breaks loose [counts]; and
#: paces by which filters are quicker while it settles: a filter at rest lets a heavy handle slip by
#: several counts before the wall stops it.
_STICKS_S, _BREAKS_LOOSE_S, _SETTLES_S = 0.016, 0.008, 0.3
_LOOSE, _SETTLING_PACES = 1.5, 2
#: Time for which samples are equal before the torque may be held [s].
_HOLDS_S = 0.024
#: Most equal samples from which on a velocity is bounded by them: a filter that is slower than that
#: finds rest by itself.
_EQUAL_SAMPLES = 32.0
#: Relative change of the bandwidth that is worth other gains.
_WORTH = 0.015


def set_rest(bank: NDArray[np.void], period: float) -> None:
    """Write into a BANK array (1,) what tells a handle that moves, sticks, settles or rests.

    Args:
        bank: The bank.
        period: T [s].
    """
    bank["lively"], bank["calm"] = round(_LIVELY_S / period), round(_CALM_S / period)
    bank["sticks"], bank["breaks_loose"] = (
        round(_STICKS_S / period),
        round(_BREAKS_LOOSE_S / period),
    )
    bank["settles"], bank["holds_from"] = round(_SETTLES_S / period), round(_HOLDS_S / period)


def reset_rest(bank: NDArray[np.void], y: float) -> None:
    """Begin with a handle that has been at rest at y for long."""
    bank["sampled"], bank["equal"], bank["held"] = y, 0, 0.0
    bank["stuck_at"], bank["since_stuck"] = y, bank["breaks_loose"] + 1
    bank["since_loose"], bank["moved"] = bank["settles"], bank["calm"]


@compiled
def note_rest(bank: Record, y_sample: float) -> None:
    """Note for how long samples have been equal, and when a handle that stuck breaks loose."""
    bank.equal = bank.equal + 1 if y_sample == bank.sampled else 0
    bank.sampled = y_sample
    bank.since_stuck = min(bank.since_stuck + 1, bank.breaks_loose + 1)
    if bank.equal >= bank.sticks:
        bank.stuck_at, bank.since_stuck = y_sample, 0
    way = abs(y_sample - bank.stuck_at)
    loose = way > _LOOSE * bank.regression[0].resolution and bank.since_stuck <= bank.breaks_loose
    bank.since_loose = 0 if loose or bank.moved == 0 else min(bank.since_loose + 1, bank.settles)


@compiled
def set_pace(bank: Record, stiffness: float, surface: float = 0.0) -> None:
    """Make the filters as quick as handle and stiffness want, and note the wall in force.

    To be called before `correct_bank`. surface: position of the wall's surface [rad].
    """
    regression = bank.regression[0]
    bank.surface = surface
    bank.stiffness, bank.stiff = stiffness, stiffness >= bank.stiff_from
    if abs(regression.way) >= _MOVES * regression.period:
        bank.moved = 0
    else:
        bank.moved = min(bank.moved + 1, bank.calm)
    resting = PACES - 1
    if stiffness > 0.0:
        resting = min(max(int(math.log2(bank.steadiest / stiffness)), 0), resting)
    if bank.since_loose < bank.settles:
        resting = min(resting + _SETTLING_PACES, PACES)
    felt = PACES if is_lively(bank) else resting
    light = PACES if bank.moved < bank.calm else resting
    quicker = bank.quicker
    if bank.delay_in_force >= 0.0:
        quicker = max(bank.delay, SHORTEST_DELAY) / max(bank.delay_in_force, SHORTEST_DELAY)
        quicker = min(max(quicker, QUICKER[0]), QUICKER[2])
    same = felt == bank.pace and light == bank.light_pace
    if same and abs(quicker - bank.quicker) < _WORTH:
        return
    bank.pace, bank.light_pace, bank.quicker = felt, light, quicker
    for i in range(bank.count):
        pace = felt if bank.far_share[i] > 0.0 else light
        for c in range(3):
            own, quickest = _paced(bank, pace, c, i), _paced(bank, PACES, c, i)
            bank.gain[c, i] = own
            bank.far_gain[c, i] = own + bank.far_share[i] * (quickest - own)
        bank.with_velocity[0, i] = _paced(bank, pace, 3, i)
        bank.with_velocity[1, i] = _paced(bank, pace, 4, i)
        equal_samples = _paced(bank, pace, 5, i)
        bank.equal_samples[i] = equal_samples if equal_samples <= _EQUAL_SAMPLES else math.inf


@compiled
def is_lively(bank: Record) -> bool:
    """Return True while even filters whose noise is felt are as quick as they may be."""
    return bank.moved < bank.lively


@compiled
def _paced(bank: Record, pace: int, quantity: int, i: int) -> float:
    """Return a quantity of filter i at a pace, for the relative bandwidth in force."""
    c, x = bank.paces, bank.quicker
    return c[0, pace, quantity, i] + x * (c[1, pace, quantity, i] + x * c[2, pace, quantity, i])
