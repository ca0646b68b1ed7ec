"""The guard: it observes a wall in the cycle, and softens one that buzzes in spite of its law.

Two signs, of the position and of the force in force alone, so that neither model nor operator need
be known:

- **Ripple that does not decay.** The force within 20 to 500 Hz (docs/results.md) has swung by more
  than RIPPLE_NM: a dozen times within 100 ms of which no 20 ms were much quieter than the others,
  or eight times, as the slowest of the band does, within 200 ms without falling to half. A bounce
  dies away. While the force is lowered, half as often is enough, within 40 or 100 ms.
- **A contact that gives off more than it took.** The wall has put out more energy than the operator
  put in, and the handle leaves faster than it came. Either alone is no sign: a hand that withdraws
  leaves faster, and on a soft wall friction takes what sampling adds. While the force is lowered,
  leaving nearly as fast is enough: the wall has gone on feeding the handle.

An alarm lowers a factor on the law's force, which for a spring and damper is one on K and B
together, at once. After HOLD_S without a further one the factor rises again, by e within RISE_S.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from canwall.analysis.felt import FELT_BAND_HZ, filtered
from canwall.compiled import Record, compiled

#: Values of `[guard] action`.
GUARD_ACTIONS = {"off": 0, "warn": 1, "act": 2}
_OFF, _ACT = GUARD_ACTIONS["off"], GUARD_ACTIONS["act"]

#: Ripple below this is left alone: 0.6 N at a handle of 80 mm [N·m].
RIPPLE_NM = 0.05
#: Length of a block [s].
BLOCK_S = 0.02
#: A ripple that lasts for this many blocks, with this of the loudest one's r.m.s. in each ...
STEADY_BLOCKS, STEADY = 5, 0.6
#: ... or for this many, with this of the largest peak in each; swings in all of them.
LASTING_BLOCKS, LASTING = 10, 0.5
STEADY_SWINGS, LASTING_SWINGS = 12, 8
#: Energy given off in a contact beyond that taken in, over the latter; speed out over speed in, and
#: as long as the force is lowered.
GAIN, FASTER, AGAIN = 0.2, 1.1, 0.8
#: Longest contact whose speeds on entry and leaving have to do with each other [s], and least way
#: within the span before one that counts [counts].
BOUNCE_S, _LEAST_WAY = 0.1, 8.0
#: Uncertainty of the energy [counts times peak force], and of the way over the span [counts].
_ENERGY_COUNTS, _WAY_COUNTS = 4.0, 2.0
#: Cycles over which the speeds of a contact are measured.
_SPAN = 4

#: What is left of the force after an alarm of either sign, and the least that is left [1].
AFTER_RIPPLE, AFTER_CONTACT, LEAST = 0.3, 0.1, 0.01
#: Time without an alarm until the force returns, and time in which it rises by e [s].
HOLD_S, RISE_S = 1.0, 2.0

GUARD = np.dtype(
    [
        ("action", "i8"),
        ("factor", "f8"),
        ("alarms", "i8"),
        ("first_alarm", "i8"),
        ("lowest", "f8"),
        # Settings per cycle.
        ("count", "f8"),
        ("rise", "f8"),
        ("hold", "i8"),
        ("longest", "i8"),
        ("held", "i8"),  # cycles since the last alarm
        # The band-pass as two second-order sections, and their states.
        ("sections", "f8", (2, 6)),
        ("states", "f8", (2, 2)),
        # The present block and the last ones, newest first: peak, r.m.s. times √2, swings.
        ("block", "i8"),
        ("filled", "i8"),  # cycles since the start or the last alarm
        ("side", "f8"),
        ("peak", "f8"),
        ("squares", "f8"),
        ("swung", "f8"),
        ("peaks", "f8", (LASTING_BLOCKS,)),
        ("amplitudes", "f8", (LASTING_BLOCKS,)),
        ("swings", "f8", (LASTING_BLOCKS,)),
        # Positions of the last cycles, newest first.
        ("way", "f8", (_SPAN + 1,)),
        # The present contact, or the last one until its speed on leaving is known.
        ("inside", "?"),
        ("lasted", "i8"),
        ("outside", "i8"),
        ("work", "f8"),  # put out so far
        ("taken", "f8"),
        ("largest", "f8"),
        ("way_in", "f8"),
    ],
    align=True,
)


#: What it has observed of the motion and the force.
_OBSERVED = (
    *("states", "filled", "side", "peak", "squares", "swung", "peaks", "amplitudes", "swings"),
    *("inside", "lasted", "work", "taken", "largest", "way_in"),
)


def set_guard(guard: NDArray[np.void], action: str, period: float, count: float) -> None:
    """Write a guard for this period of the SYNC [s] and encoder count [rad]; no alarm yet.

    Raises KeyError for an action that does not exist.
    """
    guard["action"] = GUARD_ACTIONS[action]
    guard["factor"] = guard["lowest"] = 1.0
    guard["first_alarm"] = -1
    guard["count"] = count
    guard["block"] = max(1, round(BLOCK_S / period))
    guard["hold"] = round(HOLD_S / period)
    guard["longest"] = round(BOUNCE_S / period)
    guard["rise"] = math.exp(period / RISE_S)
    guard["sections"] = band_pass(period)


def change_guard(guard: np.void, action: str, position: float) -> None:
    """Change the action between two cycles; what was observed before it was off is forgotten.

    A force that has been lowered rises as it does without an alarm, also where the guard is off.

    Args:
        guard: Record of dtype GUARD.
        action: `[guard] action`.
        position: Position of the handle, oriented towards the wall [rad].
    """
    if guard["action"] == _OFF:
        for name in _OBSERVED:
            guard[name] = 0
        guard["way"], guard["outside"] = position, _SPAN + 1
    guard["action"] = GUARD_ACTIONS[action]


def band_pass(period: float) -> NDArray[np.float64]:
    """Return two second-order sections for the band, or what of it a sampled force can have.

    At 40 Hz and below that is nothing, and nothing passes: fed contacts are left to be seen.

    The filters are Butterworth ones of second order by the bilinear transform, as those of
    scipy.signal.butter, which takes too long to load for a run in progress.
    """
    low, high = FELT_BAND_HZ
    sections = np.zeros((2, 6))
    sections[:, 3] = 1.0
    if low * period >= 0.5:
        return sections
    rate = 2.0 / period
    below, above = (rate * math.tan(math.pi * edge * period) for edge in (low, high))
    if high * period >= 0.45:
        sections[0] = _sampled([1.0, 0.0, 0.0], [1.0, math.sqrt(2.0) * below, below**2], rate)
        sections[1, 0] = 1.0
        return sections
    # s → (s² + ω₁·ω₂) / (s·(ω₂ − ω₁)) makes the low-pass a band-pass: each of its poles becomes
    # two, and those of its conjugate are their conjugates.
    width, pole = above - below, complex(-math.sqrt(0.5), math.sqrt(0.5))
    for section, root in zip(
        sections, np.roots([1.0, -pole * width, below * above]).tolist(), strict=True
    ):
        section[:] = _sampled([0.0, width, 0.0], [1.0, -2.0 * root.real, abs(root) ** 2], rate)
    return sections


def _sampled(above: Sequence[float], below: Sequence[float], rate: float) -> NDArray[np.float64]:
    """Return a second-order section for a fraction of polynomials in s, by s = rate·(z−1)/(z+1)."""
    of_z = np.array([[rate**2, rate, 1.0], [-2.0 * rate**2, 0.0, 2.0], [rate**2, -rate, 1.0]])
    section = np.concatenate([of_z @ above, of_z @ below])
    return np.asarray(section / section[3])


@compiled
def watch(
    guard: Record, j: int, position: float, surface: float, force: float, rendering: bool
) -> None:
    """Observe one cycle, and set the factor.

    Args:
        guard: Record of dtype GUARD.
        j: The cycle.
        position: Position at its SYNC, oriented towards the wall [rad].
        surface: That of the wall [rad].
        force: Force from the SYNC before up to this one, out of the wall [N·m].
        rendering: False before and after the wall, and without a sample: nothing is observed.
    """
    if not rendering:
        return
    if guard.action == _OFF:
        guard.factor = min(1.0, guard.factor * guard.rise)
        return
    left = 1.0
    if _ripples(guard, force):
        left = AFTER_RIPPLE
    if _feeds(guard, position, surface, force):
        left = AFTER_CONTACT
    if left == 1.0:
        guard.held += 1
        if guard.factor < 1.0 and guard.held > guard.hold:
            guard.factor = min(1.0, guard.factor * guard.rise)
        return
    if guard.alarms == 0:
        guard.first_alarm = j
    guard.alarms += 1
    guard.held = 0
    # The next block begins here, with the force as it is from now on.
    guard.filled = 0
    guard.peak = guard.squares = guard.swung = 0.0
    if guard.action == _ACT:
        guard.factor = max(LEAST, left * guard.factor)
        guard.lowest = min(guard.lowest, guard.factor)


@compiled
def _ripples(guard: Record, force: float) -> bool:
    """Return True at the end of a block with which the force has rippled for long enough."""
    ripple = filtered(guard.sections, guard.states, force)
    guard.peak = max(guard.peak, abs(ripple))
    guard.squares += ripple * ripple
    if ripple * guard.side <= 0.0 and abs(ripple) > 0.5 * RIPPLE_NM:
        guard.side = ripple
        guard.swung += 1.0
    guard.filled += 1
    if guard.filled % guard.block:
        return False
    _push(guard.peaks, guard.peak)
    _push(guard.amplitudes, math.sqrt(2.0 * guard.squares / guard.block))
    _push(guard.swings, guard.swung)
    guard.peak = guard.squares = guard.swung = 0.0
    # A wall that has been softened and buzzes on is not given as long again.
    sooner = 2 if guard.factor < 1.0 else 1
    steady, lasting = STEADY_BLOCKS // sooner, LASTING_BLOCKS // sooner
    often, seldom = STEADY_SWINGS // sooner, LASTING_SWINGS // sooner
    blocks = guard.filled // guard.block
    return (blocks >= steady and _lasts(guard, guard.amplitudes, steady, STEADY, often)) or (
        blocks >= lasting and _lasts(guard, guard.peaks, lasting, LASTING, seldom)
    )


@compiled
def _push(newest_first: NDArray[np.float64], value: float) -> None:
    for k in range(len(newest_first) - 1, 0, -1):
        newest_first[k] = newest_first[k - 1]
    newest_first[0] = value


@compiled
def _lasts(
    guard: Record, levels: NDArray[np.float64], blocks: int, share: float, least_swings: int
) -> bool:
    """Return whether no block of the last ones is quiet, or much quieter than the loudest."""
    least = largest = levels[0]
    swings = 0.0
    for k in range(blocks):
        least, largest = min(least, levels[k]), max(largest, levels[k])
        swings += guard.swings[k]
    return least >= max(RIPPLE_NM, share * largest) and swings >= least_swings


@compiled
def _feeds(guard: Record, position: float, surface: float, force: float) -> bool:
    """Return True where a contact that is over has fed the handle."""
    way = guard.way
    moved = position - way[0]
    for k in range(_SPAN, 0, -1):
        way[k] = way[k - 1]
    way[0] = position
    if guard.inside:
        guard.lasted += 1
        guard.work += force * moved
        guard.taken = max(guard.taken, -guard.work)
        guard.largest = max(guard.largest, abs(force))
        if position > surface + guard.count:
            guard.inside = False
            guard.outside = 0
        return False
    if position < surface:
        guard.inside = True
        guard.lasted = 0
        guard.work = force * moved
        guard.taken = guard.largest = 0.0
        guard.way_in = way[_SPAN] - position
        return False
    # The force of the last sample inside may act for some cycles more.
    guard.work += force * moved
    guard.outside += 1
    counts = guard.way_in > _LEAST_WAY * guard.count and guard.lasted < guard.longest
    if guard.outside != _SPAN or not counts:
        return False
    tolerance = _ENERGY_COUNTS * guard.count * guard.largest
    ratio = FASTER if guard.factor == 1.0 else AGAIN
    faster = position - way[_SPAN] > ratio * guard.way_in + _WAY_COUNTS * guard.count
    return faster and guard.work > GAIN * guard.taken + tolerance
