"""The operator identified in the cycle: a bank of steady-state Kalman filters over the mass.

Each filter believes in another hand at the handle. Under the wall's torques their residuals tell
which one is right; in free motion all agree, and nothing is learned (theory, section 8). State and
mass in force are interpolated between the two filters next to the likeliest mass. Coulomb friction
is left to the bias force d̂: a bank that believes in friction which is not there fails.

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

#: Number of samples over which the handle has to move for its motion to tell a mass.
_RECENT = 4
#: Its least motion over these samples [counts].
_MOVED = 2.0

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
        ("variance", "f8", (MAX_FILTERS,)),  # of the innovation [rad²]
        ("covariance", "f8", (MAX_FILTERS, 3, 3)),
        ("transition", "f8", (MAX_FILTERS, 3, 3)),
        ("scale", "f8", (MAX_FILTERS, 3)),
        ("force_noise", "f8", (MAX_FILTERS,)),
        # Evidence against each filter; place of the mass in force on the scale of their numbers.
        ("cost", "f8", (MAX_FILTERS,)),
        ("residual", "f8", (MAX_FILTERS,)),
        ("place", "f8"),
        ("samples", "f8", (_RECENT,)),  # the last ones, newest first [rad]
        ("at_rest", "i8"),  # samples without torque in a row
        ("forgotten", "i8"),  # of those after which the hand may be another one
        ("mass", "f8"),
        ("least_mass", "f8"),  # lightest that is believable
        ("approach", "f8"),  # speed of the approach to the present contact [rad/s]
        ("spread", "f8"),  # standard deviation of ln(mass), as far as the residuals tell
    ],
    align=True,
)

#: Evidence against the heavier ones of two filters at the beginning: it is safe to begin light.
_PRIOR = 0.1
#: Least difference of the residuals that tells [counts].
_TELLING = 0.3
#: Share of the evidence that is left after a sample that tells.
_MEMORY = 0.995
#: Normalised square of a residual from which on it counts less: the model is wrong, not the noise.
_OUTLIER = 25.0
#: Time without torque after which another hand may be at the handle [s].
_FORGOTTEN_S = 0.2
#: Evidence against a filter, beyond that against the best one, up to which it may be right: three
#: standard deviations.
_BELIEVABLE = 9.0
#: Ratio of the mass in force to the lightest believable one from which on a push is bounded.
_CERTAIN = 1.3
#: Share of the speed of approach with which a hand of uncertain mass may be returned.
_RETURNED = 0.9
#: Share of the way to the likeliest mass that is gone in a period.
_FOLLOWED = 0.6
#: Power of the mass with which the walk of a hand's force falls. What the steps of the encoder make
#: felt at the handle grows with mass and bandwidth; so it stays below what is felt for all.
_STEADINESS = 0.8
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
    bank["viscous"][0, :n] = viscous
    for i in range(n):
        walk = force_walk * float(masses[0] / masses[i]) ** _STEADINESS
        model = kalman_model(masses[i], viscous[i], spring, period, count, walk)
        _set_filter(bank[0], i, model, abs(count))
        phi, _ = zoh(masses[i], viscous[i], spring, period)
        _, before = zoh(masses[i], viscous[i], spring, fraction * period)
        phi_after, after = zoh(masses[i], viscous[i], spring, (1.0 - fraction) * period)
        bank["phi"][0, :, i] = phi.ravel()
        bank["older"][0, :, i] = phi_after @ before
        bank["newer"][0, :, i] = after


def _set_filter(bank: np.void, i: int, model: KalmanModel, count: float) -> None:
    bank["gain"][:, i] = model.gain
    bank["variance"][i] = (model.covariance[0, 0] + 1.0 / 12.0) * count * count
    bank["covariance"][i], bank["transition"][i] = model.covariance, model.transition
    bank["scale"][i], bank["force_noise"][i] = model.scale, model.force_noise


def reset_bank(bank: NDArray[np.void], y: float) -> None:
    """Begin at rest at y with the lightest hand."""
    bank["state"] = 0.0
    bank["state"][:, 0] = y
    bank["residual"] = 0.0
    bank["cost"] = _PRIOR * np.arange(MAX_FILTERS)
    bank["place"] = 0.0
    bank["samples"] = y
    bank["at_rest"] = 0
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
        return False
    residual = bank.residual
    least, most = math.inf, -math.inf
    for i in range(n):
        residual[i] = y_sample - state[0, i]
        least, most = min(least, residual[i]), max(most, residual[i])
        state[0, i] += gain[0, i] * residual[i]
        state[1, i] += gain[1, i] * residual[i]
        state[2, i] += gain[2, i] * residual[i]
    changed = False
    moved = _moved(bank, y_sample)
    if _torque_acted(estimator):
        bank.at_rest = 0
        if moved and most - least > _TELLING * bank.resolution:
            _learn(bank)
            changed = _follow(bank)
    else:
        bank.at_rest += 1
        bank.approach = max(-estimator.v, 0.0)
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
def _moved(bank: Record, y_sample: float) -> bool:
    """Return True if the handle has moved: at rest friction holds it, as if it were heavy."""
    moved = abs(y_sample - bank.samples[_RECENT - 1]) > _MOVED * bank.resolution
    for age in range(_RECENT - 1, 0, -1):
        bank.samples[age] = bank.samples[age - 1]
    bank.samples[0] = y_sample
    return moved


@compiled
def _forget(bank: Record) -> bool:
    """Begin with the lightest hand again; return True if another one was in force."""
    for i in range(bank.count):
        bank.cost[i] = _PRIOR * i
    changed = bank.place != 0.0
    bank.place, bank.spread = 0.0, 0.0
    bank.mass = bank.least_mass = math.exp(bank.log_lightest)
    return changed


@compiled
def bounded_push(bank: Record, wall: Record, force: float) -> float:
    """Return a force that throws back no hand that may be at the handle faster than it came in."""
    if bank.mass <= _CERTAIN * bank.least_mass:
        return force
    outwards = _RETURNED * bank.approach - wall.v
    return min(force, max(0.0, outwards * bank.least_mass / wall.period - wall.d))


@compiled
def _torque_acted(estimator: Record) -> bool:
    for age in range(estimator.delay_periods, MAX_DELAY + 1):
        if estimator.in_flight[age] != 0.0:
            return True
    return False


@compiled
def _learn(bank: Record) -> None:
    """Add the evidence of the residuals, J ← 0.995·J + e with e = r²/S up to a bound."""
    for i in range(bank.count):
        e = bank.residual[i] * bank.residual[i] / bank.variance[i]
        if e > _OUTLIER:
            e = _OUTLIER - math.sqrt(_OUTLIER) + math.sqrt(e)
        bank.cost[i] = _MEMORY * bank.cost[i] + e


@compiled
def _follow(bank: Record) -> bool:
    """Move the mass in force towards the likeliest one; return True if it moved."""
    cost, n = bank.cost, bank.count
    best = 0
    for i in range(1, n):
        if cost[i] < cost[best]:
            best = i
    k = min(max(best, 1), n - 2)
    # The parabola through three costs, a·(x − x*)²; a deviation of one unit is a standard one.
    a = 0.5 * (cost[k - 1] + cost[k + 1]) - cost[k]
    likeliest = float(best)
    if a > 0.0:
        vertex = k - 0.25 * (cost[k + 1] - cost[k - 1]) / a
        likeliest = min(max(vertex, best - 0.5), best + 0.5)
    likeliest = min(max(likeliest, 0.0), n - 1.0)
    bank.spread = bank.log_step * min(1.0 / math.sqrt(a), n - 1.0) if a > 0.0 else 0.0
    step = _FOLLOWED * (likeliest - bank.place)
    bank.place += step
    bank.mass = math.exp(bank.log_lightest + bank.log_step * bank.place)
    believable = 0
    while believable < best and cost[believable] > cost[best] + _BELIEVABLE:
        believable += 1
    bank.least_mass = math.exp(bank.log_lightest + bank.log_step * min(believable, bank.place))
    return step != 0.0


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
    state, phi = bank.state, bank.phi
    for i in range(bank.count):
        y, v, d = state[0, i], state[1, i], state[2, i]
        a, b = older + d, newer + d
        state[0, i] = phi[0, i] * y + phi[1, i] * v + bank.older[0, i] * a + bank.newer[0, i] * b
        state[1, i] = phi[2, i] * y + phi[3, i] * v + bank.older[1, i] * a + bank.newer[1, i] * b
