"""The swing of a wall whose model is too light for the hand on it.

With a finger's mass in its model the wall of an arm swings at 12 to 40 Hz, from nothing, and more
and more. Until the swing is large, its torque changes no faster than that of a hand that pushes,
and a light hand that pushes just so would make the wall answer with the same motion. But no hand
pushes to and fro as fast: its own frequencies end below those of tremor (8 to 12 Hz). So a torque
that has gone to and fro faster than that is the wall's alone, and what it moves tells the mass.
"""

import math

import numpy as np

from canwall.compiled import Record, compiled

#: Sums over samples of what an observer did not expect, of the position r₀ [rad] and of the torque
#: on a unit mass r₁, and their number.
_SUMS = [("rr", "f8"), ("rt", "f8"), ("tt", "f8"), ("samples", "i8")]

#: A swing: the sums over its last two halves, as they are when it tells; the present half, in which
#: the torque changes in one direction, with the range of the positions, and the one before.
SWING = np.dtype(
    [
        ("shortest", "i8"),  # half of a swing [samples]
        ("longest", "i8"),
        ("least_way", "f8"),  # of a swing from end to end [rad]
        ("least_square", "f8"),  # of what nothing explains [rad²]
        ("both", _SUMS, (1,)),
        ("half", _SUMS, (1,)),
        ("before", _SUMS, (1,)),
        ("lowest", "f8"),
        ("highest", "f8"),
        ("direction", "f8"),  # in which the torque changes; 0: in none up to now
        ("rests", "i8"),  # samples in a row up to now in which the torque changes in none
        ("way", "f8"),  # of the handle in the half before, from end to end [rad]
        ("halves", "i8"),  # in a row that no hand makes
        ("last", "f8"),  # the last sample [rad]
        ("equal", "i8"),  # samples in a row up to now, and the most in the present half
        ("stuck", "i8"),
    ],
    align=True,
)

#: Duration of half a swing [s]: faster than a hand pushes to and fro, and no faster than what the
#: torque tells of a blow.
_SHORTEST_S, _LONGEST_S = 0.008, 0.038
#: Least way of a swing from end to end, between one count and two, and noise of what the observer
#: does not expect [counts].
_LEAST_WAY, _NOISE = 1.5, 0.5
#: Share of a half that may pass without a count: a handle that sticks and slips does not swing, and
#: looks heavy while it sticks.
_STUCK = 0.7
#: Most by which a half goes farther than the one before: in one that goes still farther a hand
#: withdraws, which looks heavy as the wall follows it.
_GROWTH = 4.0
#: Halves in a row that are no hand's.
_HALVES = 2


def set_swing(swing: np.void, period: float, count: float) -> None:
    """Write a swing's settings.

    Args:
        swing: A record SWING.
        period: T [s].
        count: One count of the encoder [rad].
    """
    swing["shortest"], swing["longest"] = round(_SHORTEST_S / period), round(_LONGEST_S / period)
    swing["least_way"], swing["least_square"] = _LEAST_WAY * count, (_NOISE * count) ** 2


@compiled
def end_swing(swing: Record) -> None:
    """Forget what has been seen of a swing."""
    swing.direction = 0.0
    swing.halves = swing.half[0].samples = 0


@compiled
def follow_swing(swing: Record, y: float, position: float, torque: float, turns_at: float) -> bool:
    """Add a sample; return True at the end of the second half in a row that no hand makes.

    Args:
        swing: The swing.
        y: The sample [rad].
        position: What the observer did not expect of the position [rad].
        torque: The same of the torque on a unit mass.
        turns_at: Size of that from which on the torque changes in its direction.
    """
    half, before = swing.half[0], swing.before[0]
    goes = abs(torque) >= turns_at
    swing.rests = 0 if goes else swing.rests + 1
    if swing.rests > swing.longest:
        end_swing(swing)
    if half.samples == 0:
        half.rr = half.rt = half.tt = 0.0
        swing.lowest = swing.highest = y
        swing.stuck = swing.equal = 0
    swing.equal = swing.equal + 1 if y == swing.last else 0
    swing.stuck, swing.last = max(swing.stuck, swing.equal), y
    half.rr += position * position
    half.rt += position * torque
    half.tt += torque * torque
    half.samples += 1
    swing.lowest, swing.highest = min(swing.lowest, y), max(swing.highest, y)
    if not goes or torque * swing.direction > 0.0:
        return False
    way = swing.highest - swing.lowest
    swings = swing.shortest <= half.samples <= swing.longest and way >= swing.least_way
    swings = swings and swing.stuck <= _STUCK * half.samples
    if swing.direction == 0.0:
        # What goes in a direction from the first sample on may have done so for any time before.
        swing.halves = -1 if half.samples == 1 else 0
    elif not swings:
        swing.halves = 0
    elif swing.halves > 0 and way > _GROWTH * swing.way:
        swing.halves = 1
    else:
        swing.halves += 1
    swing.way = way
    swing.direction = torque
    both = swing.both[0]
    both.rr, both.rt, both.tt = before.rr + half.rr, before.rt + half.rt, before.tt + half.tt
    both.samples = before.samples + half.samples
    before.rr, before.rt, before.tt, before.samples = half.rr, half.rt, half.tt, half.samples
    half.samples = 0
    return swing.halves >= _HALVES


@compiled
def lightness_of_swing(swing: Record) -> tuple[float, float, float]:
    """Return 1/m by the last two halves of a swing, its deviation, and the noise [rad²].

    That is the least squares of r₀ + r₁·(1/m): nothing else goes to and fro as fast.
    """
    both = swing.both[0]
    lightness = max(-both.rt / both.tt, 0.0)
    rest = both.rr + lightness * (2.0 * both.rt + lightness * both.tt)
    noise = max(rest / both.samples, swing.least_square)
    return lightness, math.sqrt(noise / both.tt), noise
