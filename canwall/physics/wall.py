"""Stiffness and damping of a continuous wall that belong to the mass on it."""

import math

from canwall.compiled import compiled


@compiled
def capped_stiffness(stiffness: float, cap: float, mass: float, period: float) -> float:
    """Return K_e = min(K, c·m/T²), and K without a cap, c = 0 (docs/laws.md)."""
    return min(stiffness, cap * mass / (period * period)) if cap > 0.0 else stiffness


@compiled
def damping_of_ratio(damping: float, ratio: float, stiffness: float, mass: float) -> float:
    """Return B = 2·ζ·√(K_e·m), and the given damping without a ratio, ζ = 0."""
    return 2.0 * ratio * math.sqrt(stiffness * mass) if ratio > 0.0 else damping
