"""State at the instant of actuation: a Kalman filter on [y, ẏ, d] and the forces in flight.

The force computed from the sample y[j] takes effect D periods later, and all forces up to then are
already in flight. So the state at that instant is computed, not extrapolated:
x̂[j+1] = Φ·x̂[j] + Γ·(f + d̂) for each period up to j+D. The bias force d̂ makes the operator's push
observable, so it need not be known.
"""

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.physics import zoh, zoh_coefficients

#: Largest delay, in whole periods, between a sample and the force computed from it.
MAX_DELAY = 3
#: Number of forces that are kept: those in flight, and before the one that acts the two last steps.
FORCES_KEPT = MAX_DELAY + 3

#: Periods without a sample after which the prediction says nothing about a hand's motion: the
#: estimate starts again, and its uncertainty grows no further.
_LONGEST_GAP = 32
#: Relative distance within which a gain has converged to the steady state.
_SETTLED = 1e-6
#: Variance of a quantised position [count²].
_QUANTISATION = 1.0 / 12.0


_HOLD = [("duration", "f8"), ("phi", "f8", (2, 2)), ("gamma", "f8", (2,))]

#: Filter and model of one wall. An actuation at δ·T after the sample, δ the fraction of D, cuts a
#: period in two: `before` and `after` are the hold equivalents over its parts, `full` over all.
ESTIMATOR = np.dtype(
    [
        ("y", "f8"),
        ("v", "f8"),
        ("d", "f8"),
        ("gain", "f8", (3,)),
        # In the steady state the gain is `steady_gain`. Otherwise it follows from the covariance
        # of [y, ẏ, d] before the sample, which is in units of `scale`, as its model is.
        ("settled", "?"),
        ("gap", "i8"),  # periods without a sample since the last one, `sampled`
        ("sampled", "f8"),
        ("covariance", "f8", (3, 3)),
        ("steady_gain", "f8", (3,)),
        ("steady_covariance", "f8", (3, 3)),
        ("transition", "f8", (3, 3)),
        ("force_noise", "f8"),
        ("scale", "f8", (3,)),
        ("mass", "f8"),
        ("viscous", "f8"),
        ("coulomb", "f8"),
        ("delay_periods", "i8"),
        ("told", "f8"),  # D as told, without what the model has added to it [periods]
        ("full", _HOLD, (1,)),
        ("before", _HOLD, (1,)),
        ("after", _HOLD, (1,)),
        # The state predicted since `start_open_loop` by the forces alone.
        ("open_loop_y", "f8"),
        ("open_loop_v", "f8"),
        ("open_loop_d", "f8"),
        # Forces of the last samples, newest first: in_flight[0] was computed one sample ago. The
        # oldest ones have acted.
        ("in_flight", "f8", (FORCES_KEPT,)),
    ],
    align=True,
)


class KalmanModel(NamedTuple):
    """Model and steady state of the filter on [y, ẏ, d], in units of `scale`.

    Attributes:
        transition: Transition over one period, shape (3, 3).
        force_noise: Variance that the bias force gains in one period.
        covariance: Covariance before a sample in the steady state, shape (3, 3).
        gain: Gain in the steady state, in SI units, shape (3,).
        scale: The units in SI units, shape (3,).
    """

    transition: NDArray[np.float64]
    force_noise: float
    covariance: NDArray[np.float64]
    gain: NDArray[np.float64]
    scale: NDArray[np.float64]


@functools.lru_cache(maxsize=1024)  # a bank has up to six a filter; a sweep sets it often
def kalman_model(
    mass: float, viscous: float, spring: float, period: float, count: float, force_walk: float
) -> KalmanModel:
    """Return the Kalman filter on [y, ẏ, d] for a quantised position.

    The position is quantised in steps of `count`, so R = count²/12. The bias force is a random
    walk of `force_walk` = q [N·m/√s]. For a pure mass the continuous filter then has Butterworth
    poles at ω = (q²/(m²·R·T))^(1/6): one setting follows a light handle faster than a heavy one,
    as their noise allows.
    """
    phi, gamma = zoh(mass, viscous, spring, period)
    a = np.eye(3)
    a[:2, :2] = phi
    a[:2, 2] = gamma
    # In units of the count, and of the velocity and the force that go with it at the filter's
    # bandwidth, the covariances are of one order, and the Riccati solver keeps its digits.
    omega = bandwidth_of(force_walk, mass, period, count)
    scale = np.array([count, count * omega, count * mass * omega * omega])
    a = a * scale[None, :] / scale[:, None]
    force_noise = period * (force_walk / scale[2]) ** 2
    noise = np.diag([0.0, 0.0, force_noise])
    prior, gain = _steady_state(a, noise)
    return KalmanModel(a, force_noise, prior, gain * scale / count, scale)


@functools.lru_cache(maxsize=1024)
def gain_with_trend(
    mass: float, viscous: float, spring: float, period: float, bandwidth: float
) -> tuple[float, float, float, float]:
    """Return the gain of the Kalman filter on [y, ẏ, d, ḋ] for a quantised position.

    The bias force d is a random walk as in `kalman_model`, of ω = `bandwidth` [rad/s]; its rate of
    change is one of its own, of ω times that q. What a steady change does is thus no error, where
    the filter on [y, ẏ, d] is behind by 2·ḋ/ω in d, 2·ḋ/(m·ω²) in ẏ and ḋ/(m·ω³) in y.
    """
    phi, gamma = zoh(mass, viscous, spring, period)
    a = np.eye(4)
    a[:2, :2] = phi
    a[:2, 2] = gamma
    a[:2, 3] = 0.5 * period * gamma
    a[2, 3] = period
    scale = np.array([1.0, bandwidth, mass * bandwidth**2, mass * bandwidth**3])
    a = a * scale[None, :] / scale[:, None]
    walk = _QUANTISATION * (bandwidth * period) ** 2
    noise = np.diag([0.0, 0.0, walk, walk])
    _, gain = _steady_state(a, noise)
    return tuple((gain * scale).tolist())


def _steady_state(
    transition: NDArray[np.float64], noise: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the covariance before a sample and the gain, with the position first, in counts."""
    from scipy.linalg import solve_discrete_are  # a tenth of a second: not for a drive alone

    c = np.eye(1, len(transition))
    prior = solve_discrete_are(transition.T, c.T, noise, np.array([[_QUANTISATION]]))
    return prior, prior[:, 0] / (prior[0, 0] + _QUANTISATION)


def force_walk_of(bandwidth: float, mass: float, period: float, count: float) -> float:
    """Return the walk q of a force [N·m/√s] that gives the filter this bandwidth [rad/s].

    See `kalman_model`, of which it is the inverse for a pure mass.
    """
    return bandwidth**3 * mass * count * math.sqrt(_QUANTISATION * period)


def bandwidth_of(force_walk: float, mass: float, period: float, count: float) -> float:
    """Return the bandwidth [rad/s] of the filter with this walk of a force [N·m/√s]."""
    variance = _QUANTISATION * mass * mass * count * count * period
    return float((force_walk**2 / variance) ** (1.0 / 6.0))


def set_estimator(
    estimator: NDArray[np.void],
    mass: float,
    viscous: float,
    spring: float,
    coulomb: float,
    period: float,
    count: float,
    force_walk: float,
    delay: float,
    margin: float = 0.0,
) -> None:
    """Write model, gain and delay D (in periods, 0 ≤ D ≤ MAX_DELAY) into an ESTIMATOR array (1,).

    count and force_walk are those of `kalman_model`; the loop is quicker than D by `margin`.
    Raises ValueError for a delay out of range.
    """
    if not 0.0 <= delay <= MAX_DELAY:
        raise ValueError(f"a delay of {delay:g} periods is not between 0 and {MAX_DELAY}")
    whole = math.floor(delay)
    fraction = delay - whole
    estimator["delay_periods"], estimator["told"] = whole, delay - margin
    estimator["mass"], estimator["viscous"] = mass, viscous
    estimator["coulomb"] = coulomb
    kalman = kalman_model(mass, viscous, spring, period, count, force_walk)
    estimator["transition"], estimator["force_noise"] = kalman.transition, kalman.force_noise
    estimator["steady_covariance"], estimator["steady_gain"] = kalman.covariance, kalman.gain
    estimator["scale"] = kalman.scale
    for name, share in (("full", 1.0), ("before", fraction), ("after", 1.0 - fraction)):
        phi, gamma = zoh(mass, viscous, spring, share * period)
        estimator[name]["duration"] = share * period
        estimator[name]["phi"] = phi
        estimator[name]["gamma"] = gamma


def reset_estimator(estimator: NDArray[np.void], y: float) -> None:
    """Start in the steady state at rest at y, with no bias force and no force in flight."""
    estimator["settled"], estimator["gap"] = True, 0
    estimator["gain"] = estimator["steady_gain"]
    estimator["y"] = estimator["sampled"] = y
    estimator["v"] = estimator["d"] = 0.0
    estimator["in_flight"] = 0.0


@compiled
def set_model(estimator: Record, mass: float, viscous: float, spring: float) -> None:
    """Exchange the model of the motion; gain and covariance stay."""
    estimator.mass, estimator.viscous = mass, viscous
    _set_hold(estimator.full[0], mass, viscous, spring)
    _set_hold(estimator.before[0], mass, viscous, spring)
    _set_hold(estimator.after[0], mass, viscous, spring)


@compiled
def set_model_delay(estimator: Record, delay: float) -> None:
    """Exchange the delay D of the model [periods]; call `set_model` after it."""
    whole = int(delay)
    period = estimator.full[0].duration
    estimator.delay_periods = whole
    estimator.before[0].duration = (delay - whole) * period
    estimator.after[0].duration = (1.0 - delay + whole) * period


@compiled
def _set_hold(hold: Record, mass: float, viscous: float, spring: float) -> None:
    p11, p12, p21, p22, c1, c2 = zoh_coefficients(mass, viscous, spring, hold.duration)
    hold.phi[0, 0], hold.phi[0, 1], hold.phi[1, 0], hold.phi[1, 1] = p11, p12, p21, p22
    hold.gamma[0], hold.gamma[1] = c1, c2


@compiled
def _hold(
    estimator: Record, model: Record, y: float, v: float, force: float
) -> tuple[float, float]:
    phi, gamma = model.phi, model.gamma
    if model.duration > 0.0:
        # Coulomb friction opposes the motion and at the most stops it: at rest it balances any
        # pull, and d̂ takes that up.
        stopping = estimator.mass * v / model.duration
        force -= min(max(stopping, -estimator.coulomb), estimator.coulomb)
    return (
        phi[0, 0] * y + phi[0, 1] * v + gamma[0] * force,
        phi[1, 0] * y + phi[1, 1] * v + gamma[1] * force,
    )


@compiled
def correct(estimator: Record, y_sample: float) -> None:
    """Correct the state with the sample y[j]: x̂[j|j] = x̂[j|j−1] + L·(y[j] − ŷ[j|j−1])."""
    if not estimator.settled:
        _correct_covariance(estimator)
    if estimator.gap > _LONGEST_GAP:
        pause = (1 + estimator.gap) * estimator.full[0].duration
        estimator.v = (y_sample - estimator.sampled) / pause
        estimator.y = y_sample
    estimator.gap = 0
    estimator.sampled = y_sample
    innovation = y_sample - estimator.y
    estimator.y += estimator.gain[0] * innovation
    estimator.v += estimator.gain[1] * innovation
    estimator.d += estimator.gain[2] * innovation


@compiled
def note_missing_sample(estimator: Record) -> None:
    """Leave the steady state, for a period without a sample; call instead of `correct`."""
    if estimator.settled:
        estimator.settled = False
        estimator.covariance[:] = estimator.steady_covariance
    estimator.gap += 1


@compiled
def settle_within(estimator: Record, share: float) -> bool:
    """Return to the steady state if the gain is within a share of its own; True if it is there."""
    for i in range(3):
        steady = estimator.steady_gain[i]
        if not abs(estimator.gain[i] - steady) <= share * abs(steady):
            return False
    estimator.settled = True
    estimator.gain[:] = estimator.steady_gain
    return True


@compiled
def _correct_covariance(estimator: Record) -> None:
    """Set the gain of a sample, L = P·cᵀ/(c·P·cᵀ + R), and the covariance P − L·c·P after it."""
    p, scale = estimator.covariance, estimator.scale
    yy, yv, yd = p[0, 0], p[0, 1], p[0, 2]
    variance = yy + _QUANTISATION
    for i, covariance in enumerate((yy, yv, yd)):
        estimator.gain[i] = covariance / variance * (scale[i] / scale[0])
    if estimator.gap == 0 and settle_within(estimator, _SETTLED):
        return
    # In the first row (1 − L)·P = R/(c·P·cᵀ + R)·P, without a difference that loses digits.
    left = _QUANTISATION / variance
    p[0, 0], p[0, 1], p[0, 2] = left * yy, left * yv, left * yd
    p[1, 1] -= yv * yv / variance
    p[1, 2] -= yv * yd / variance
    p[2, 2] -= yd * yd / variance
    p[1, 0], p[2, 0], p[2, 1] = p[0, 1], p[0, 2], p[1, 2]


@compiled
def _predict_covariance(estimator: Record) -> None:
    """Advance the covariance to the next sample, A·P·Aᵀ + Q."""
    a, p = estimator.transition, estimator.covariance
    for k in range(3):
        y, v, d = p[0, k], p[1, k], p[2, k]
        p[0, k] = a[0, 0] * y + a[0, 1] * v + a[0, 2] * d
        p[1, k] = a[1, 0] * y + a[1, 1] * v + a[1, 2] * d
    for i in range(3):
        y, v, d = p[i, 0], p[i, 1], p[i, 2]
        p[i, 0] = a[0, 0] * y + a[0, 1] * v + a[0, 2] * d
        p[i, 1] = a[1, 0] * y + a[1, 1] * v + a[1, 2] * d
    p[2, 2] += estimator.force_noise


@compiled
def actuation_state(estimator: Record) -> tuple[float, float]:
    """Return the state (ŷ, ẏ̂) at the instant at which the force computed now takes effect."""
    n = estimator.delay_periods
    y, v = _hold(
        estimator,
        estimator.before[0],
        estimator.y,
        estimator.v,
        estimator.in_flight[n] + estimator.d,
    )
    for age in range(n - 1, -1, -1):
        y, v = _hold(estimator, estimator.full[0], y, v, estimator.in_flight[age] + estimator.d)
    return y, v


@compiled
def _over_period(
    estimator: Record, y: float, v: float, d: float, force: float
) -> tuple[float, float]:
    """Return the state at the next sample under the forces in flight, `force` the newest."""
    n = estimator.delay_periods
    y, v = _hold(estimator, estimator.before[0], y, v, estimator.in_flight[n] + d)
    later = force if n == 0 else estimator.in_flight[n - 1]
    return _hold(estimator, estimator.after[0], y, v, later + d)


@compiled
def predict(estimator: Record, force: float) -> None:
    """Put `force` in flight and advance the state to the next sample, x̂[j+1|j].

    `force` is what the drive will apply, after saturation and rounding to its unit.
    """
    if not estimator.settled and estimator.gap < _LONGEST_GAP:
        _predict_covariance(estimator)
    estimator.y, estimator.v = _over_period(estimator, estimator.y, estimator.v, estimator.d, force)
    put_in_flight(estimator.in_flight, force)


@compiled
def unit_motion(
    in_flight: NDArray[np.float64], force: float, delay: float, period: float
) -> tuple[float, float, float, float]:
    """Return way and speed of a unit mass by the forces of a period, and what a later one changes.

    in_flight: newest first, at the end of the period `force` will be, too. delay: D in periods, at
    which they act; a force that is later by δ periods adds δ times the last two.
    """
    n = int(delay)
    share = delay - n
    rest = 1.0 - share
    older = in_flight[n]
    newer = force if n == 0 else in_flight[n - 1]
    t = period
    way = t * t * (share * (1.0 - 0.5 * share) * older + 0.5 * rest * rest * newer)
    speed = t * (share * older + rest * newer)
    return way, speed, t * t * rest * (older - newer), t * (older - newer)


@compiled
def put_in_flight(in_flight: NDArray[np.float64], force: float) -> None:
    """Put the newest force before those that are kept, shape (FORCES_KEPT,)."""
    for age in range(FORCES_KEPT - 1, 0, -1):
        in_flight[age] = in_flight[age - 1]
    in_flight[0] = force


#: Rounding of a delay [periods].
_ROUNDING = 1e-9


@compiled
def stand_still(estimator: Record, periods: int) -> None:
    """Advance the state over periods without SYNC, in which the drive goes on as it did.

    A torque that waits for a SYNC waits on; one that has taken effect stays.
    """
    # (1 + 0.15) − 0.15 is less than 1.
    force = estimator.in_flight[int(estimator.told + _ROUNDING)]
    for _ in range(min(periods, _LONGEST_GAP + 1)):
        note_missing_sample(estimator)
        if estimator.gap < _LONGEST_GAP:
            _predict_covariance(estimator)
        estimator.y, estimator.v = _hold(
            estimator, estimator.full[0], estimator.y, estimator.v, force + estimator.d
        )
    estimator.gap += max(0, periods - _LONGEST_GAP - 1)


@compiled
def may_lag(estimator: Record) -> bool:
    """Return True if the forces in flight suffice for samples that are a period older."""
    if estimator.told + 1.0 > MAX_DELAY:
        return False
    whole = estimator.delay_periods + 1
    return whole < MAX_DELAY or (whole == MAX_DELAY and estimator.before[0].duration == 0.0)


@compiled
def start_lagging(lagging: Record, force: float) -> None:
    """Turn a copy of the estimator from before a sample that is missing into one that lags.

    It takes the sample that was missing for the next one, and all later samples likewise: D is a
    period longer. force: as in `predict`, from the period without a sample.
    """
    lagging.delay_periods += 1
    lagging.told += 1.0
    put_in_flight(lagging.in_flight, force)


@compiled
def end_lag(estimator: Record) -> None:
    """Advance an estimator whose samples lag by a period, as the next one does no longer."""
    estimator.delay_periods -= 1
    estimator.told -= 1.0
    note_missing_sample(estimator)
    if estimator.gap < _LONGEST_GAP:
        _predict_covariance(estimator)
    n = estimator.delay_periods
    y, v, d = estimator.y, estimator.v, estimator.d
    before = estimator.in_flight[n + 1]
    y, v = _hold(estimator, estimator.before[0], y, v, before + d)
    estimator.y, estimator.v = _hold(
        estimator, estimator.after[0], y, v, estimator.in_flight[n] + d
    )


@compiled
def unexplained(one: Record, other: Record, y_sample: float) -> float:
    """Return the smaller square of what two estimators do not expect of a sample [rad²]."""
    return min((y_sample - one.y) ** 2, (y_sample - other.y) ** 2)


@compiled
def likelier(one: Record, other: Record, y_sample: float, noise: float) -> float:
    """Return by how much a sample is likelier for one estimator than for the other, bounded.

    It is the difference of their logarithmic likelihoods, with the larger variance of both: an
    estimator that has lost a sample is not the less likely for being less certain, which would
    decide where the handle stands still. Where neither explains the motion, as in a blow, the
    variance is `noise` [rad²]: one that is far off, and right by chance, is not the likelier.
    Call before `correct`.
    """
    variance = max(_sample_variance(one), _sample_variance(other), noise)
    return _misfit(other, y_sample, variance) - _misfit(one, y_sample, variance)


@compiled
def _sample_variance(estimator: Record) -> float:
    p = estimator.steady_covariance if estimator.settled else estimator.covariance
    return (p[0, 0] + _QUANTISATION) * estimator.scale[0] ** 2


@compiled
def _misfit(estimator: Record, y_sample: float, variance: float) -> float:
    """Return minus the logarithm of a sample's likelihood, but for a constant.

    The distribution is Cauchy's: no model knows the hand so well that a sample is impossible, and
    none that is far off decides alone.
    """
    innovation = y_sample - estimator.y
    return math.log1p(innovation * innovation / variance)


@compiled
def start_open_loop(estimator: Record) -> None:
    """Start a prediction without corrections at the present state; call before `correct`."""
    estimator.open_loop_y, estimator.open_loop_v = estimator.y, estimator.v
    estimator.open_loop_d = estimator.d


@compiled
def predict_open_loop(estimator: Record, force: float) -> None:
    """Advance the open-loop state to the next sample; call before `predict`."""
    estimator.open_loop_y, estimator.open_loop_v = _over_period(
        estimator, estimator.open_loop_y, estimator.open_loop_v, estimator.open_loop_d, force
    )


@compiled
def acting_force(estimator: Record, in_flight: NDArray[np.float64]) -> float:
    """Return the mean from this sample to the next of forces in flight; call after `predict`.

    They act at the delay as told: what is found of it in the motion is for the model alone.
    in_flight: as `ESTIMATOR` has them, newest first, or a part of them.
    """
    n = int(estimator.told)
    share = estimator.told - n
    force = in_flight[n]
    if share > 0.0:
        force = share * in_flight[n + 1] + (1.0 - share) * force
    return force
