"""The position at the SYNC, of a drive that latches it at ticks of its own.

A drive whose control cycle T_c runs on its own crystal answers a SYNC with the position of its last
tick, up to T_c ago. Where the SYNC's period is no multiple of T_c, that age changes from sample to
sample: at 1 rad/s by 0.2 mrad for T_c = 0.4 ms, eight counts of a 17-bit encoder, which a filter
takes for motion. A torque waits for a tick as well: where a position was old, the torque of the
SYNC before acts as much earlier. The pattern is known, a sawtooth at T/T_c, and its phase follows
from a handle that moves. Of the sawtooth the first harmonic is taken; its mean age is part of the
delay.
"""

import math

import numpy as np

from canwall.compiled import Record, compiled
from canwall.walls.estimator import MAX_DELAY, unit_motion

#: Ticks of a drive against the SYNC.
LATCH = np.dtype(
    [
        ("turn", "f8"),  # of the ticks against the SYNC in a period [rad]; 0: always alike
        ("period", "f8"),
        ("resolution", "f8"),  # one count [rad]
        ("prior", "f8"),
        ("received", "i8"),  # samples in a row, up to those of a second difference
        ("j", "i8"),  # cycle of the last one
        ("samples", "f8", (2,)),  # the last ones, newest first [rad]
        # The way of a period [counts] times cosine and sine of the ticks, at these samples.
        ("turned", "f8", (2, 2)),
        # For a unit mass under the torques, the part of its next second difference that the last
        # period made, and the second difference; how later torques change both, times cosine and
        # sine of the ticks.
        ("begun", "f8"),
        ("bend", "f8"),
        ("later_begun", "f8", (2,)),
        ("later", "f8", (2,)),
        # Of least squares for the ages' cosine and sine: products of what both change, (0, 0),
        # (0, 1), (1, 1), and their products with what the samples were late.
        ("information", "f8", (3,)),
        ("told", "f8", (2,)),
        ("age", "f8", (2,)),  # cosine and sine of the age beyond its mean [periods]
    ],
    align=True,
)

#: Part of a turn from one SYNC to the next below which the age counts as constant.
_LEAST_TURN = 0.02
#: Share of what is known that is left after a sample that tells of the age, and after one that does
#: not: crystals drift, and the sawtooth jumps.
_MEMORY, _MEMORY_AT_REST = 0.97, 0.995
#: Samples of a second difference.
_SAMPLES = 3
#: What an age of a period would change in a second difference for the sample to tell of it, beyond
#: a multiple of what torques do: at rest they answer the steps of the encoder, which would look
#: like an age. [counts]
_TELLING, _OF_TORQUES = 4.0, 1.5
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
    latch["turn"] = 2.0 * math.pi * turn if abs(turn) >= _LEAST_TURN else 0.0
    latch["period"], latch["resolution"] = period, abs(count)
    # A count of noise, and an age evenly distributed over the cycle.
    latch["prior"] = 12.0 * (period / drive_cycle) ** 2 if drive_cycle else 0.0


def reset_latch(latch: np.void) -> None:
    """Begin with nothing known of the ticks."""
    for name in ("received", "samples", "turned", "information", "told", "age"):
        latch[name] = 0
    for name in ("begun", "bend", "later_begun", "later"):
        latch[name] = 0.0


@compiled
def at_sync(latch: Record, estimator: Record, spread: float, j: int, y_sample: float) -> float:
    """Return the position at the SYNC of cycle j, less the mean age, for a sample [rad].

    estimator: before its correction with the sample. spread: standard deviation of ln(mass) in its
    model; 0: not known.
    """
    if latch.turn == 0.0:
        return y_sample
    way = estimator.v * latch.period
    _learn(latch, estimator.mass, spread, j, y_sample, way)
    if abs(way) < _LEAST_WAY * latch.resolution:
        return y_sample
    return y_sample + way * age_at(latch, j)


@compiled
def age_at(latch: Record, j: int) -> float:
    """Return the age of the sample of cycle j beyond the mean [periods]."""
    if latch.turn == 0.0:
        return 0.0
    angle = latch.turn * j
    return latch.age[0] * math.cos(angle) + latch.age[1] * math.sin(angle)


@compiled
def expect_torques(latch: Record, estimator: Record, delay: float, j: int, force: float) -> None:
    """Note what the torques of the coming period do; call before `predict` of the estimator.

    force: as in `predict`. delay: D [periods].
    """
    if latch.turn == 0.0:
        return
    delay = min(max(delay, 0.0), float(MAX_DELAY))
    t = latch.period
    way, speed, later_way, later_speed = unit_motion(estimator.in_flight, force, delay, t)
    angle = latch.turn * j
    cosine, sine = math.cos(angle), math.sin(angle)
    latch.bend = latch.begun + way
    latch.begun = t * speed - way
    begun = t * later_speed - later_way
    latch.later[0] = latch.later_begun[0] + later_way * cosine
    latch.later[1] = latch.later_begun[1] + later_way * sine
    latch.later_begun[0], latch.later_begun[1] = begun * cosine, begun * sine


@compiled
def _learn(latch: Record, mass: float, spread: float, j: int, y_sample: float, way: float) -> None:
    """Learn from the second difference of the samples, less what torques explain of it."""
    samples, turned, count = latch.samples, latch.turned, latch.resolution
    latch.received = min(latch.received + 1, _SAMPLES) if j == latch.j + 1 else 1
    latch.j = j
    angle = latch.turn * j
    c, s = way * math.cos(angle) / count, way * math.sin(angle) / count
    if latch.received == _SAMPLES:
        bend = latch.bend / (mass * count)
        late = (2.0 * samples[0] - y_sample - samples[1]) / count + bend
        u = c - 2.0 * turned[0, 0] + turned[1, 0] + latch.later[0] / (mass * count)
        v = s - 2.0 * turned[0, 1] + turned[1, 1] + latch.later[1] / (mass * count)
        torques = abs(bend) + (abs(latch.later[0]) + abs(latch.later[1])) / (mass * count)
        if math.hypot(u, v) >= _TELLING + _OF_TORQUES * torques:
            doubt = bend * (spread if spread > 0.0 else 1.0)
            _add_information(latch, _MEMORY, 1.0 / (1.0 + doubt * doubt), u, v, late)
        else:
            _add_information(latch, _MEMORY_AT_REST, 0.0, u, v, late)
    samples[1], samples[0] = samples[0], y_sample
    for i in range(2):
        turned[1, i] = turned[0, i]
    turned[0, 0], turned[0, 1] = c, s


@compiled
def _add_information(
    latch: Record, memory: float, weight: float, u: float, v: float, late: float
) -> None:
    """Add that cosine times u and sine times v of the age made a sample late; find the age."""
    information, told = latch.information, latch.told
    information[0] = memory * information[0] + weight * u * u
    information[1] = memory * information[1] + weight * u * v
    information[2] = memory * information[2] + weight * v * v
    told[0] = memory * told[0] + weight * u * late
    told[1] = memory * told[1] + weight * v * late
    a, b, d = information[0] + latch.prior, information[1], information[2] + latch.prior
    determinant = a * d - b * b
    latch.age[0] = (d * told[0] - b * told[1]) / determinant
    latch.age[1] = (a * told[1] - b * told[0]) / determinant
