"""Gains in force of a bank's filters: by stiffness, delay and motion, out of those made beforehand.

A filter is as quick as it may be while the handle moves, and shortly after; at rest the stiffness
of the wall decides.
"""

import math

from canwall.compiled import Record, compiled
from canwall.walls.bank_gains import PACES, QUICKER, SHORTEST_DELAY

#: Least speed of a handle that moves [rad/s].
_MOVES = 0.28
#: Paces by which filters are quicker while the handle settles: a filter at rest lets a heavy handle
#: slip by several counts before the wall stops it.
_SETTLING_PACES = 2
#: Most equal samples from which on a velocity is bounded by them: a filter that is slower than that
#: finds rest by itself.
_EQUAL_SAMPLES = 32.0
#: Relative change of the bandwidth that is worth other gains.
_WORTH = 0.015


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
