"""Analytic limits of the stiffness, drawn over every map (docs/results.md).

K [N·m/rad] and B [N·m·s/rad] are the wall's stiffness and damping, m [kg·m²] and b [N·m·s/rad] the
inertia and damping of everything that moves, T [s] is the sampling period, D the delay from a
sample to its torque in periods. B acts on the backward difference of the position.
"""

import math
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from canwall.physics import zoh

Array = NDArray[np.float64]

#: Largest K·T²/m of any spring-damper wall at b = 0, and its B·T/m, for D = 0, 1, 2.
CEILINGS = {0: (0.686, 0.83), 1: (0.144, 0.43), 2: (0.062, 0.29)}


def passive_stiffness(viscous: float, damping: float, period: float, delay: int) -> float:
    """Return the largest K that is passive with any operator (Colgate and Schenkel).

    b > K·T/2 + |B| without delay, and its extension to D = 1.

    Args:
        viscous: Damping b of the device alone [N·m·s/rad].
        damping: Damping B of the wall [N·m·s/rad].
        period: Sampling period T [s].
        delay: Delay D in periods, 0 or 1.

    Raises:
        ValueError: For another delay, for which there is no such limit.
    """
    if delay == 0:
        return max(0.0, 2.0 * (viscous - abs(damping)) / period)
    if delay != 1:
        raise ValueError(f"no passivity limit for a delay of {delay} periods; it has to be 0 or 1")
    if viscous >= 5.0 * damping:
        return max(0.0, (viscous + damping) / (1.5 * period))
    if viscous <= damping:
        return 0.0
    # K·T/2 + B + (K·T)²/(8·B) = b.
    return 2.0 * damping / period * (math.sqrt(2.0 * viscous / damping - 1.0) - 1.0)


def quantised_stiffness(viscous: float, coulomb: float, count: float, period: float) -> float:
    """Return the largest K that is passive with a quantised position (Abbott and Okamura).

    K ≤ min(2·b/T, 2·f_c/Δ), for D = 0 and B = 0.

    Args:
        viscous: Damping b of the device alone [N·m·s/rad].
        coulomb: Coulomb friction f_c [N·m].
        count: One encoder count Δ [rad].
        period: Sampling period T [s].
    """
    return min(2.0 * viscous / period, 2.0 * coulomb / count)


def delayed_stiffness(viscous: float, damping: float, period: float, delay: float) -> float:
    """Return the linear stability limit for small b·T/m: K < (b + B)/(T/2 + D·T) (Gil, Hulin)."""
    return (viscous + damping) / ((0.5 + delay) * period)


def spectral_radius(
    mass: float, viscous: float, stiffness: float, damping: float, period: float, delay: int
) -> float:
    """Return the spectral radius of the sampled loop, which is stable below 1; exact.

    f[j] = −K·y[j−D] − B·(y[j−D] − y[j−D−1])/T is held over the period that begins at j; the delay
    D is a whole number of periods.
    """
    phi, gamma = zoh(mass, viscous, 0.0, period)
    # State: y, v, and y at the D + 1 samples before.
    n = 3 + delay
    loop = np.zeros((n, n))
    loop[:2, :2] = phi
    samples = [0, *range(2, n)]
    for sample, gain in (
        (samples[delay], -stiffness - damping / period),
        (samples[delay + 1], damping / period),
    ):
        loop[:2, sample] += gamma * gain
    for older, newer in zip(samples[1:], samples[:-1], strict=True):
        loop[older, newer] = 1.0
    return float(np.abs(np.linalg.eigvals(loop)).max())


def stable_stiffness(
    mass: float, viscous: float, damping: float, period: float, delay: int
) -> float:
    """Return the K up to which the sampled loop is stable, to a relative 1e-6; 0 if there is none.

    Arguments as for `spectral_radius`.
    """

    def is_stable(normalised: float) -> bool:
        stiffness = normalised * mass / period**2
        return spectral_radius(mass, viscous, stiffness, damping, period, delay) < 1.0

    # On a heavy handle with little damping the limit is far below; rounding is below 1e-9.
    grid = np.geomspace(1e-6, 10.0, 400)
    if not is_stable(float(grid[0])):
        grid = np.geomspace(1e-9, 1e-6, 400)
    low, high = 0.0, None
    for normalised in grid:
        if not is_stable(normalised):
            high = float(normalised)
            break
        low = float(normalised)
    if low == 0.0 or high is None:
        return low * mass / period**2
    while high / low - 1.0 > 1e-6:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if is_stable(middle) else (low, middle)
    return low * mass / period**2


class DiolaitiRegion(StrEnum):
    """Regions of the plane of viscous damping β and Coulomb friction σ."""

    PASSIVE = "passive"
    LIMIT_CYCLE = "limit cycle"
    LOCALLY_STABLE = "locally stable"
    UNSTABLE = "unstable"


def diolaiti_region(beta: float, sigma: float, delay: float) -> DiolaitiRegion:
    """Return the region of a plain wall: β = b/(K·T), σ = f_c/(K·Δ), delay of D periods.

    Damping of β > 1/2 + D takes what sampling and delay give off at any amplitude; friction of
    σ > 1/2 takes what a quantised position gives off, and holds any motion that is small enough.
    Without the friction there is a cycle of some counts, without the damping a large motion grows
    (N. Diolaiti, G. Niemeyer, F. Barbagli and J. K. Salisbury, IEEE Trans. Robotics 22(2), 2006).
    """
    damped, held = beta > 0.5 + delay, sigma > 0.5
    if damped:
        return DiolaitiRegion.PASSIVE if held else DiolaitiRegion.LIMIT_CYCLE
    return DiolaitiRegion.LOCALLY_STABLE if held else DiolaitiRegion.UNSTABLE
