"""Bandwidths of the filters of a bank: their gains and models, made outside the cycle.

A filter has a bandwidth for walls of each stiffness and one for a handle that moves; it goes with
that of the delay. Those of light hands have one more for the way to the wall. A filter that is too
slow for wall and hand makes them bounce, and one that is too quick for friction swings.

What the steps of the encoder make felt grows with the bandwidth, and with the force at the handle
that accelerates the mass by a count per period², m·Δ/(T²·r): the count force of a hand. It decides
which filter may be as quick as the delay allows, whatever encoder, period and rotor are.
"""

import math

import numpy as np
from numpy.typing import NDArray

from canwall.physics import zoh
from canwall.walls.estimator import KalmanModel, bandwidth_of, gain_with_trend, kalman_model

#: Stiffnesses for which filters have gains, each half of the one before; after these, gains for a
#: handle that moves.
PACES = 8
#: Bandwidths relative to that for the delay as told, for which filters have gains.
QUICKER = (0.75, 1.0, 1.4)
#: Shortest delay that makes filters quicker [periods]. A torque that acts on reception would allow
#: more; but the steps of the encoder would be felt, and friction swing.
SHORTEST_DELAY = 1.45
#: Bandwidth of the filter of the lightest hand, over that of one which follows within the delay.
_QUICKNESS = 0.85
#: Bandwidth of the filter of a hand with this count force, in 1/T and N, and the power of the force
#: with which that of others falls. Under a filter that is slow against the wall a handle that
#: breaks loose slips far, and friction and the bias force hunt.
_STEADY, _COUNT_FORCE_N, _STEADINESS = 0.54, 0.18, 0.52
#: Count force up to which the filters of a handle that moves are as quick as the lightest [N].
_LIVELY_N = 2.2
#: K·T²/m from which on a filter is at its steadiest, and the power of the stiffness with which its
#: bandwidth rises below, up to the lightest one's, and for walls softer by a factor no further: on
#: a soft wall noise is felt less, and a filter slower than the wall makes a heavy hand bounce.
STEADIEST, _QUICKENING, _SOFTEST = 1.0, 1.0 / 6.0, 16.0
#: Bandwidth of a filter for a handle at rest without damping, as a part of that for one in motion,
#: and rate b/m from which on both are the same [1/s]. Friction adds damping, the more the smaller
#: the motion: a loop that some damping makes unstable goes on swinging in friction, as that of a
#: quick filter does with a mass that has little damping of its own.
_CALM, _DAMPED = 0.75, 60.0
#: Mass over the lightest one up to which filters follow how the push changes, and their bandwidth
#: on the way to the wall, over that of the lightest one in contact.
_LIGHT, _IN_FLIGHT = 3.0, 0.9
#: How quickly they follow it in contact, as a part of how quickly they do in flight.
_IN_CONTACT = 0.3
#: Mass over the lightest one from which on doubt about the delay counts in full. A light hand would
#: swing under the damping.
_DELAY_COUNTS = 10.0
#: Share of half a count within which a reading does not contradict the prediction of a heavy hand,
#: whose motion between two samples is known better than that. A light one needs each correction.
_WITHIN = 0.65
#: What a sample differs by from the prediction beyond which the rest is followed more quickly
#: [counts], and the share of the way from a filter's gain to its quickest one by which it is, of a
#: hand whose steps of the encoder are felt much. A count is noise, and more is a handle that breaks
#: loose or another push: a filter that follows both alike is felt, or has the handle hunt.
_FAR, _FAR_SHARE = 1.5, 0.38
#: Uncertainty of a torque's course, as a share of its steps, for filters of masses from the latter
#: multiple of the lightest one on; none up to the former. The push of a light hand changes as fast
#: as a wall does, and its filter needs all that a sample says of it.
_UNTIMELY, _UNTIMELY_FROM = 0.04, (1.4, 2.2)
#: Time constants of a filter for which samples have to be equal before its velocity is bounded by
#: them. (Bounded by anything but the covariance that belongs to its gain, a filter of a handle at
#: rest diverges.)
_EQUAL = 8.0
#: Inertia over damping of the lightest hands [s].
_HAND_S = 1.5e-3
#: K·T²/m of the stiffest wall, the delay from which on it falls [periods], and the power of the
#: delay with which it does: beyond, light hands bounce, and hunt in friction.
_STIFFEST, _LONG_DELAY, _SOFTENING = 0.83, 1.85, 5.0
#: Most that a count may change the force of a wall at the handle [N].
_STEP_N = 2.2


def hand_damping(inertia: float, most: float) -> float:
    """Return the damping of a hand of this inertia at the handle, which tends to `most`.

    Fingers of a few grams have some newton seconds per metre, a grip and an arm hardly more.
    """
    return most * inertia / (inertia + most * _HAND_S) if most > 0.0 else 0.0


def stiffest_walls(
    masses: NDArray[np.float64], delay: float, period: float, count: float, radius: float
) -> NDArray[np.float64]:
    """Return the stiffness of the stiffest wall of each hand that delay and encoder bear.

    Args:
        masses: Masses at the handle, shape (n,).
        delay: D in periods.
        period: T [s].
        count: One count of the encoder [rad].
        radius: Radius of the handle [m].

    Returns:
        Stiffnesses [N·m/rad], shape (n,).
    """
    within_delay = _STIFFEST * (_LONG_DELAY / max(delay, SHORTEST_DELAY)) ** _SOFTENING
    return np.minimum(within_delay * masses / period**2, _STEP_N * radius / count)


def lightest_bandwidth(delay: float, period: float) -> float:
    """Return the bandwidth [rad/s] of the filter of the lightest hand; delay in periods."""
    return _QUICKNESS / (max(delay, SHORTEST_DELAY) * period)


def set_filters(
    bank: np.void,
    masses: NDArray[np.float64],
    spring: float,
    period: float,
    count: float,
    force_walk: float,
    radius: float,
    rigid: bool,
) -> None:
    """Write the filters of a bank whose masses, dampings and delay are set.

    Args:
        bank: A record BANK.
        masses: Masses of the filters, shape (n,).
        spring: Spring of all.
        period: T [s].
        count: One count of the encoder [rad].
        force_walk: As for `set_bank`.
        radius: As for `set_bank`.
        rigid: False on an elastic shaft: one walk for all, whatever wall and delay are.
    """
    lightest = bandwidth_of(force_walk, float(masses[0]), period, count) * period
    bank["far"] = _FAR * count
    for i in range(len(masses)):
        plant = float(masses[i]), bank["viscous"][i].item(), spring, period
        walk, heavier, slower, lively = force_walk, float(masses[i] / masses[0]), 1.0, 1.0
        count_force = plant[0] * count / (period**2 * radius)
        felt_less = _COUNT_FORCE_N / count_force
        if rigid:
            damped = min(plant[1] / (plant[0] * _DAMPED), 1.0)
            calm = _CALM + (1.0 - _CALM) * damped
            slower = min(calm, _STEADY / lightest * felt_less**_STEADINESS)
            lively = max(min(1.0, _LIVELY_N / count_force) ** _STEADINESS, slower)
            walk *= heavier * slower**3  # by the cube of the bandwidth
            felt_more = max(1.0 - felt_less, 0.0)
            bank["within"][i] = 0.5 * _WITHIN * felt_more * count
            bank["far_share"][i] = _FAR_SHARE * felt_more
            impulse = _untimely(heavier) * period / plant[0]
            bank["untimely"][i] = 12.0 * (impulse * period / count) ** 2
        _set_filter(bank, i, kalman_model(*plant, count, walk))
        _set_paces(bank, i, plant, count, walk, lively / slower, rigid)
        _set_torques(bank, i, *plant)
        # Of a single one the lightest is not known: it is as light as the encoder lets it be quick.
        lightness = 1.0 / heavier if len(masses) > 1 else felt_less / _LIGHT
        bank["delay_counts"][i] = min(max(-math.log(lightness) / math.log(_DELAY_COUNTS), 0.0), 1.0)
        if rigid and _LIGHT * lightness >= 1.0:
            in_flight = _IN_FLIGHT * lightest_bandwidth(bank["told"].item(), period)
            bank["gain_in_flight"][:, i] = gain = gain_with_trend(*plant, in_flight)
            bank["trend_gain"][i] = _IN_CONTACT * gain[3] / gain[2]


def _untimely(heavier: float) -> float:
    """Return the uncertainty of a torque's course by the mass over the lightest one."""
    none, full = _UNTIMELY_FROM
    share = math.log(heavier / none) / math.log(full / none)
    return _UNTIMELY * min(max(share, 0.0), 1.0)


def _set_paces(
    bank: np.void,
    i: int,
    plant: tuple[float, float, float, float],
    count: float,
    walk: float,
    faster: float,
    rigid: bool,
) -> None:
    """Write the gains of a filter and what rest tells it.

    Its bandwidth goes with that of the delay. faster: that for a handle that moves, over that for
    the stiffest wall.
    """
    period = plant[-1]
    paces = np.zeros((len(QUICKER), PACES + 1, 6))
    shares = np.array(_shares(bank, i, faster))[:, None]
    for k, quicker in enumerate(QUICKER if rigid else [1.0] * len(QUICKER)):
        steady = _gain_and_rest(kalman_model(*plant, count, walk * quicker**3), period)
        quick = _gain_and_rest(kalman_model(*plant, count, walk * (quicker * faster) ** 3), period)
        paces[k] = steady * (quick / steady) ** shares
    bank["paces"][:, :, :, i] = _parabolas(np.array(QUICKER), paces)


def _shares(bank: np.void, i: int, faster: float) -> list[float]:
    """Return the share of the way from a filter's steadiest gains to its quickest, by pace.

    faster: bandwidth of the quickest over that of the steadiest.
    """
    if faster == 1.0:
        return [0.0] * (PACES + 1)
    steadiest = math.exp(bank["log_step"] * (i + 1 - bank["count"]))
    softer = [min(max(steadiest * 2.0**k, 1.0), _SOFTEST) for k in range(PACES)]
    shares = [_QUICKENING * math.log(each) / math.log(faster) for each in softer]
    return [*(min(share, 1.0) for share in shares), 1.0]


def _parabolas(at: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return c with c₀ + c₁·x + c₂·x² through three values, shape (3, ...), each."""
    return np.tensordot(np.linalg.inv(np.vander(at, increasing=True)), values, 1)


def _set_torques(
    bank: np.void, i: int, mass: float, viscous: float, spring: float, period: float
) -> None:
    """Write the transition of a filter, and what torques do before and after the actuation."""
    phi, _ = zoh(mass, viscous, spring, period)
    bank["phi"][:, i] = phi.ravel()
    shares = np.array([0.0, 0.5, 1.0])
    older, newer = np.zeros((3, 2)), np.zeros((3, 2))
    for k, share in enumerate(shares.tolist()):
        _, before = zoh(mass, viscous, spring, share * period)
        phi_after, newer[k] = zoh(mass, viscous, spring, (1.0 - share) * period)
        older[k] = phi_after @ before
    bank["older_by_share"][:, :, i] = _parabolas(shares, older)
    bank["newer_by_share"][:, :, i] = _parabolas(shares, newer)


def _set_filter(bank: np.void, i: int, model: KalmanModel) -> None:
    bank["steady_gain"][:, i] = model.gain
    bank["covariance"][i], bank["transition"][i] = model.covariance, model.transition
    bank["scale"][i], bank["force_noise"][i] = model.scale, model.force_noise


def _gain_and_rest(model: KalmanModel, period: float) -> NDArray[np.float64]:
    """Return the gain of a filter, and what equal samples say by its covariance after a sample.

    Those are corrections of position and force for one of the velocity, and the number of samples.
    """
    scale, prior = model.scale, model.covariance
    after = prior - np.outer(model.gain / scale * scale[0], prior[0])
    with_velocity = after[[0, 2], 1] / after[1, 1] * scale[[0, 2]] / scale[1]
    return np.array([*model.gain, *with_velocity, _EQUAL * scale[0] / (scale[1] * period)])
