"""Mass and delay by least squares, from what a regression has summed and what is known before.

The unknowns are those of its equation. Which samples are summed, and with which weight, is decided
in `regression`.
"""

import math

from canwall.compiled import Record, compiled

#: Before the first torque: standard deviation of m₀/m about 1, with m₀ the lightest mass; mean and
#: standard deviation of b/m [1/s]; standard deviation of what is steady [counts].
_PRIOR_LIGHTNESS, _PRIOR_RATE, _PRIOR_RATE_DEVIATION, _PRIOR_STEADY = 0.7, 100.0, 300.0, 4.0
#: Delay beyond the one told, before the first torque: standard deviation, and the most [periods].
PRIOR_EXCESS, _MOST_EXCESS = 0.3, 0.5
#: Standard deviation of ln(m) of a hand that is known.
KNOWN_SPREAD = 0.01
#: Coulomb friction that there may be: standard deviation, and the most that explains a surprise
#: [N·m].
FRICTION = 0.02


@compiled
def solve(regression: Record, mass: float, known: bool) -> tuple[float, float]:
    """Return 1/m, of the load on an elastic shaft, and its standard deviation; find the delay.

    They are the least squares of r₀ + r₁·(1/m) − r₂·(b/m) − r₃·(f_c/m) + r₄·(δ/m) − r₅·c, with what
    is known before the first torque; c is what is steady. mass: the one in force, for friction and
    delay. known: True if it is that of a hand that is known; any error of it is found as delay.
    """
    mass -= regression.rotor
    before, deviation = regression.lightest, _PRIOR_LIGHTNESS
    if known:
        before, deviation = mass, KNOWN_SPREAD
    normal = regression.normal
    normal[:] = regression.information
    _add_knowledge(normal, 1, (before / deviation) ** 2, 1.0 / before)
    _add_knowledge(normal, 2, 1.0 / _PRIOR_RATE_DEVIATION**2, -_PRIOR_RATE)
    _add_knowledge(normal, 3, (mass / FRICTION) ** 2, 0.0)
    precision, excess = regression.excess_before[0], regression.excess_before[1]
    _add_knowledge(normal, 4, precision * mass * mass, excess / mass)
    growth = regression.growth / regression.resolution
    _add_knowledge(normal, 5, 1.0 / _PRIOR_STEADY**2, -growth)
    _eliminate(normal, 5)
    _eliminate(normal, 3)
    _eliminate(normal, 2)
    told = normal[4, 4]
    precision = normal[1, 1] - normal[1, 4] * normal[1, 4] / told
    lightness = -(normal[0, 1] - normal[1, 4] * normal[0, 4] / told) / precision
    deviation = 1.0 / math.sqrt(precision)
    if lightness > 0.0 and regression.rotor == 0.0:
        excess = -(normal[0, 4] + normal[1, 4] * lightness) / (told * lightness)
        regression.excess = min(max(excess, -_MOST_EXCESS), _MOST_EXCESS)
        regression.excess_spread = _excess_spread(regression, lightness)
    return mean_above_zero(lightness, deviation), deviation


@compiled
def _add_knowledge(normal: Record, k: int, precision: float, value: float) -> None:
    """Add to the normal equations that unknown k has this value."""
    normal[k, k] += precision
    normal[0, k] -= precision * value
    normal[k, 0] = normal[0, k]


@compiled
def _eliminate(normal: Record, k: int) -> None:
    """Eliminate unknown k from the normal equations of the others."""
    for i in range(6):
        share = normal[i, k] / normal[k, k]
        if i != k:
            for c in range(6):
                normal[i, c] -= share * normal[k, c]


@compiled
def _excess_spread(regression: Record, lightness: float) -> float:
    """Return the standard deviation of the delay, whatever the mass is: of δ in δ·(1/m)."""
    normal, excess = regression.normal, regression.excess
    both = normal[1, 4] + excess * normal[4, 4]
    of_mass = normal[1, 1] + excess * (normal[1, 4] + both)
    told = max(normal[4, 4] - both * both / of_mass, 0.0) * lightness * lightness
    return min(1.0 / math.sqrt(max(told, 1e-6)), PRIOR_EXCESS)


@compiled
def mean_above_zero(mean: float, deviation: float) -> float:
    """Return the mean of a normal distribution of which only what is above zero is possible."""
    z = mean / deviation
    if z < -6.0:
        return deviation / -z
    return mean + deviation * math.sqrt(2.0 / math.pi) * math.exp(-0.5 * z * z) / math.erfc(
        -z / math.sqrt(2.0)
    )
