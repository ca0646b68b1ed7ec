"""The operator identified in the cycle, and a bank of steady-state Kalman filters over the mass.

The mass follows from a regression: one fast observer, with a bias of its own, follows the positions
without any torque, the torque alone, and the velocity alone. What it does not expect of the
positions is −1/m times the same of the torque, plus b/m times that of the velocity; what changes
slowly (the operator's push, friction in one direction) is in none of them. State and model in force
are interpolated between the two filters next to that mass. Coulomb friction is left to the bias
force d̂ (theory, section 8).

The bank works on an estimator in its steady state and hands over state and model to it. In a gap
of samples, and until the estimator has settled again, the estimator goes on alone and the bank
follows it.
"""

import math

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.physics import zoh
from canwall.walls.estimator import MAX_DELAY, KalmanModel, kalman_model, set_model

#: Largest number of filters.
MAX_FILTERS = 24

#: Number of samples that are kept: two differences give the velocity to come.
_RECENT = 3

#: A bank, in the order of the masses. Gains, covariances and transitions are made beforehand:
#: nothing of a Riccati equation is left for the cycle.
BANK = np.dtype(
    [
        ("adapts", "?"),
        ("count", "i8"),
        ("log_lightest", "f8"),
        ("log_step", "f8"),
        ("spring", "f8"),
        ("resolution", "f8"),  # one count [rad]
        ("viscous", "f8", (MAX_FILTERS,)),
        # [y, ẏ, d] of each filter, and its gain.
        ("state", "f8", (3, MAX_FILTERS)),
        ("gain", "f8", (3, MAX_FILTERS)),
        # Over a period: Φ row by row, and the effects on (y, ẏ) of the older force, which acts up
        # to the instant of actuation, and of the newer one.
        ("phi", "f8", (4, MAX_FILTERS)),
        ("older", "f8", (2, MAX_FILTERS)),
        ("newer", "f8", (2, MAX_FILTERS)),
        # Models for an estimator that loses samples.
        ("covariance", "f8", (MAX_FILTERS, 3, 3)),
        ("transition", "f8", (MAX_FILTERS, 3, 3)),
        ("scale", "f8", (MAX_FILTERS, 3)),
        ("force_noise", "f8", (MAX_FILTERS,)),
        # The observer of [y, ẏ, ÿ], its gain, and its state for positions, torque (of a unit mass)
        # and velocity; what it does not expect of them at this sample; the sums of their products.
        ("observer_gain", "f8", (3,)),
        ("hand_torque", "f8"),  # surprise by a torque that changes as fast as a hand's
        ("observed", "f8", (3, 3)),
        ("surprise", "f8", (4,)),
        ("information", "f8", (4, 4)),
        ("period", "f8"),
        ("delay_share", "f8"),  # of a period, up to the instant of actuation
        ("noise", "f8"),  # mean square of what nothing explains [rad²]
        ("explained", "?"),
        ("steady", "i8"),  # samples in a row that moved on in one direction
        ("direction", "f8"),
        # Place of the mass in force on the scale of the filters' numbers.
        ("place", "f8"),
        ("samples", "f8", (_RECENT,)),  # the last ones, newest first [rad]
        ("at_rest", "i8"),  # samples without torque in a row
        ("forgotten", "i8"),  # of those after which the hand may be another one
        ("mass", "f8"),
        ("least_mass", "f8"),  # lightest that is believable
        ("approach", "f8"),  # speed of the approach to the present contact [rad/s]
        ("probe", "f8"),  # torque before a contact [N·m]
        ("probed", "i8"),  # samples of the present probe
        ("spread", "f8"),  # standard deviation of ln(mass), as far as the residuals tell
    ],
    align=True,
)

#: Bandwidth of the observer, faster than what hand and friction do meanwhile [Hz].
_OBSERVER_HZ = 100.0
#: Noise of the observer's surprise by the steps of the encoder [counts], and share of the noise
#: that is exchanged with a sample: drives latch their position at ticks of their own.
_QUANTISATION, _NOISE_SHARE = 0.5, 1.0 / 16.0
#: Samples in one direction after which friction is part of the bias, and the least way of each
#: [counts]: a handle that sticks is as heavy as the world.
_STEADY, _LEAST_WAY = 6, 1.5
_UNTIMELY_MOST = 0.3
#: Torque that says something whatever friction does, as a multiple of that of a hand.
_STRONG = 4.0
#: Surprise that no torque explains, as a multiple of the noise; more is the hand's doing.
_UNEXPLAINED = 6.0
#: Share of what is known that is left after a sample that tells as much as those before.
_MEMORY = 0.98
#: The same after a sample that no torque explains.
_DOUBTED = 0.1
#: Before the first torque: standard deviation of m₀/m about 1, with m₀ the lightest mass; mean and
#: standard deviation of b/m [1/s].
_PRIOR_LIGHTNESS, _PRIOR_RATE, _PRIOR_RATE_DEVIATION = 0.7, 100.0, 150.0
#: Standard deviation of the surprise by a hand whose force changes steadily [counts].
_PRIOR_STEADY = 4.0
#: Time without torque after which another hand may be at the handle [s].
_FORGOTTEN_S = 0.2
#: Standard deviations of 1/m up to which a lighter hand is believable.
_BELIEVABLE = 2.0
#: Ratio of the mass in force to the lightest believable one from which on a push is bounded.
_CERTAIN = 1e9
#: Share of the speed of approach with which a hand of uncertain mass may be returned.
_RETURNED = 0.9
#: Time before a contact from which on a probe shows who is coming [s], and half its period
#: [samples]: as slow as the observer lets through.
_PROBE_S, _PROBE_SAMPLES = 0.06, 4
#: Fastest change of a hand's force [N·m/s]. A torque that changes no faster may be its answer to
#: the hand, and then says nothing of the mass: a wall that gives way to none looks heavy.
_HAND_RATE = 8.0
#: Motion of the lightest hand under a probe [counts].
_PROBE_COUNTS = 4.0
#: Uncertainty of a torque's course, as a share of its steps: a drive takes them over at ticks of
#: its own, and its current loop follows as it likes.
_UNTIMELY = 0.1
#: Share of the way to the likeliest mass that is gone in a period.
_FOLLOWED = 0.6
#: Power of the mass with which the walk of a hand's force falls. What the steps of the encoder make
#: felt at the handle grows with mass and bandwidth; so it stays below what is felt for all.
_STEADINESS = 0.7
#: Time constant at which a light hand's damping equals its inertia [s].
_HAND_S = 1.5e-3


def hand_damping(inertia: float, most: float) -> float:
    """Return the damping of a hand of this inertia at the handle, which tends to `most`.

    Fingers of a few grams have some newton seconds per metre, a grip and an arm hardly more.
    """
    return most * inertia / (inertia + most * _HAND_S)


def set_bank(
    bank: NDArray[np.void],
    masses: NDArray[np.float64],
    viscous: NDArray[np.float64],
    spring: float,
    period: float,
    count: float,
    force_walk: float,
    delay: float,
) -> None:
    """Write the filters into a BANK array (1,).

    Args:
        bank: The bank.
        masses: Masses of the filters, shape (n,), in geometric progression; 3 ≤ n ≤ MAX_FILTERS.
        viscous: Their viscous dampings, shape (n,).
        spring: Spring of all.
        period: T [s].
        count: One count of the encoder [rad].
        force_walk: See `kalman_model`; that of the lightest.
        delay: D in periods; its fraction counts.
    """
    n = len(masses)
    if not 3 <= n <= MAX_FILTERS:
        raise ValueError(f"a bank has 3 to {MAX_FILTERS} filters, not {n}")
    fraction = delay - math.floor(delay)
    bank["adapts"], bank["count"] = True, n
    bank["log_lightest"] = math.log(masses[0])
    bank["log_step"] = math.log(masses[-1] / masses[0]) / (n - 1)
    bank["spring"], bank["resolution"] = spring, abs(count)
    bank["forgotten"] = round(_FORGOTTEN_S / period)
    bank["period"], bank["delay_share"] = period, fraction
    quarter = 0.5 * _PROBE_SAMPLES * period
    bank["probe"] = _PROBE_COUNTS * abs(count) * masses[0] / quarter**2
    bank["observer_gain"] = _observer_gain(period)
    bank["surprise"][0, 3] = abs(count)
    bank["hand_torque"] = _HAND_RATE * period / bank["observer_gain"][0, 2]
    bank["viscous"][0, :n] = viscous
    for i in range(n):
        walk = force_walk * float(masses[0] / masses[i]) ** _STEADINESS
        model = kalman_model(masses[i], viscous[i], spring, period, count, walk)
        _set_filter(bank[0], i, model)
        phi, _ = zoh(masses[i], viscous[i], spring, period)
        _, before = zoh(masses[i], viscous[i], spring, fraction * period)
        phi_after, after = zoh(masses[i], viscous[i], spring, (1.0 - fraction) * period)
        bank["phi"][0, :, i] = phi.ravel()
        bank["older"][0, :, i] = phi_after @ before
        bank["newer"][0, :, i] = after


def _observer_gain(period: float) -> NDArray[np.float64]:
    """Return the gain that gives the observer of [y, ẏ, ÿ] three equal poles p.

    They are at its bandwidth, but no faster than a tenth of the sample rate. It is the
    fading-memory filter of third order: 1 − p³, 1.5·(1 − p)²·(1 + p)/T, (1 − p)³/T².
    """
    pole = math.exp(-2.0 * math.pi * min(_OBSERVER_HZ * period, 0.1))
    rest = 1.0 - pole
    return np.array([1.0 - pole**3, 1.5 * rest**2 * (1.0 + pole) / period, rest**3 / period**2])


def _set_filter(bank: np.void, i: int, model: KalmanModel) -> None:
    bank["gain"][:, i] = model.gain
    bank["covariance"][i], bank["transition"][i] = model.covariance, model.transition
    bank["scale"][i], bank["force_noise"][i] = model.scale, model.force_noise


def reset_bank(bank: NDArray[np.void], y: float) -> None:
    """Begin at rest at y with the lightest hand."""
    bank["state"] = 0.0
    bank["state"][:, 0] = y
    bank["observed"] = bank["information"] = 0.0
    bank["observed"][:, 0, 0] = y
    bank["steady"], bank["direction"] = 0, 0.0
    bank["place"] = 0.0
    bank["samples"] = y
    bank["at_rest"] = bank["probed"] = 0
    bank["noise"] = (_QUANTISATION * bank["resolution"]) ** 2
    bank["approach"] = 0.0
    bank["mass"] = bank["least_mass"] = np.exp(bank["log_lightest"])
    bank["spread"] = 0.0


@compiled
def correct_bank(bank: Record, estimator: Record, y_sample: float) -> bool:
    """Correct all filters with a sample, learn from it, and hand over; True if the mass changed.

    To be called after `correct` of the estimator, whose state it replaces.
    """
    n = bank.count
    state, gain = bank.state, bank.gain
    if not estimator.settled:
        for i in range(n):
            state[0, i], state[1, i], state[2, i] = estimator.y, estimator.v, estimator.d
        _begin_observing(bank, y_sample)
        return False
    for i in range(n):
        residual = y_sample - state[0, i]
        state[0, i] += gain[0, i] * residual
        state[1, i] += gain[1, i] * residual
        state[2, i] += gain[2, i] * residual
    changed = False
    _observe(bank, y_sample)
    _note_direction(bank, estimator, y_sample)
    told = abs(bank.surprise[1]) / bank.hand_torque
    if told <= 1.0:
        _note_noise(bank)
    if _torque_acted(estimator):
        bank.at_rest = 0
        steady = bank.steady >= _STEADY and (bank.probed > 0 or told > 1.0)
        if steady or (told > _STRONG and bank.explained):
            _learn(bank, estimator)
            changed = _follow(bank)
        elif not bank.explained:
            _doubt(bank)
            changed = _follow(bank)
    else:
        bank.at_rest += 1
        if bank.at_rest == bank.forgotten:
            changed = _forget(bank)
    k = min(int(bank.place), n - 2)
    share = bank.place - k
    estimator.y = state[0, k] + share * (state[0, k + 1] - state[0, k])
    estimator.v = state[1, k] + share * (state[1, k + 1] - state[1, k])
    estimator.d = state[2, k] + share * (state[2, k + 1] - state[2, k])
    if changed:
        viscous = bank.viscous[k] + share * (bank.viscous[k + 1] - bank.viscous[k])
        set_model(estimator, bank.mass, viscous, bank.spring)
        _set_covariance(bank, estimator, int(bank.place + 0.5))
    return changed


@compiled
def _begin_observing(bank: Record, y_sample: float) -> None:
    bank.observed[:] = 0.0
    bank.observed[0, 0] = y_sample
    for age in range(_RECENT):
        bank.samples[age] = y_sample
    bank.steady = 0


@compiled
def _observe(bank: Record, y_sample: float) -> None:
    """Correct the observer: what it did not expect of the sample, of torque and of velocity."""
    for c in range(3):
        bank.surprise[c] = (y_sample if c == 0 else 0.0) - bank.observed[0, c]
        for i in range(3):
            bank.observed[i, c] += bank.observer_gain[i] * bank.surprise[c]


@compiled
def _note_noise(bank: Record) -> None:
    rest = bank.surprise[0] + bank.surprise[1] / bank.mass
    square = min(rest * rest, _UNEXPLAINED**2 * bank.noise)
    bank.noise += _NOISE_SHARE * (square - bank.noise)
    bank.noise = max(bank.noise, (_QUANTISATION * bank.resolution) ** 2)


@compiled
def _note_direction(bank: Record, estimator: Record, y_sample: float) -> None:
    way = y_sample - bank.samples[0]
    goes_on = abs(way) >= _LEAST_WAY * bank.resolution and way * bank.direction >= 0.0
    period = bank.period
    unexplained = abs(bank.surprise[0]) - _UNEXPLAINED * math.sqrt(bank.noise)
    torque = abs(bank.surprise[1]) + _UNTIMELY_MOST * _torque_steps(estimator) * period * period
    explained = unexplained * _mass_at(bank, 0.0) <= torque
    bank.steady = bank.steady + 1 if goes_on and explained else 0
    bank.explained = explained
    bank.direction = way
    for age in range(_RECENT - 1, 0, -1):
        bank.samples[age] = bank.samples[age - 1]
    bank.samples[0] = y_sample


@compiled
def _predict_observer(bank: Record, older: float, newer: float) -> None:
    """Advance the observer by a period under the torques before and after the actuation."""
    t, share, x = bank.period, bank.delay_share, bank.observed
    for c in range(3):
        x[0, c] += t * x[1, c] + 0.5 * t * t * x[2, c]
        x[1, c] += t * x[2, c]
    rest = 1.0 - share
    x[0, 1] += t * t * (share * (1.0 - 0.5 * share) * older + 0.5 * rest * rest * newer)
    x[1, 1] += t * (share * older + rest * newer)
    y = bank.samples
    # In the middle of the coming period, extrapolated from the middles of the last two.
    v = (2.0 * y[0] - 3.0 * y[1] + y[2]) / t
    x[0, 2] += 0.5 * t * t * v
    x[1, 2] += t * v


@compiled
def _forget(bank: Record) -> bool:
    """Begin with the lightest hand again; return True if another one was in force."""
    bank.information[:] = 0.0
    changed = bank.place != 0.0
    bank.place, bank.spread = 0.0, 0.0
    bank.mass = bank.least_mass = _mass_at(bank, 0.0)
    return changed


@compiled
def force_for_unknown(bank: Record, wall: Record, force: float) -> float:
    """Return the force for a hand that is not known yet: a law's, bounded, or before it a probe."""
    if wall.y > 0.0:
        bank.approach = max(-wall.v, 0.0)
    if force == 0.0:
        return _probe(bank, wall)
    bank.probed = 0
    return force


@compiled
def _probe(bank: Record, wall: Record) -> float:
    """Return a torque to and fro shortly before a contact, by which the hand is known in it."""
    comes = -wall.v * bank.period >= _LEAST_WAY * bank.resolution
    if not (comes and 0.0 < wall.y <= -wall.v * _PROBE_S):
        bank.probed = 0
        return 0.0
    # The first half is half as long: the handle is pushed about its own path.
    swing = (bank.probed + _PROBE_SAMPLES // 2) // _PROBE_SAMPLES
    bank.probed += 1
    return bank.probe if swing % 2 == 0 else -bank.probe


@compiled
def _torque_acted(estimator: Record) -> bool:
    for age in range(estimator.delay_periods, MAX_DELAY + 1):
        if estimator.in_flight[age] != 0.0:
            return True
    return False


@compiled
def _torque_steps(estimator: Record) -> float:
    """Return the sum of the last two steps of the torque that acted, without sign [N·m]."""
    steps = 0.0
    n = estimator.delay_periods
    for age in range(n, min(n + 2, MAX_DELAY)):
        steps += abs(estimator.in_flight[age] - estimator.in_flight[age + 1])
    return steps


@compiled
def _learn(bank: Record, estimator: Record) -> None:
    """Add what this sample tells; in return as much of what was known is forgotten."""
    r, information = bank.surprise, bank.information
    untimely = _UNTIMELY * _torque_steps(estimator) * bank.period * bank.period / bank.mass
    weight = 1.0 / (bank.noise + untimely * untimely)
    rest = r[0] + r[1] / bank.mass
    if weight * rest * rest > _UNEXPLAINED * _UNEXPLAINED:
        _doubt(bank)
    tells = weight * r[1] * r[1]
    share = 1.0
    if tells < (1.0 - _MEMORY) * information[1, 1]:
        share = tells / ((1.0 - _MEMORY) * information[1, 1])
    left = 1.0 - (1.0 - _MEMORY) * share
    for i in range(4):
        for c in range(4):
            information[i, c] = left * information[i, c] + weight * r[i] * r[c]


@compiled
def _doubt(bank: Record) -> None:
    """Forget of what is known: something happens that it does not explain."""
    for i in range(4):
        for c in range(4):
            bank.information[i, c] *= _DOUBTED


@compiled
def _follow(bank: Record) -> bool:
    """Move the mass in force towards the likeliest one; return True if it moved.

    The least squares of r₀ + r₁·(1/m) − r₂·(b/m) − r₃·c, with what is known before the first
    torque. c is of a hand whose force changes steadily.
    """
    lightest = _mass_at(bank, 0.0)
    s = bank.information
    # What goes on all the time is the hand's: r₃ is eliminated.
    r03, r13, r23 = s[0, 3], s[1, 3], s[2, 3]
    steady = s[3, 3] + 1.0 / _PRIOR_STEADY**2
    of_lightness = (lightest / _PRIOR_LIGHTNESS) ** 2
    of_rate = 1.0 / _PRIOR_RATE_DEVIATION**2
    p11, p12 = s[1, 1] - r13 * r13 / steady + of_lightness, -(s[1, 2] - r13 * r23 / steady)
    p22 = s[2, 2] - r23 * r23 / steady + of_rate
    q1 = -(s[0, 1] - r03 * r13 / steady) + of_lightness / lightest
    q2 = s[0, 2] - r03 * r23 / steady + of_rate * _PRIOR_RATE
    determinant = p11 * p22 - p12 * p12
    lightness = (q1 * p22 - q2 * p12) / determinant
    deviation = math.sqrt(p22 / determinant)
    bank.spread = deviation / max(lightness, deviation)
    step = _FOLLOWED * (_place_of(bank, lightness) - bank.place)
    bank.place += step
    bank.mass = _mass_at(bank, bank.place)
    believable = _place_of(bank, lightness + _BELIEVABLE * deviation)
    bank.least_mass = _mass_at(bank, min(believable, bank.place))
    return step != 0.0


@compiled
def _mass_at(bank: Record, place: float) -> float:
    return math.exp(bank.log_lightest + bank.log_step * place)


@compiled
def _place_of(bank: Record, lightness: float) -> float:
    """Return the place of the mass 1/lightness among the filters."""
    if lightness <= 0.0:
        return bank.count - 1.0
    place = (-math.log(lightness) - bank.log_lightest) / bank.log_step
    return min(max(place, 0.0), bank.count - 1.0)


@compiled
def _set_covariance(bank: Record, estimator: Record, i: int) -> None:
    """Give the estimator the gain and the covariance of filter i, for a gap of samples."""
    estimator.steady_covariance[:] = bank.covariance[i]
    estimator.transition[:] = bank.transition[i]
    estimator.scale[:] = bank.scale[i]
    estimator.force_noise = bank.force_noise[i]
    for c in range(3):
        estimator.steady_gain[c] = estimator.gain[c] = bank.gain[c, i]


@compiled
def predict_bank(bank: Record, estimator: Record, force: float) -> None:
    """Advance all filters to the next sample; call before `predict` of the estimator.

    force: as in `predict`.
    """
    n = estimator.delay_periods
    older = estimator.in_flight[n]
    newer = force if n == 0 else estimator.in_flight[n - 1]
    _predict_observer(bank, older, newer)
    state, phi = bank.state, bank.phi
    for i in range(bank.count):
        y, v, d = state[0, i], state[1, i], state[2, i]
        a, b = older + d, newer + d
        state[0, i] = phi[0, i] * y + phi[1, i] * v + bank.older[0, i] * a + bank.newer[0, i] * b
        state[1, i] = phi[2, i] * y + phi[3, i] * v + bank.older[1, i] * a + bank.newer[1, i] * b
