"""Operator and delay identified in the cycle: a bank of steady-state Kalman filters over the mass.

State and model in force are interpolated between the two filters next to the mass that a regression
finds (`regression`), at the delay that it finds. The gains of the filters are made beforehand
(`bank_gains`); stiffness and motion decide which of them are in force (`bank_pace`). A handle that
sticks is known to rest (`bank_rest`). The filters of light hands also follow how fast the push
changes (`bank_trend`). Coulomb friction is left to the bias force d̂ (docs/laws.md). A hand that is
known has a bank of one filter: it holds its mass, and finds the delay.

The bank works on an estimator in its steady state and hands over state and model to it. In a gap
of samples, and until the estimator has nearly settled again, the estimator goes on alone and the
bank follows it.
"""

import math

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.walls.bank_gains import PACES, QUICKER, STEADIEST, set_filters, stiffest_walls
from canwall.walls.bank_pace import is_lively
from canwall.walls.bank_rest import bound_velocity, hold_torque, note_rest, reset_rest, set_rest
from canwall.walls.bank_trend import (
    correct_in_flight,
    follow_trend,
    follows_trend,
    note_flight,
    reset_trend,
    set_trend,
    trend_left,
)
from canwall.walls.estimator import MAX_DELAY, set_model, set_model_delay, settle_within
from canwall.walls.least_squares import KNOWN_SPREAD, solve
from canwall.walls.probe import (
    PROBE,
    probe_torque,
    reset_probe,
    send_probe,
    set_probe,
)
from canwall.walls.regression import (
    OBSERVER_SLOWER_BEHIND_SHAFT,
    REGRESSION,
    begin_regression,
    comes,
    forget_mass,
    learn,
    predict_regression,
    reset_regression,
    set_regression,
    torque_rises,
)
from canwall.walls.shaft import ElasticShaft

#: Largest number of filters.
MAX_FILTERS = 24

#: A bank, in the order of the masses. Gains, covariances and transitions are made beforehand:
#: nothing of a Riccati equation is left for the cycle.
BANK = np.dtype(
    [
        ("holds", "?"),  # the mass in force, whatever is learned meanwhile; nothing is probed
        ("count", "i8"),  # of the filters; 0: no bank
        ("log_lightest", "f8"),
        ("log_step", "f8"),
        ("spring", "f8"),
        ("viscous", "f8", (MAX_FILTERS,)),
        # [y, ẏ, d] of each filter, and its gain.
        ("state", "f8", (3, MAX_FILTERS)),
        ("gain", "f8", (3, MAX_FILTERS)),
        # How fast d changes [N·m/s], as filters of light hands find it in flight and while the hand
        # begins to press; their gain in flight and, over that of d, in contact [1/s], zero: those
        # of heavier ones; what is left of it after a period under the torque of a stiff wall if the
        # handle came slowly, and after any other period.
        ("trend", "f8", (MAX_FILTERS,)),
        ("gain_in_flight", "f8", (4, MAX_FILTERS)),
        ("trend_gain", "f8", (MAX_FILTERS,)),
        ("trend_left_pressed", "f8"),
        ("trend_left", "f8"),
        # Stiffness in force, of the softest wall that counts as stiff, and True if the former does;
        # position of the wall's surface.
        ("stiffness", "f8"),
        ("stiff_from", "f8"),
        ("stiff", "?"),
        ("surface", "f8"),
        # Samples since the wall gave a torque, the number from which on that is a flight, and True
        # in the flight of a handle that moves.
        ("alone", "i8"),
        ("flight", "i8"),
        ("flies", "?"),
        # True if the handle came slowly from its last flight. Samples since then and those in a row
        # under the wall's torque, the most of the former for a hand that begins to press, and True
        # while it does.
        ("came_slowly", "?"),
        ("landed", "i8"),
        ("pressed", "i8"),
        ("landing", "i8"),
        ("presses", "?"),
        # Gains, `with_velocity` and `equal_samples` for softer and softer walls, each half as stiff
        # as the one before, and for a handle that moves, as parabolas over the bandwidth relative
        # to that for the delay as told; stiffness of the first, numbers of those in force, of
        # filters whose noise is felt and of the others, and that relative bandwidth.
        ("paces", "f8", (len(QUICKER), PACES + 1, 6, MAX_FILTERS)),
        ("steadiest", "f8"),
        ("pace", "i8"),
        ("light_pace", "i8"),
        ("quicker", "f8"),
        # Samples since the handle moved, the number of those for which filters whose noise is felt
        # follow it quickly, and the number from which on it is calm, up to which others do.
        ("moved", "i8"),
        ("lively", "i8"),
        ("calm", "i8"),
        # What a correction of the velocity says of position and force, and the number of equal
        # samples from which on there is one.
        ("with_velocity", "f8", (2, MAX_FILTERS)),
        ("equal_samples", "f8", (MAX_FILTERS,)),
        # Of what a sample differs from the prediction, the part that contradicts nothing, and the
        # part beyond which the gain is another one: on the way to the quickest one by this share.
        ("within", "f8", (MAX_FILTERS,)),
        ("far", "f8"),
        ("far_gain", "f8", (3, MAX_FILTERS)),
        ("far_share", "f8", (MAX_FILTERS,)),
        # Square of the motion by a torque whose step of 1 N·m is not when it should be, up to the
        # sample, over the variance of a reading.
        ("untimely", "f8", (MAX_FILTERS,)),
        ("sampled", "f8"),
        ("equal", "i8"),  # samples in a row up to now
        # The sample at which the handle stuck last, and samples since then and since it broke loose
        # or moved; their numbers: equal ones of a handle that sticks, those within which it breaks
        # loose, and those for which it settles.
        ("stuck_at", "f8"),
        ("since_stuck", "i8"),
        ("since_loose", "i8"),
        ("sticks", "i8"),
        ("breaks_loose", "i8"),
        ("settles", "i8"),
        # Number of equal samples from which on the torque may be held, and that torque; 0: none.
        ("holds_from", "i8"),
        ("held", "f8"),
        # Over a period: Φ row by row, and the effects on (y, ẏ) of the older force, which acts up
        # to the instant of actuation, and of the newer one.
        ("phi", "f8", (4, MAX_FILTERS)),
        ("older", "f8", (2, MAX_FILTERS)),
        ("newer", "f8", (2, MAX_FILTERS)),
        # Both as parabolas over the share of the period before that instant, c₀ + c₁·s + c₂·s².
        ("older_by_share", "f8", (3, 2, MAX_FILTERS)),
        ("newer_by_share", "f8", (3, 2, MAX_FILTERS)),
        # D as told, with the margin of the filters, and as it is in force [periods].
        ("told", "f8"),
        ("delay", "f8"),
        ("delay_in_force", "f8"),
        ("age", "f8"),  # of the sample, beyond the mean, for which torques are in force
        # Models for an estimator that loses samples.
        ("steady_gain", "f8", (3, MAX_FILTERS)),
        ("covariance", "f8", (MAX_FILTERS, 3, 3)),
        ("transition", "f8", (MAX_FILTERS, 3, 3)),
        ("scale", "f8", (MAX_FILTERS, 3)),
        ("force_noise", "f8", (MAX_FILTERS,)),
        # The stiffest wall that an elastic shaft bears, or delay and encoder on a rigid one.
        ("stiffest", "f8", (MAX_FILTERS,)),
        ("delay_counts", "f8", (MAX_FILTERS,)),  # share of the doubt about the delay that counts
        ("regression", REGRESSION, (1,)),
        ("probe", PROBE, (1,)),
        # Place of the mass in force on the scale of the filters' numbers.
        ("place", "f8"),
        ("at_rest", "i8"),  # samples without torque in a row
        ("forgotten", "i8"),  # of those after which the hand may be another one
        ("mass", "f8"),
        ("known", "?"),  # the mass has been found, and is not another hand's
        ("spread", "f8"),  # standard deviation of ln(mass), as far as the residuals tell
    ],
    align=True,
)

#: Share of its gain within which the estimator has nearly settled: meanwhile nothing is identified.
_NEARLY_SETTLED = 0.01
#: Time without torque after which another hand may be at the handle [s].
_FORGOTTEN_S = 0.2
#: Share of the way to the likeliest mass that is gone in a period.
_FOLLOWED = 0.6
#: Deviation of ln(mass) below which the mass counts as found.
_FOUND_SPREAD = 0.2
#: Lightest mass that explains the motion of a hand that is known, over the one told.
_KNOWN_LIGHTEST = 0.5
#: Growth in a period of ln(mass) once it was known and no longer is, while the torque rises: a hand
#: that lets go within milliseconds looks heavy, since the wall gives way and nothing moves, and the
#: handle would be thrown.
_GROWTH_IN_DOUBT = 0.1


def set_bank(
    bank: NDArray[np.void],
    masses: NDArray[np.float64],
    viscous: NDArray[np.float64],
    spring: float,
    period: float,
    count: float,
    force_walk: float,
    delay: float,
    shaft: ElasticShaft | None = None,
    margin: float = 0.0,
    radius: float = 0.08,
) -> None:
    """Write the filters into a BANK array (1,).

    Args:
        bank: The bank.
        masses: Masses of the filters, shape (n,), in geometric progression; n ≤ MAX_FILTERS. A
            single one is that of a hand that is known.
        viscous: Their viscous dampings, shape (n,).
        spring: Spring of all.
        period: T [s].
        count: One count of the encoder [rad].
        force_walk: See `kalman_model`; that of the lightest, and on an elastic shaft of all.
            The others are as quick as the lightest, or slower, as the encoder is felt.
        delay: D in periods.
        shaft: What joins rotor and handle. Default: they are one.
        margin: Part of the delay that the filters alone have, not the regression. In periods.
        radius: Radius of the handle, at which the steps of the encoder are felt [m].
    """
    n = len(masses)
    if not 1 <= n <= MAX_FILTERS:
        raise ValueError(f"a bank has 1 to {MAX_FILTERS} filters, not {n}")
    bank["holds"], bank["count"] = n == 1, n
    bank["log_lightest"] = math.log(masses[0])
    bank["log_step"] = math.log(masses[-1] / masses[0]) / (n - 1) if n > 1 else 0.0
    bank["spring"] = spring
    bank["forgotten"] = round(_FORGOTTEN_S / period)
    set_rest(bank, period)
    set_trend(bank, masses[0], period)
    told = delay - margin
    bank["delay"], bank["told"] = delay, told
    lightest = float(masses[0])
    if n == 1 and shaft is None:
        lightest *= _KNOWN_LIGHTEST
    set_regression(bank["regression"][0, 0], lightest, period, count, told, shaft, n == 1)
    slower = 1 if shaft is None else OBSERVER_SLOWER_BEHIND_SHAFT
    set_probe(bank["probe"][0, 0], lightest, period, count, slower)
    bank["stiffest"] = np.inf
    bank["within"] = bank["far_share"] = bank["untimely"] = 0.0
    bank["gain_in_flight"] = bank["trend_gain"] = 0.0
    bank["steadiest"] = STEADIEST * masses[-1] / period**2
    bank["viscous"][0, :n] = viscous
    rigid = shaft is None
    if rigid:
        bank["stiffest"][0, :n] = stiffest_walls(masses, delay, period, count, radius)
    set_filters(bank[0], masses, spring, period, count, force_walk, radius, rigid)


def reset_bank(bank: NDArray[np.void], y: float) -> None:
    """Begin at rest at y with the lightest hand."""
    bank["state"] = 0.0
    bank["state"][:, 0] = y
    reset_trend(bank)
    reset_regression(bank["regression"][0, 0], y)
    reset_probe(bank["probe"][0, 0])
    bank["place"], bank["spread"], bank["known"] = 0.0, 0.0, False
    bank["mass"] = np.exp(bank["log_lightest"])
    bank["at_rest"] = 0
    reset_rest(bank, y)
    # None of either: the first cycle sets what depends on them.
    bank["delay_in_force"], bank["age"] = -1.0, 0.0
    bank["pace"] = bank["light_pace"] = -1
    bank["quicker"] = 1.0


@compiled
def correct_bank(bank: Record, estimator: Record, y_sample: float) -> bool:
    """Correct all filters with a sample, learn from it, and hand over; True if the mass changed.

    To be called after `correct` of the estimator, whose state it replaces.
    """
    n = bank.count
    state, gain = bank.state, bank.gain
    bank.regression[0].delay = estimator.told
    if not estimator.settled and not settle_within(estimator, _NEARLY_SETTLED):
        follow_estimator(bank, estimator)
        bank.equal = bank.alone = bank.pressed = 0
        bank.flies = bank.presses = False
        torque = estimator.in_flight[estimator.delay_periods]
        begin_regression(bank.regression[0], y_sample, estimator.v, torque)
        bank.probe[0].samples = 0
        return False
    note_flight(bank, estimator, y_sample)
    follows = follows_trend(bank, y_sample)
    step = _torque_step(bank, estimator)
    for i in range(n):
        residual = y_sample - state[0, i]
        if bank.flies and bank.gain_in_flight[0, i] > 0.0:
            correct_in_flight(bank, i, residual)
            continue
        far = residual - min(max(residual, -bank.far), bank.far)
        near = residual - far
        near -= min(max(near, -bank.within[i]), bank.within[i])
        share = _untimely_share(bank, i, step)
        for c in range(3):
            state[c, i] += (1.0 - share) * (gain[c, i] * near + bank.far_gain[c, i] * far)
        state[0, i] += share * residual
        state[1, i] += share * residual / bank.regression[0].period
        if follows:
            follow_trend(bank, i, bank.trend_gain[i] * gain[2, i] * (near + far))
    note_rest(bank, y_sample)
    bound_velocity(bank)
    hold_torque(bank, estimator, y_sample)
    changed = _identify(bank, estimator, y_sample)
    changed |= _follow_delay(bank, estimator)
    estimator.y, estimator.v = _in_force(bank, state[0]), _in_force(bank, state[1])
    # As it will be on the average up to the end of the force that follows from it.
    ahead = 0.5 * (1.0 + bank.delay_in_force) * bank.regression[0].period
    estimator.d = _in_force(bank, state[2]) + ahead * _in_force(bank, bank.trend)
    if changed:
        take_over(bank, estimator)
    return changed


@compiled
def follow_estimator(bank: Record, estimator: Record) -> None:
    """Put all filters at the state of the estimator."""
    for i in range(bank.count):
        bank.state[0, i], bank.state[1, i] = estimator.y, estimator.v
        bank.state[2, i], bank.trend[i] = estimator.d, 0.0


@compiled
def _torque_step(bank: Record, estimator: Record) -> float:
    """Return the step of the wall's torque in the period up to this sample [N·m]."""
    now, probes = estimator.delay_periods, bank.probe[0].in_flight
    step = estimator.in_flight[now] - estimator.in_flight[now + 1]
    return step - (probes[now] - probes[now + 1])


@compiled
def _untimely_share(bank: Record, i: int, step: float) -> float:
    """Return the share of what filter i does not expect that a step of the torque has made.

    The step may have come at another time than expected, and was an impulse more or less: noise
    along (T, 1, 0) in [y, ẏ, d], of variance b² at the sample. It makes of the gain g of a filter
    whose residual has the variance S the gain (1 − w)·g + w·(1, 1/T, 0), with w = b²/(b² + S). What
    a blow does to position and velocity is thus not taken for a push.
    """
    ratio = bank.untimely[i] * step * step * (1.0 - bank.gain[0, i])
    return ratio / (1.0 + ratio)


@compiled
def _follow_delay(bank: Record, estimator: Record) -> bool:
    """Put the delay that was found in force; return True if another one was."""
    lag = estimator.told - bank.told  # of samples that are late
    delay = min(max(bank.delay + lag + bank.regression[0].excess, 0.0), float(MAX_DELAY))
    if delay == bank.delay_in_force:
        return False
    bank.delay_in_force = delay
    set_model_delay(estimator, delay)
    _set_share(bank, delay - int(delay) - bank.age)
    return True


@compiled
def _set_share(bank: Record, share: float) -> None:
    """Let torques act after this share of a period; a little before it and after it, too."""
    older, newer = bank.older_by_share, bank.newer_by_share
    for k in range(2):
        for i in range(bank.count):
            bank.older[k, i] = older[0, k, i] + share * (older[1, k, i] + share * older[2, k, i])
            bank.newer[k, i] = newer[0, k, i] + share * (newer[1, k, i] + share * newer[2, k, i])


@compiled
def _identify(bank: Record, estimator: Record, y_sample: float) -> bool:
    """Follow what a sample tells of the mass; return True if the mass in force changed."""
    regression, calm = bank.regression[0], bank.moved == bank.calm
    probed = bank.probe[0].samples > 0
    learned = learn(regression, estimator, y_sample, bank.mass, calm, probed)
    if regression.swung:
        bank.known = False
    if _torque_acted(estimator):
        bank.at_rest = 0
        if not learned:
            return False
        if bank.holds:
            if bank.count == 1:
                solve(regression, bank.mass, True)
            return False
        return _follow(bank, torque_rises(regression, estimator))
    bank.at_rest += 1
    if bank.at_rest != bank.forgotten:
        return False
    forget_mass(regression)
    return not bank.holds and _forget(bank)


@compiled
def knows_mass(bank: Record) -> bool:
    """Return True if the mass in force has been found, or told."""
    return bank.count <= 1 or bank.known


@compiled
def _torque_acted(estimator: Record) -> bool:
    for age in range(estimator.delay_periods, MAX_DELAY + 1):
        if estimator.in_flight[age] != 0.0:
            return True
    return False


@compiled
def _follow(bank: Record, rises: bool) -> bool:
    """Move the mass in force towards the likeliest one; return True if it moved.

    rises: True if the torque does.
    """
    likeliest, deviation = solve(bank.regression[0], bank.mass, False)
    bank.spread = deviation / max(likeliest, deviation)
    # Rotor and load together.
    likeliest /= 1.0 + bank.regression[0].rotor * likeliest
    step = _FOLLOWED * (_place_of(bank, likeliest) - bank.place)
    if bank.spread < _FOUND_SPREAD:
        bank.known = True
    elif bank.known:
        step = min(step, _GROWTH_IN_DOUBT / bank.log_step if rises else 0.0)
    bank.place += step
    bank.mass = _mass_at(bank, bank.place)
    return step != 0.0


@compiled
def _forget(bank: Record) -> bool:
    """Begin with the lightest hand again; return True if another one was in force."""
    changed = bank.place != 0.0
    bank.place, bank.spread, bank.known = 0.0, 0.0, False
    bank.mass = _mass_at(bank, 0.0)
    return changed


@compiled
def _mass_at(bank: Record, place: float) -> float:
    return math.exp(bank.log_lightest + bank.log_step * place)


@compiled
def _place_of(bank: Record, likeliest: float) -> float:
    """Return the place of the mass 1/likeliest among the filters."""
    place = (-math.log(likeliest) - bank.log_lightest) / bank.log_step
    return min(max(place, 0.0), bank.count - 1.0)


@compiled
def _in_force(bank: Record, of_filters: NDArray[np.float64]) -> float:
    """Return a quantity between those of the two filters next to the mass in force."""
    if bank.count == 1:
        return of_filters[0]
    k = min(int(bank.place), bank.count - 2)
    share = bank.place - k
    return of_filters[k] + share * (of_filters[k + 1] - of_filters[k])


@compiled
def stiffest(bank: Record) -> float:
    """Return the stiffness of the stiffest wall, with the mass in force."""
    return _in_force(bank, bank.stiffest)


@compiled
def spread_in_force(bank: Record) -> float:
    """Return the standard deviation of ln(mass) in force; 0: nothing is known of it."""
    return KNOWN_SPREAD if bank.count <= 1 else bank.spread


@compiled
def doubt(bank: Record) -> float:
    """Return the doubt about the mass in force and, in motion, about the delay, from 0 to 1.

    That of the mass is the deviation of its logarithm, that of the delay its deviation in periods.
    On an elastic shaft there is none: more damping than its bound reckons with would drive the
    resonance.
    """
    regression = bank.regression[0]
    if regression.rotor > 0.0:
        return 0.0
    of_mass = spread_in_force(bank)
    if of_mass == 0.0 and not bank.holds:
        return 1.0
    of_delay = 0.0
    if is_lively(bank):
        of_delay = _in_force(bank, bank.delay_counts) * regression.excess_spread
    return min(of_mass + of_delay, 1.0)


@compiled
def take_over(bank: Record, estimator: Record) -> None:
    """Give an estimator the mass in force, with the gain and the covariance that belong to it.

    With those of another mass it may diverge.
    """
    set_model(estimator, bank.mass, _in_force(bank, bank.viscous), bank.spring)
    i = int(bank.place + 0.5)
    if not estimator.settled:
        for row in range(3):
            for c in range(3):
                before = estimator.scale[row] * estimator.scale[c]
                estimator.covariance[row, c] *= before / (bank.scale[i, row] * bank.scale[i, c])
    estimator.steady_covariance[:] = bank.covariance[i]
    estimator.transition[:] = bank.transition[i]
    estimator.scale[:] = bank.scale[i]
    estimator.force_noise = bank.force_noise[i]
    for c in range(3):
        estimator.steady_gain[c] = bank.steady_gain[c, i]
        if estimator.settled:
            estimator.gain[c] = bank.steady_gain[c, i]


@compiled
def predict_bank(bank: Record, estimator: Record, force: float, age: float = 0.0) -> None:
    """Advance all filters to the next sample; call before `predict` of the estimator.

    force: as in `predict`. age: that of this sample beyond the mean [periods]; torques act as much
    earlier after it.
    """
    if age != bank.age:
        bank.age = age
        _set_share(bank, bank.delay_in_force - int(bank.delay_in_force) - age)
    n = estimator.delay_periods
    older = estimator.in_flight[n]
    newer = force if n == 0 else estimator.in_flight[n - 1]
    predict_regression(bank.regression[0], estimator.in_flight, force, age)
    send_probe(bank.probe[0], force)
    state, phi = bank.state, bank.phi
    left = trend_left(bank)
    for i in range(bank.count):
        change = bank.regression[0].period * bank.trend[i]
        y, v, d = state[0, i], state[1, i], state[2, i] + 0.5 * change
        state[2, i] += change
        bank.trend[i] *= left
        a, b = older + d, newer + d
        state[0, i] = phi[0, i] * y + phi[1, i] * v + bank.older[0, i] * a + bank.newer[0, i] * b
        state[1, i] = phi[2, i] * y + phi[3, i] * v + bank.older[1, i] * a + bank.newer[1, i] * b


@compiled
def with_probe(bank: Record, wall: Record, force: float) -> float:
    """Return the force of a law, and where that is zero the torque of a probe, unless it holds."""
    probe, regression = bank.probe[0], bank.regression[0]
    if force == 0.0 and not bank.holds:
        known = 0.0 < bank.spread < _FOUND_SPREAD
        return probe_torque(probe, wall, regression.way, comes(regression), bank.mass, known)
    probe.samples = 0
    return force
