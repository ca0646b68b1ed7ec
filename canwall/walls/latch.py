"""The position at the SYNC, of a drive that latches it at ticks of its own.

A drive whose control cycle T_c runs on its own crystal answers a SYNC with the position of its last
tick, up to T_c ago. Where the SYNC's period is no multiple of T_c, that age changes from sample to
sample: at 1 rad/s by 0.2 mrad for T_c = 0.4 ms, four counts of a 17-bit encoder, which a filter
takes for motion. A torque waits for a tick as well: where a position was old, the torque of the
SYNC before acts as much earlier. The pattern is known, a sawtooth at T/T_c; its phase is not, and
follows from a handle that moves: phases are weighed by how well each explains the samples. The age
is their weighted mean; while nothing is known it is the sawtooth's mean, which is part of the
delay.
"""

import math

import numpy as np

from canwall.compiled import Record, compiled
from canwall.walls.estimator import MAX_DELAY, unit_motion

#: Phases of the ticks that are weighed.
PHASES = 16

#: Ticks of a drive against the SYNC.
LATCH = np.dtype(
    [
        ("turn", "f8"),  # of the ticks against the SYNC in a period [ticks]; 0: always alike
        ("tick", "f8"),  # T_c [periods]
        ("period", "f8"),
        ("resolution", "f8"),  # one count [rad]
        ("received", "i8"),  # samples in a row, up to those of a second difference
        ("j", "i8"),  # cycle of the last one
        ("samples", "f8", (2,)),  # the last ones, newest first [rad]
        ("ways", "f8", (2,)),  # of a period, at these samples [counts]
        # For a unit mass under the torques, the part of its next second difference that the last
        # period made, and the second difference; what torques that act a period later change: of
        # the former, and of the latter those of the last period and those of the one before.
        ("begun", "f8"),
        ("bend", "f8"),
        ("later_begun", "f8"),
        ("later", "f8", (2,)),
        # Of each phase: what ages change in the second difference, what is left of it all the
        # time, which no age makes [counts], and the weight; the weights' sum is 1.
        ("expected", "f8", (PHASES,)),
        ("steady", "f8", (PHASES,)),
        ("weight", "f8", (PHASES,)),
    ],
    align=True,
)

#: Part of a turn from one SYNC to the next below which the age counts as constant.
_LEAST_TURN = 0.02
#: Share of what is known that is lost with a sample that tells of the phase, and with one that does
#: not: crystals drift.
_LOST, _LOST_AT_REST = 0.005, 0.001
#: Samples of a second difference.
_SAMPLES = 3
#: What phases differ by in a second difference for the sample to tell of them [counts], beyond a
#: multiple of T_c/T of what torques make of it, and of what torques a period later would change in
#: it: at rest they answer the steps of the encoder, which would look like an age.
_TELLING, _OF_TORQUES = 1.0, 0.75
#: Share of what is left of a second difference that counts as left all the time: d̂ is behind of the
#: operator's push.
_FOLLOWED = 0.6
#: Variance of a second difference, but for that by the doubt about the mass [counts²].
_VARIANCE = 1.0
#: Way in a period below which a sample is as good at any age [counts].
_LEAST_WAY = 2.0


def set_latch(latch: np.void, period: float, drive_cycle: float, count: float) -> None:
    """Write the settings.

    Args:
        latch: A record LATCH.
        period: T [s].
        drive_cycle: T_c [s]; 0: not known.
        count: One count of the encoder [rad].
    """
    turn = math.remainder(period / drive_cycle, 1.0) if drive_cycle else 0.0
    latch["turn"] = turn if abs(turn) >= _LEAST_TURN else 0.0
    latch["tick"] = drive_cycle / period
    latch["period"], latch["resolution"] = period, count


def reset_latch(latch: np.void) -> None:
    """Begin with nothing known of the ticks."""
    for name in ("received", "samples", "ways", "begun", "bend", "later_begun", "later", "steady"):
        latch[name] = 0
    latch["weight"] = 1.0 / PHASES


@compiled
def at_sync(latch: Record, estimator: Record, spread: float, j: int, y_sample: float) -> float:
    """Return the position at the SYNC of cycle j, less the mean age, for a sample [rad].

    estimator: before its correction with the sample. spread: standard deviation of ln(mass) in its
    model; 0: not known.
    """
    if latch.turn == 0.0:
        return y_sample
    way = estimator.v * latch.period
    _learn(latch, estimator, spread, j, y_sample, way)
    if abs(way) < _LEAST_WAY * latch.resolution:
        return y_sample
    return y_sample + way * age_at(latch, j)


@compiled
def age_at(latch: Record, j: int) -> float:
    """Return the age of the sample of cycle j beyond the mean [periods]."""
    if latch.turn == 0.0:
        return 0.0
    age = 0.0
    for k in range(PHASES):
        age += latch.weight[k] * _age(latch, k, j)
    return age


@compiled
def _age(latch: Record, k: int, j: int) -> float:
    """Return the age of the sample of cycle j beyond the mean for phase k: a sawtooth [periods]."""
    ticks = (k + 0.5) / PHASES + latch.turn * j
    return (ticks - math.floor(ticks) - 0.5) * latch.tick


@compiled
def expect_torques(latch: Record, estimator: Record, delay: float, force: float) -> None:
    """Note what the torques of the coming period do; call before `predict` of the estimator.

    force: as in `predict`. delay: D [periods].
    """
    if latch.turn == 0.0:
        return
    delay = min(max(delay, 0.0), float(MAX_DELAY))
    t = latch.period
    way, speed, later_way, later_speed = unit_motion(estimator.in_flight, force, delay, t)
    latch.bend = latch.begun + way
    latch.begun = t * speed - way
    latch.later[0], latch.later[1] = later_way, latch.later_begun
    latch.later_begun = t * later_speed - later_way


@compiled
def _learn(
    latch: Record, estimator: Record, spread: float, j: int, y_sample: float, way: float
) -> None:
    """Weigh the phases by the second difference of the samples, less what forces explain of it."""
    samples, ways, t, count = latch.samples, latch.ways, latch.period, latch.resolution
    latch.received = min(latch.received + 1, _SAMPLES) if j == latch.j + 1 else 1
    latch.j = j
    way /= count
    if latch.received == _SAMPLES:
        unit = 1.0 / (estimator.mass * count)  # from a unit mass to the handle, in counts
        bend = latch.bend * unit
        late = (2.0 * samples[0] - y_sample - samples[1]) / count + bend
        late += t * t * estimator.d * unit
        # What an age at this sample, the one before and the one before that changes.
        before = latch.later[0] * unit - 2.0 * ways[0]
        earlier = latch.later[1] * unit + ways[1]
        least, most = math.inf, -math.inf
        for k in range(PHASES):
            expected = way * _age(latch, k, j) + before * _age(latch, k, j - 1)
            expected += earlier * _age(latch, k, j - 2)
            latch.expected[k] = expected
            least, most = min(least, expected), max(most, expected)
        torques = abs(bend) + (abs(latch.later[0]) + abs(latch.later[1])) * unit
        tells = most - least >= _TELLING + _OF_TORQUES * latch.tick * torques
        doubt = bend * (spread if spread > 0.0 else 1.0)
        _weigh(latch, late, _VARIANCE + doubt * doubt, tells)
    samples[1], samples[0] = samples[0], y_sample
    ways[1], ways[0] = ways[0], way


@compiled
def _weigh(latch: Record, late: float, variance: float, tells: bool) -> None:
    """Weigh the phases by what they leave of a second difference; follow what is always left.

    The likelihood is Cauchy's: forces and ways are known from a model that may be wrong.
    """
    lost = _LOST if tells else _LOST_AT_REST
    total = 0.0
    for k in range(PHASES):
        left = late - latch.expected[k] - latch.steady[k]
        latch.steady[k] += _FOLLOWED * left
        if tells:
            latch.weight[k] /= 1.0 + left * left / variance
        total += latch.weight[k]
    for k in range(PHASES):
        weight = latch.weight[k] / total
        latch.weight[k] = weight + lost * (1.0 / PHASES - weight)
