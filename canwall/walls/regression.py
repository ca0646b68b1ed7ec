"""The mass at the handle and the delay, by a regression on what an observer does not expect.

One fast observer, with a bias of its own, follows the positions without any torque, the torque
alone, the velocity alone, its direction alone, and the difference that a later torque makes. What
it does not expect of the positions is −1/m times the same of the torque, −δ/m times that of the
difference, plus b/m times that of the velocity, plus f_c/m times that of the direction (Coulomb
friction), plus something steady, of a hand whose force changes, which changes slowly from sample to
sample. What changes more slowly (the operator's push, friction in one direction) is in none of
them. δ is the delay beyond the one told. It is the drive's: what was learned of it is kept when the
hand goes.

On an elastic shaft it is the load that is observed, by what the rotor tells of it, and the delay is
as told.

The torque is the wall's, or a probe's.
"""

import math

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.walls.estimator import MAX_DELAY, unit_motion
from canwall.walls.least_squares import FRICTION, PRIOR_EXCESS
from canwall.walls.shaft import ElasticShaft
from canwall.walls.swing import SWING, end_swing, follow_swing, lightness_of_swing, set_swing

#: Most samples over which a way is measured, on a coarse encoder.
_RECENT = 8

#: A regression.
REGRESSION = np.dtype(
    [
        ("period", "f8"),
        ("resolution", "f8"),  # one count [rad]
        ("lightest", "f8"),  # smallest mass that there may be, beyond an elastic shaft
        # Delay as told; beyond that, as found, and its standard deviation [periods]; precision and
        # mean of what was known of it before the present hand.
        ("delay", "f8"),
        ("excess", "f8"),
        ("excess_spread", "f8"),
        ("excess_before", "f8", (2,)),
        # The observer of [y, ẏ, ÿ], its gain, and its state for positions, torque (of a unit mass),
        # velocity, direction and the difference of a later torque; what it does not expect of them
        # at this sample, and one count.
        ("gain", "f8", (3,)),
        ("observed", "f8", (3, 5)),
        # Inertia of the rotor on an elastic shaft, 0: rigid, and compliance of the shaft over T²;
        # for a unit mass under the torque, the part of its next second difference that the last
        # period made, and the second difference; torque in the shaft and position behind it.
        ("rotor", "f8"),
        ("softness", "f8"),
        ("begun", "f8"),
        ("bend", "f8"),
        ("shaft_torque", "f8"),
        ("load", "f8"),
        ("surprise", "f8", (6,)),
        ("information", "f8", (6, 6)),  # weighted sums of their products
        ("normal", "f8", (6, 6)),  # the same with what is known before, as it is being solved
        # Surprise by a push that grows, as found before the wall gives a torque [rad]; the share of
        # a difference by which it follows; and what is left of it after a period under a torque.
        ("growth", "f8"),
        ("growth_followed", "f8"),
        ("growth_left", "f8"),
        ("noise", "f8"),  # mean square of what nothing explains [rad²]
        ("swing", SWING, (1,)),
        ("swung", "?"),  # a swing has told, at this sample, that the hand is a heavier one
        ("hand_torque", "f8"),  # surprise by a torque that changes as fast as a hand's
        ("hand_change", "f8"),  # by how much that surprise changes until the next sample
        ("samples", "f8", (_RECENT,)),  # the last ones, newest first [rad]
        ("way", "f8"),  # of a sample, the mean of the last ones [rad]
        ("way_samples", "i8"),  # their number
        # The longest way of late, without sign, and what is left of it after a period.
        ("longest_way", "f8"),
        ("way_left", "f8"),
        ("steady", "i8"),  # samples since the handle stuck, or turned on an elastic shaft
        ("moving", "i8"),  # their number from which on the handle moves
    ],
    align=True,
)

#: Bandwidth of the observer, faster than what hand and friction do meanwhile [Hz], and by how much
#: it is slower behind an elastic shaft, of which little is known near its resonance.
_OBSERVER_HZ, OBSERVER_SLOWER_BEHIND_SHAFT = 100.0, 2
#: Noise of its surprise by the steps of the encoder [counts], and share of the noise that is
#: exchanged with a sample: drives latch their position at ticks of their own.
_QUANTISATION, _NOISE_SHARE = 0.5, 1.0 / 16.0
#: Time after which the bias has followed a handle that broke loose, and its least samples.
_STEADY_S, _STEADY = 0.006, 6
#: Least way of each of them, or of its neighbour where the handle turns [counts], and that of a
#: handle that has been calm: one that sticks is as heavy as the world. An elastic shaft hides its
#: turns: there the way goes on in one direction.
_LEAST_WAY, _CALM_LEAST_WAY = 1.5, 0.9
#: Speed that is told from rest [rad/s]: where it makes less than the least way in a sample, the way
#: is that of several.
_TOLD_FROM_REST = 0.072
#: Fastest change of a hand's force, and that of a hand which has been calm [N·m/s]. A torque that
#: changes no faster may be its answer to the hand, and then says nothing of the mass: a wall that
#: gives way to none looks heavy. The slower one holds where the torque rises: a calm hand that
#: withdraws may be fast, but an arm on a wall with a finger's mass in its model swings, and at
#: first more slowly than a hand may push.
HAND_RATE, _CALM_HAND_RATE = 8.0, 1.0
#: Stiffness of a firm grip at the handle [N·m/rad], 800 N/m at 80 mm: stopped by the wall, a hand
#: pushes the harder, the faster it came. Time constant with which that speed is forgotten [s].
_HAND_STIFFNESS, _SPEED_S = 5.0, 0.2
#: Mass over the one in force from which on a swing tells of another hand, and rate of the torque
#: from which on it goes to or fro [N·m/s]. Below it noise makes turns; the higher it is, the louder
#: a swing is when it tells.
_HEAVIER, _SWING_RATE = 1.5, 0.6
#: Share of what is not expected that is taken for growth of the push, before the wall gives a
#: torque, and time constant with which that growth is forgotten under one [s].
_GROWTH_FOLLOWED, _GROWTH_S = 0.3, 0.02
#: Random walk of that change [N·m/s per √s]: within 10 ms a hand begins to push, and ends.
_HAND_RATE_WALK = 20.0
#: Torque that says something whatever friction does, as a multiple of that of a hand.
_STRONG = 4.0
#: Uncertainty of a torque's course, as a share of its steps, as it usually is and at the most: a
#: drive takes them over at ticks of its own, and its current loop follows as it likes.
_UNTIMELY, _UNTIMELY_MOST = 0.1, 0.3
#: Surprise that is explained by none, as a multiple of the noise.
_UNEXPLAINED = 6.0
#: Growth of the noise from one sample to the next that casts doubt on the samples before.
_SUDDENLY = 1.5
#: Share of what is known that is left after a sample that tells as much as those before, and after
#: one that nothing explains: another hand, or a blow.
_MEMORY, _DOUBTED = 0.98, 0.1
#: Added to the standard deviation of the delay from one hand to the next [periods].
_EXCESS_CHANGES = 0.05


def set_regression(
    regression: np.void,
    lightest: float,
    period: float,
    count: float,
    delay: float,
    shaft: ElasticShaft | None = None,
    known: bool = False,
) -> None:
    """Write a regression's settings.

    Args:
        regression: A record REGRESSION.
        lightest: Smallest mass that there may be.
        period: T [s].
        count: One count of the encoder [rad].
        delay: D in periods.
        shaft: What joins rotor and handle. Default: they are one.
        known: True for a hand whose mass is known.
    """
    regression["period"], regression["resolution"] = period, count
    regression["rotor"] = shaft.rotor if shaft else 0.0
    regression["softness"] = 1.0 / (shaft.stiffness * period**2) if shaft else 0.0
    regression["lightest"] = lightest - regression["rotor"]
    regression["delay"] = delay
    set_swing(regression["swing"][0], period, count)
    bandwidth = _OBSERVER_HZ / (OBSERVER_SLOWER_BEHIND_SHAFT if shaft else 1)
    regression["gain"] = gain = _observer_gain(bandwidth, period)
    regression["surprise"][5] = count
    regression["hand_torque"] = HAND_RATE * period / gain[2]
    regression["growth_left"] = math.exp(-period / _GROWTH_S)
    regression["way_left"] = math.exp(-period / _SPEED_S)
    regression["growth_followed"] = 0.0 if shaft or known else _GROWTH_FOLLOWED
    walk = 0.0 if shaft else _HAND_RATE_WALK
    regression["hand_change"] = walk * math.sqrt(period) * period / gain[2]
    least_way = _LEAST_WAY * count
    regression["way_samples"] = min(max(round(least_way / (_TOLD_FROM_REST * period)), 1), _RECENT)
    regression["moving"] = max(round(_STEADY_S / period), _STEADY)


def _observer_gain(bandwidth: float, period: float) -> NDArray[np.float64]:
    """Return the gain that gives the observer of [y, ẏ, ÿ] three equal poles p.

    They are at its bandwidth, but no faster than a tenth of the sample rate. It is the
    fading-memory filter of third order: 1 − p³, 1.5·(1 − p)²·(1 + p)/T, (1 − p)³/T².
    """
    pole = math.exp(-2.0 * math.pi * min(bandwidth * period, 0.1))
    rest = 1.0 - pole
    return np.array([1.0 - pole**3, 1.5 * rest**2 * (1.0 + pole) / period, rest**3 / period**2])


def reset_regression(regression: np.void, y: float) -> None:
    """Begin at rest at y, with nothing known of mass and delay."""
    for name in ("observed", "information", "way", "longest_way", "steady"):
        regression[name] = 0
    for name in ("begun", "bend", "shaft_torque", "excess", "growth"):
        regression[name] = 0.0
    regression["excess_spread"] = PRIOR_EXCESS
    regression["excess_before"] = 1.0 / PRIOR_EXCESS**2, 0.0
    regression["observed"][0, 0] = regression["load"] = y
    regression["samples"] = y
    regression["noise"] = (_QUANTISATION * regression["resolution"]) ** 2
    end_swing(regression["swing"][0])


@compiled
def moves(regression: Record) -> bool:
    """Return True if the handle has moved for a while, by more than the steps of the encoder."""
    return regression.steady >= regression.moving


@compiled
def comes(regression: Record) -> bool:
    """Return True if the handle goes towards the wall, by more than the steps of the encoder."""
    way = -regression.way * regression.way_samples
    return bool(way >= _LEAST_WAY * regression.resolution)


@compiled
def begin_regression(regression: Record, y: float, v: float, torque: float) -> None:
    """Begin at y and a steady v, while something holds against a torque; what is known stays.

    A torque that seemed to begin now and to move nothing would be on something heavy.
    """
    t = regression.period
    regression.observed[:] = 0.0
    regression.observed[1, 0], regression.observed[2, 1] = v, -torque
    regression.observed[2, 2] = -v
    if v != 0.0:
        regression.observed[2, 3] = -math.copysign(1.0, v)
    regression.shaft_torque, regression.begun = torque, 0.5 * t * t * torque
    regression.observed[0, 0] = regression.load = y - regression.softness * t * t * torque
    for age in range(_RECENT):
        regression.samples[age] = y - age * t * v
    regression.way = regression.growth = 0.0
    regression.steady = 0
    end_swing(regression.swing[0])
    regression.noise = (_QUANTISATION * regression.resolution) ** 2


@compiled
def forget_mass(regression: Record) -> None:
    """Forget all that is known of the mass; what it told of the delay is kept."""
    spread = regression.excess_spread
    regression.excess_before[0] = 1.0 / (spread * spread + _EXCESS_CHANGES * _EXCESS_CHANGES)
    regression.excess_before[1] = regression.excess
    regression.information[:] = 0.0


@compiled
def learn(
    regression: Record,
    estimator: Record,
    y_sample: float,
    mass: float,
    calm: bool,
    probed: bool,
) -> bool:
    """Learn from a sample; return True if what is known of the mass has changed.

    estimator: with the torques in flight. mass: the one in force. calm: True if the handle has not
    moved fast for a while; of no meaning on an elastic shaft. probed: True if it is being probed.
    """
    mass -= regression.rotor
    if regression.rotor > 0.0:
        calm = False
        _observe(regression, _advance_load(regression, y_sample))
    else:
        _add_direction(regression, y_sample)
        _observe(regression, y_sample)
    steps = _torque_steps(estimator) * regression.period * regression.period
    explained = _is_explained(regression, steps)
    _note_way(regression, y_sample, explained, _CALM_LEAST_WAY if calm else _LEAST_WAY)
    _let_push_change(regression, mass)
    _follow_swing(regression, estimator, y_sample, mass, calm)
    told = abs(_torque_surprise(regression)) / regression.hand_torque
    least = _share_of_hand_rate(regression, calm)
    if told <= least:
        _note_noise(regression, mass)
    alone = probed or not np.any(estimator.in_flight)
    _follow_growth(regression, mass, alone, told <= least)
    if not explained:
        _doubt(regression)
        return True
    if regression.swung:
        return True
    if not torque_rises(regression, estimator):
        least = 1.0
    tells = moves(regression) and (probed or told > least)
    if tells or told > _STRONG:
        untimely = _UNTIMELY * steps / mass + _UNTIMELY * steps * regression.softness
        _add_information(regression, untimely, mass)
        return True
    return False


@compiled
def _observe(regression: Record, y_sample: float) -> None:
    """Correct the observer: what it did not expect of the sample, of torque and of motion."""
    surprise, observed = regression.surprise, regression.observed
    for c in range(5):
        surprise[c] = (y_sample if c == 0 else 0.0) - observed[0, c]
        for i in range(3):
            observed[i, c] += regression.gain[i] * surprise[c]


@compiled
def _add_direction(regression: Record, y_sample: float) -> None:
    """Add to the observer the direction of the last period, as an acceleration.

    Where the velocity, a straight line over the period, changes its sign, it is the mean.
    """
    t, x, before = regression.period, regression.observed, regression.samples
    begin = y_sample - before[1]
    end = 3.0 * y_sample - 4.0 * before[0] + before[1]
    both = abs(begin) + abs(end)
    if both > 0.0:
        direction = (begin + end) / both
        x[0, 3] += 0.5 * t * t * direction
        x[1, 3] += t * direction


@compiled
def _advance_load(regression: Record, y_sample: float) -> float:
    """Advance the observer to the sample before this one, behind an elastic shaft.

    The shaft carries what of the torque does not accelerate the rotor, τ = f − J_r·ÿ, and the load
    is at y − τ/k: the motion of a rigid mass under τ. The second difference of the positions is a
    mean of ÿ about the sample before, as that of a unit mass is of f.

    Returns:
        Position of the load at the sample before.
    """
    t, x, samples = regression.period, regression.observed, regression.samples
    second = y_sample - 2.0 * samples[0] + samples[1]
    before, torque = (
        regression.shaft_torque,
        (regression.bend - regression.rotor * second) / (t * t),
    )
    load = samples[0] - regression.softness * t * t * torque
    for c in range(3):
        x[0, c] += t * x[1, c] + 0.5 * t * t * x[2, c]
        x[1, c] += t * x[2, c]
    # From the one torque to the other in a straight line.
    x[0, 1] += t * t * (before / 3.0 + torque / 6.0)
    x[1, 1] += 0.5 * t * (before + torque)
    way = load - regression.load
    x[0, 2] += 0.5 * t * way
    x[1, 2] += way
    regression.shaft_torque, regression.load = torque, load
    return load


@compiled
def _torque_surprise(regression: Record) -> float:
    """Return the surprise by the torque, as late as it was found to be."""
    return regression.surprise[1] + regression.excess * regression.surprise[4]


@compiled
def torque_rises(regression: Record, estimator: Record) -> bool:
    """Return True if the torque that acts becomes larger, as the observer sees it."""
    return _torque_surprise(regression) * estimator.in_flight[estimator.delay_periods] < 0.0


@compiled
def _share_of_hand_rate(regression: Record, calm: bool) -> float:
    """Return the part of HAND_RATE at which a hand may push that is calm, or came as this one."""
    speed = 0.0 if calm else regression.longest_way / regression.period
    return min((_CALM_HAND_RATE + _HAND_STIFFNESS * speed) / HAND_RATE, 1.0)


@compiled
def _torque_steps(estimator: Record) -> float:
    """Return the sum of the last two steps of the torque that acted, without sign [N·m]."""
    steps = 0.0
    n = estimator.delay_periods
    for age in range(n, n + 2):
        steps += abs(estimator.in_flight[age] - estimator.in_flight[age + 1])
    return steps


@compiled
def _is_explained(regression: Record, steps: float) -> bool:
    """Return True if there is a mass for which the torque explains the motion."""
    rest = abs(regression.surprise[0] - regression.growth) - _UNEXPLAINED * math.sqrt(
        regression.noise
    )
    torque = abs(_torque_surprise(regression)) + _UNTIMELY_MOST * steps
    torque += FRICTION * abs(regression.surprise[3])
    torque += _UNTIMELY_MOST * steps * regression.softness * regression.lightest
    return rest * regression.lightest <= torque


@compiled
def _note_way(regression: Record, y_sample: float, explained: bool, least_way: float) -> None:
    n = regression.way_samples
    way = (y_sample - regression.samples[n - 1]) / n
    least = least_way * regression.resolution / n
    if regression.rotor > 0.0:
        goes_on = abs(way) >= least and way * regression.way >= 0.0
    else:
        goes_on = max(abs(way), abs(regression.way)) >= least
    regression.steady = regression.steady + 1 if goes_on and explained else 0
    regression.way = way
    regression.longest_way = max(abs(way), regression.way_left * regression.longest_way)
    for age in range(_RECENT - 1, 0, -1):
        regression.samples[age] = regression.samples[age - 1]
    regression.samples[0] = y_sample


@compiled
def _note_noise(regression: Record, mass: float) -> None:
    rest = regression.surprise[0] + _torque_surprise(regression) / mass
    square = min(rest * rest, _UNEXPLAINED * _UNEXPLAINED * regression.noise)
    noise = regression.noise + _NOISE_SHARE * (square - regression.noise)
    noise = max(noise, (_QUANTISATION * regression.resolution) ** 2)
    if noise > _SUDDENLY * regression.noise:
        # What began a few samples ago was taken for an answer to the torque meanwhile.
        _forget(regression, regression.noise / noise)
    regression.noise = noise


@compiled
def _follow_growth(regression: Record, mass: float, alone: bool, quiet: bool) -> None:
    """Follow how fast the push grows while the handle is alone; forget it slowly afterwards.

    A push that grows under the first torques of the wall would look like mass.

    mass: the one in force. alone: True while it is probed, or if no torque is in flight. quiet:
    True if the torque says nothing.
    """
    if not alone:
        regression.growth *= regression.growth_left
    elif quiet:
        rest = regression.surprise[0] + _torque_surprise(regression) / mass - regression.growth
        regression.growth += regression.growth_followed * rest


@compiled
def _follow_swing(
    regression: Record, estimator: Record, y_sample: float, mass: float, calm: bool
) -> None:
    """Begin anew with what a swing of the wall tells, if that is a heavier hand.

    mass: the one in force. calm: as for `learn`; a blow is none.
    """
    swing, r = regression.swing[0], regression.surprise
    regression.swung = False
    if not calm or estimator.in_flight[estimator.delay_periods] == 0.0:
        end_swing(swing)
        return
    turns_at = _SWING_RATE / HAND_RATE * regression.hand_torque
    if not follow_swing(swing, y_sample, r[0], _torque_surprise(regression), turns_at):
        return
    lightness, deviation, noise = lightness_of_swing(swing)
    if (lightness + deviation) * mass * _HEAVIER > 1.0:
        return
    forget_mass(regression)
    both, information = swing.both[0], regression.information
    information[0, 0] = both.rr / noise
    information[0, 1] = information[1, 0] = both.rt / noise
    information[1, 1] = both.tt / noise
    regression.swung = True


@compiled
def _add_information(regression: Record, untimely: float, mass: float) -> None:
    """Add what this sample tells; in return as much of what was known is forgotten.

    untimely: uncertainty of the motion by that of the torque's course [rad].
    """
    r, information = regression.surprise, regression.information
    weight = 1.0 / (regression.noise + untimely * untimely)
    torque = _torque_surprise(regression)
    rest = max(abs(r[0] - regression.growth + torque / mass) - FRICTION / mass * abs(r[3]), 0.0)
    if weight * rest * rest > _UNEXPLAINED * _UNEXPLAINED:
        _doubt(regression)
    exchanged = min(1.0 - _MEMORY, weight * torque * torque / max(information[1, 1], 1e-300))
    for i in range(6):
        for c in range(6):
            information[i, c] = (1.0 - exchanged) * information[i, c] + weight * r[i] * r[c]


@compiled
def _let_push_change(regression: Record, mass: float) -> None:
    """Let the steady term drift by a random walk until the next sample.

    A hand that begins to push while the wall does would look heavy. mass: the one in force.
    """
    information = regression.information
    change = regression.hand_change / (mass * regression.resolution)
    variance = change * change
    for i in range(6):
        share = information[i, 5] * variance / (1.0 + information[5, 5] * variance)
        for c in range(6):
            information[i, c] -= share * information[5, c]


@compiled
def _doubt(regression: Record) -> None:
    _forget(regression, _DOUBTED)


@compiled
def _forget(regression: Record, left: float) -> None:
    information = regression.information
    for i in range(6):
        for c in range(6):
            information[i, c] *= left


@compiled
def predict_regression(
    regression: Record, in_flight: NDArray[np.float64], force: float, age: float
) -> None:
    """Advance the observer by a period, at the end of which `force` will be in flight, too.

    age: that of the sample at its begin beyond the mean [periods]; torques act as much earlier.
    """
    t, x, excess = regression.period, regression.observed, regression.excess
    delay = min(max(regression.delay + excess - age, 0.0), float(MAX_DELAY))
    way, speed, later_way, later_speed = unit_motion(in_flight, force, delay, t)
    if regression.rotor > 0.0:
        regression.bend = regression.begun + way
        regression.begun = t * speed - way
        return
    for c in range(5):
        x[0, c] += t * x[1, c] + 0.5 * t * t * x[2, c]
        x[1, c] += t * x[2, c]
    # Torque and delay are regressed on as they are at the delay that was told.
    x[0, 1] += way - excess * later_way
    x[1, 1] += speed - excess * later_speed
    x[0, 4] += later_way
    x[1, 4] += later_speed
    y = regression.samples
    # In the middle of the coming period, extrapolated from the middles of the last two.
    v = (2.0 * y[0] - 3.0 * y[1] + y[2]) / t
    x[0, 2] += 0.5 * t * t * v
    x[1, 2] += t * v
