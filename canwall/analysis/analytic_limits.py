"""Analytic limits of the stiffness, to draw over every map (theory, section 6).

K and B are the wall's [N·m/rad, N·m·s/rad], b and m what really moves, T the period, D the delay
from a sample to its torque in periods. B is made of the backward difference.
"""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: The largest K·T²/m of any spring-damper wall at b = 0, and the B·T/m of it, for D = 0, 1, 2.
CEILINGS = {0: (0.686, 0.83), 1: (0.144, 0.43), 2: (0.062, 0.29)}


def passive_stiffness(viscous: float, damping: float, period: float, delay: int) -> float:
    """Colgate and Schenkel: the largest K that is passive whoever holds the handle.

    b > K·T/2 + |B| without delay; its extension to D = 1. Raises ValueError for another D.
    """
    if delay == 0:
        return max(0.0, 2.0 * (viscous - abs(damping)) / period)
    if delay != 1:
        raise ValueError(f"there is no such limit for a delay of {delay} periods")
    if viscous >= 5.0 * damping:
        return (viscous + damping) / (1.5 * period)
    if viscous <= damping:
        return 0.0
    # K·T/2 + B + (K·T)²/(8·B) = b.
    return 2.0 * damping / period * (math.sqrt(2.0 * viscous / damping - 1.0) - 1.0)


def quantised_stiffness(viscous: float, coulomb: float, count: float, period: float) -> float:
    """Abbott and Okamura: K ≤ min(2·b/T, 2·f_c/Δ), passive with a quantised position, D = 0."""
    return min(2.0 * viscous / period, 2.0 * coulomb / count)


def delayed_stiffness(viscous: float, damping: float, period: float, delay: float) -> float:
    """Gil, Hulin: K < (b + B)/(T/2 + D·T), linear stability for small b·T/m."""
    return (viscous + damping) / ((0.5 + delay) * period)


def spectral_radius(
    mass: float, viscous: float, stiffness: float, damping: float, period: float, delay: int
) -> float:
    """Largest modulus of the sampled loop's eigenvalues: stable below 1; exact, for whole D.

    f[j] = −K·y[j−D] − B·(y[j−D] − y[j−D−1])/T, held over the period that begins at j.
    """
    ratio = viscous / mass
    decay = math.exp(-ratio * period)
    if ratio * period > 1e-9:
        travel = -math.expm1(-ratio * period) / ratio
        gamma_y = (period - travel) / viscous
    else:
        travel, gamma_y = period, period * period / (2.0 * mass)
    gamma_v = travel / mass
    # State: y, v, and y of the D + 1 samples before.
    n = 3 + delay
    loop = np.zeros((n, n))
    loop[0, :2], loop[1, 1] = (1.0, travel), decay
    samples = [0, *range(2, n)]
    for sample, gain in (
        (samples[delay], -stiffness - damping / period),
        (samples[delay + 1], damping / period),
    ):
        loop[0, sample] += gamma_y * gain
        loop[1, sample] += gamma_v * gain
    for older, newer in zip(samples[1:], samples[:-1], strict=True):
        loop[older, newer] = 1.0
    return float(np.abs(np.linalg.eigvals(loop)).max())


def stable_stiffness(
    mass: float, viscous: float, damping: float, period: float, delay: int
) -> float:
    """The largest K up to which the sampled loop is stable, to 1e-6 of it; 0 where none is."""

    def stable(normalised: float) -> bool:
        stiffness = normalised * mass / period**2
        return spectral_radius(mass, viscous, stiffness, damping, period, delay) < 1.0

    ladder = np.geomspace(1e-6, 10.0, 400)
    free, taken = 0.0, None
    for normalised in ladder:
        if not stable(normalised):
            taken = float(normalised)
            break
        free = float(normalised)
    if free == 0.0 or taken is None:
        return free * mass / period**2
    while taken / free - 1.0 > 1e-6:
        middle = math.sqrt(free * taken)
        free, taken = (middle, taken) if stable(middle) else (free, middle)
    return free * mass / period**2
