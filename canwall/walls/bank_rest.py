"""Rest in a bank's filters: a handle that sticks, what its samples bound, and when it breaks loose.

Stiction is in no model: equal samples show it.
"""

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled

#: Times after a motion for which filters are as quick as they may be, if their noise is felt and if
#: not [s]: noise is felt at rest alone, and a filter that is slow to find the push after a blow
#: makes a heavy hand bounce. After the latter time the handle is calm.
_LIVELY_S, _CALM_S = 0.05, 0.2
#: Times for which samples are equal of a handle that sticks, within which it breaks loose, and for
#: which it settles after that and after it moved [s]; way by which it breaks loose [counts].
_STICKS_S, _BREAKS_LOOSE_S, _SETTLES_S, _LOOSE = 0.016, 0.008, 0.3, 1.5
#: Time for which samples are equal before the torque may be held [s].
_HOLDS_S = 0.024
#: Change of a torque in a period up to which it may be held, over that by a count, and distance
#: from the wall's torque up to which it goes on being held [counts].
_STEADY_TORQUE, _HELD_COUNTS = 0.1, 2.0


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
def bound_velocity(bank: Record) -> None:
    """Let no filter move faster than equal samples allow: by a count each way meanwhile.

    Stiction is in no model: a filter would have a handle that sticks creep under the wall's force,
    until its bias force has followed, and the wall would push until it breaks loose. Its state is
    projected onto the bound with its covariance (Simon, IET Control Theory Appl. 4, 2010).
    """
    if bank.equal == 0:
        return
    regression, state, also = bank.regression[0], bank.state, bank.with_velocity
    fastest = 2.0 * regression.resolution / (bank.equal * regression.period)
    for i in range(bank.count):
        if bank.equal < bank.equal_samples[i]:
            continue
        excess = min(max(state[1, i], -fastest), fastest) - state[1, i]
        state[0, i] += also[0, i] * excess
        state[1, i] += excess
        state[2, i] += also[1, i] * excess


@compiled
def hold_torque(bank: Record, estimator: Record, y_sample: float) -> None:
    """Hold the torque of a handle that sticks, once it is that of the wall within a count.

    All filters rest where the wall gives it. Else they would go on creeping, and the torque with
    them until the handle breaks loose: it would hunt.
    """
    f, before = estimator.in_flight[0], estimator.in_flight[1]
    stiffness, surface = bank.stiffness, bank.surface
    count_torque = stiffness * bank.regression[0].resolution
    # In every cycle, since the wall may have become another one, or have moved.
    within = count_torque if bank.held == 0.0 else _HELD_COUNTS * count_torque
    of_wall = f != 0.0 and abs(f + stiffness * (y_sample - surface)) <= within
    if bank.equal < bank.holds_from or not of_wall:
        bank.held = 0.0
        return
    slack = _STEADY_TORQUE * count_torque
    if bank.held == 0.0 or abs(f - bank.held) > slack:
        bank.held = f if abs(f - before) <= slack else 0.0
    if bank.held == 0.0:
        return
    rest = surface - bank.held / stiffness
    push = bank.spring * rest - bank.held
    for i in range(bank.count):
        bank.state[0, i], bank.state[1, i] = rest, 0.0
        bank.state[2, i], bank.trend[i] = push, 0.0
