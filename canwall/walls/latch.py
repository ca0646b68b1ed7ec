"""The position at the SYNC, of a drive that latches it at ticks of its own.

A drive whose control cycle T_c runs on its own crystal answers a SYNC with the position of its last
tick, up to T_c ago. Where the SYNC's period is no multiple of T_c, that age changes from sample to
sample: at 1 rad/s by 0.2 mrad for T_c = 0.4 ms, eight counts of a 17-bit encoder, which a filter
takes for motion. Its pattern is known, a sawtooth at T/T_c, and its phase follows from a handle
that moves without torque. Of the sawtooth the first harmonic is taken; its mean age is part of the
delay.
"""

import math

import numpy as np

from canwall.compiled import Record, compiled
from canwall.walls.estimator import MAX_DELAY

#: Ticks of a drive against the SYNC.
LATCH = np.dtype(
    [
        ("turn", "f8"),  # of the ticks against the SYNC in a period [rad]; 0: always alike
        ("period", "f8"),
        ("resolution", "f8"),  # one count [rad]
        ("free", "f8"),  # largest torque under which the motion tells the age [N·m]
        ("prior", "f8"),
        ("received", "i8"),  # samples in a row, up to those of a second difference of ways
        ("j", "i8"),  # cycle of the last one
        ("samples", "f8", (2,)),  # the last ones, newest first [counts]
        # The way of a period [counts] times cosine and sine of the ticks, at these samples.
        ("turned", "f8", (2, 2)),
        # Of least squares for the ages' cosine and sine: products of the turned ways, (0, 0),
        # (0, 1), (1, 1), and their products with what the samples were late.
        ("information", "f8", (3,)),
        ("told", "f8", (2,)),
        ("age", "f8", (2,)),  # cosine and sine of the age beyond its mean [periods]
    ],
    align=True,
)

#: Part of a turn from one SYNC to the next below which the age counts as constant.
_LEAST_TURN = 0.02
#: Share of what is known that is left after a sample: crystals drift, and the sawtooth jumps.
_MEMORY = 0.97
#: Samples of a second difference of ways, each of which takes three.
_SAMPLES = 5
#: Way in a period below which a sample is as good at any age [counts].
_LEAST_WAY = 2.0


def set_latch(latch: np.void, period: float, drive_cycle: float, count: float, free: float) -> None:
    """Write the settings.

    Args:
        latch: A record LATCH.
        period: T [s].
        drive_cycle: T_c [s]; 0: not known.
        count: One count of the encoder [rad].
        free: Largest torque under which a handle counts as free [N·m].
    """
    turn = math.remainder(period / drive_cycle, 1.0) if drive_cycle else 0.0
    latch["turn"] = 2.0 * math.pi * turn if abs(turn) >= _LEAST_TURN else 0.0
    latch["period"], latch["resolution"], latch["free"] = period, abs(count), free
    # A count of noise, and an age evenly distributed over the cycle.
    latch["prior"] = 12.0 * (period / drive_cycle) ** 2 if drive_cycle else 0.0


def reset_latch(latch: np.void) -> None:
    """Begin with nothing known of the ticks."""
    for name in ("received", "samples", "turned", "information", "told", "age"):
        latch[name] = 0


@compiled
def at_sync(latch: Record, estimator: Record, j: int, y_sample: float) -> float:
    """Return the position at the SYNC of cycle j, less the mean age, for a sample [rad].

    estimator: before its correction with the sample.
    """
    if latch.turn == 0.0:
        return y_sample
    angle = latch.turn * j
    cosine, sine = math.cos(angle), math.sin(angle)
    _learn(latch, estimator, j, y_sample / latch.resolution, cosine, sine)
    way = estimator.v * latch.period
    if abs(way) < _LEAST_WAY * latch.resolution:
        return y_sample
    return y_sample + way * (latch.age[0] * cosine + latch.age[1] * sine)


@compiled
def _learn(
    latch: Record, estimator: Record, j: int, sample: float, cosine: float, sine: float
) -> None:
    """Learn from the second difference of the samples of a free handle."""
    samples, turned = latch.samples, latch.turned
    latch.received = min(latch.received + 1, _SAMPLES) if j == latch.j + 1 else 1
    latch.j = j
    way = 0.5 * (sample - samples[1])
    c, s = way * cosine, way * sine
    if latch.received == _SAMPLES and _is_free(latch, estimator):
        late = 2.0 * samples[0] - sample - samples[1]
        u = c - 2.0 * turned[0, 0] + turned[1, 0]
        v = s - 2.0 * turned[0, 1] + turned[1, 1]
        information, told = latch.information, latch.told
        information[0] = _MEMORY * information[0] + u * u
        information[1] = _MEMORY * information[1] + u * v
        information[2] = _MEMORY * information[2] + v * v
        told[0] = _MEMORY * told[0] + u * late
        told[1] = _MEMORY * told[1] + v * late
        a, b, d = information[0] + latch.prior, information[1], information[2] + latch.prior
        determinant = a * d - b * b
        latch.age[0] = (d * told[0] - b * told[1]) / determinant
        latch.age[1] = (a * told[1] - b * told[0]) / determinant
    samples[1], samples[0] = samples[0], sample
    for i in range(2):
        turned[1, i] = turned[0, i]
    turned[0, 0], turned[0, 1] = c, s


@compiled
def _is_free(latch: Record, estimator: Record) -> bool:
    largest = 0.0
    for age in range(MAX_DELAY + 1):
        largest = max(largest, abs(estimator.in_flight[age]))
    return bool(largest <= latch.free)
