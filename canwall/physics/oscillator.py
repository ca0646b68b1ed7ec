"""Exact solution of the linear oscillator m·ÿ + b·ẏ + k·y = u₀ + u₁·t for m > 0 and b, k ≥ 0.

Four functions of time give every solution: the impulse response h with
h'' + (b/m)·h' + (k/m)·h = 0, h(0) = 0, h'(0) = 1, its derivative, and its first two integrals.
They are entire functions of b/m, k/m and t, so a single power series serves the free mass and the
undamped, damped, critically damped and overdamped oscillator; doubling extends it to longer times.
Without case distinctions there is no cancellation where two cases meet (b → 0, k → 0).
"""

import math

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import compiled

# Terms of the power series. With |b/m·t| + √(k/m)·|t| ≤ 1/2 the last one is below 2^-13/13! ≈ 2e-14
# of the first, and its factor s_n ≤ 2^-12 takes it below the rounding of a double.
_TERMS = 14
_REACH = 0.5
_INVERSE_FACTORIALS = tuple(1.0 / math.factorial(n) for n in range(_TERMS + 3))
_MAX_DOUBLINGS = 60


@compiled
def basis(
    damping_ratio: float, stiffness_ratio: float, t: float
) -> tuple[float, float, float, float]:
    """Return the impulse response of the oscillator and its integrals at time t: (h', h, ∫h, ∬h).

    For any initial state and input u₀ + u₁·t per unit mass
    y = y₀·(1 − k/m·∫h) + v₀·h + u₀·∫h + u₁·∬h, and v is its derivative.

    Args:
        damping_ratio: b/m [1/s].
        stiffness_ratio: k/m [1/s²].
        t: Time of either sign [s].
    """
    # Halve the time until the series converges quickly, ...
    doublings = 0
    while (
        abs(damping_ratio * t) + math.sqrt(abs(stiffness_ratio)) * abs(t) > _REACH
        and doublings < _MAX_DOUBLINGS
    ):
        t *= 0.5
        doublings += 1
    p = damping_ratio * t
    q = stiffness_ratio * t * t
    # ... h = t·Σ s_n/n! with s_1 = 1, s_2 = −p, s_{n+2} = −p·s_{n+1} − q·s_n; derivative and
    # integrals are the same sum with the factorial shifted by one place, ...
    h1 = h0 = g1 = g2 = 0.0
    term, following = 1.0, -p
    for n in range(_TERMS):
        h1 += term * _INVERSE_FACTORIALS[n]
        h0 += term * _INVERSE_FACTORIALS[n + 1]
        g1 += term * _INVERSE_FACTORIALS[n + 2]
        g2 += term * _INVERSE_FACTORIALS[n + 3]
        term, following = following, -p * following - q * term
    h0 *= t
    g1 *= t * t
    g2 *= t * t * t
    # ... then continue the motion from its own end, doubling the time.
    for _ in range(doublings):
        c = 1.0 - stiffness_ratio * g1
        g2 = c * g2 + h0 * g1 + t * g1 + g2
        g1 = c * g1 + h0 * h0 + g1
        h1, h0 = h1 * h1 - stiffness_ratio * h0 * h0, c * h0 + h0 * h1
        t *= 2.0
    return h1, h0, g1, g2


@compiled
def lag_response(
    damping_ratio: float, stiffness_ratio: float, rate: float, t: float
) -> tuple[float, float, float, float, float, float]:
    """Return (h', h, ∫h, ∬h, r', r): `basis`, and the response r to the decay of a first-order lag.

    r'' + b/m·r' + k/m·r = exp(−rate·t) − 1 from rest. The series and the doubling are those of
    `basis`, so a lag in resonance with the oscillator is not a special case either.

    Args:
        damping_ratio: b/m [1/s].
        stiffness_ratio: k/m [1/s²].
        rate: Rate of the lag [1/s].
        t: Time [s].
    """
    doublings = 0
    while (
        abs(damping_ratio * t) + math.sqrt(abs(stiffness_ratio)) * abs(t) + abs(rate * t) > _REACH
        and doublings < _MAX_DOUBLINGS
    ):
        t *= 0.5
        doublings += 1
    p = damping_ratio * t
    q = stiffness_ratio * t * t
    h1 = h0 = g1 = g2 = r1 = r0 = 0.0
    term, following = 1.0, -p
    # The series of the lag begins with its third term, c_3 = −rate·t.
    power = -rate * t
    lagged, lagging = power, power * power - p * power
    for n in range(_TERMS):
        h1 += term * _INVERSE_FACTORIALS[n]
        h0 += term * _INVERSE_FACTORIALS[n + 1]
        g1 += term * _INVERSE_FACTORIALS[n + 2]
        g2 += term * _INVERSE_FACTORIALS[n + 3]
        r1 += lagged * _INVERSE_FACTORIALS[n + 2]
        r0 += lagged * _INVERSE_FACTORIALS[n + 3]
        term, following = following, -p * following - q * term
        power *= -rate * t
        lagged, lagging = lagging, -p * lagging - q * lagged - rate * t * power
    h0 *= t
    g1 *= t * t
    g2 *= t * t * t
    r1 *= t
    r0 *= t * t
    gone = math.expm1(-rate * t)
    for _ in range(doublings):
        c = 1.0 - stiffness_ratio * g1
        # After t the response to the lag continues as it began, scaled by what has not decayed;
        # what has decayed acts as a constant.
        r1, r0 = (
            (h1 + 1.0 + gone) * r1 - stiffness_ratio * h0 * r0 + gone * h0,
            (c + 1.0 + gone) * r0 + h0 * r1 + gone * g1,
        )
        gone *= gone + 2.0
        g2 = c * g2 + h0 * g1 + t * g1 + g2
        g1 = c * g1 + h0 * h0 + g1
        h1, h0 = h1 * h1 - stiffness_ratio * h0 * h0, c * h0 + h0 * h1
        t *= 2.0
    return h1, h0, g1, g2, r1, r0


@compiled
def flow(
    mass: float,
    viscous: float,
    spring: float,
    y: float,
    v: float,
    u0: float,
    u1: float,
    t: float,
) -> tuple[float, float]:
    """Return the state (y, ẏ) at time t of m·ÿ + b·ẏ + k·y = u₀ + u₁·t, starting from (y, v).

    Units are any consistent set, e.g. kg·m², N·m·s/rad, N·m/rad, rad, rad/s, N·m, N·m/s, s.
    """
    kappa = spring / mass
    h1, h0, g1, g2 = basis(viscous / mass, kappa, t)
    # Forces are summed first, so that nothing moves from equilibrium, not even by rounding.
    a0 = (u0 - spring * y) / mass
    a1 = u1 / mass
    return y + v * h0 + a0 * g1 + a1 * g2, v * h1 + a0 * h0 + a1 * g1


@compiled
def acceleration(mass: float, viscous: float, spring: float, y: float, v: float, u: float) -> float:
    """Return ÿ of m·ÿ + b·ẏ + k·y = u."""
    return (u - viscous * v - spring * y) / mass


@compiled
def zoh_coefficients(
    mass: float, viscous: float, spring: float, period: float
) -> tuple[float, float, float, float, float, float]:
    """Return the zero-order-hold equivalent over one period: (Φ₁₁, Φ₁₂, Φ₂₁, Φ₂₂, Γ₁, Γ₂).

    x[j+1] = Φ·x[j] + Γ·u[j] with x = [y, ẏ] and u held (docs/laws.md; 5.17–5.19).
    """
    kappa = spring / mass
    h1, h0, g1, _ = basis(viscous / mass, kappa, period)
    return 1.0 - kappa * g1, h0, -kappa * h0, h1, g1 / mass, h0 / mass


def zoh(
    mass: float, viscous: float, spring: float, period: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the zero-order-hold equivalent as Φ, shape (2, 2), and Γ, shape (2,)."""
    p11, p12, p21, p22, c1, c2 = zoh_coefficients(mass, viscous, spring, period)
    return np.array([[p11, p12], [p21, p22]]), np.array([c1, c2])
