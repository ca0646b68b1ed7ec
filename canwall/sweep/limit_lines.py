"""Limits of a spring-damper wall over a Z-width map, as lines and points (docs/results.md)."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from canwall.analysis.analytic_limits import (
    CEILINGS,
    delayed_stiffness,
    passive_stiffness,
    quantised_stiffness,
    stable_stiffness,
)
from canwall.sweep.axes import DAMPING, STIFFNESS
from canwall.sweep.labels import axis_name

Array = NDArray[np.float64]

#: Points of each line.
_POINTS = 60


class Limit(StrEnum):
    """Limits of the stiffness, with their labels."""

    DELAYED = "spring and damper: (b + B)/(T/2 + D·T)"
    EXACT = "the same, exact"
    CEILING = "the same, ceiling at b = 0"
    PASSIVE = "passive with any operator (Colgate, Schenkel)"
    QUANTISED = "passive with encoder, B = 0 (Abbott, Okamura)"


@dataclass(frozen=True)
class LimitLine:
    """Largest stiffnesses over dampings, in the units of the map's axes; a single one is a point.

    Attributes:
        limit: The limit.
        stiffness: Stiffnesses, shape (n,).
        damping: Dampings, shape (n,).
    """

    limit: Limit
    stiffness: Array
    damping: Array


def limit_lines(dataset: xr.Dataset) -> list[LimitLine]:
    """Return the limits that exist for the delay of a map, as far as they are within its axes.

    Args:
        dataset: A map at one condition.
    """
    stiffness, damping = (axis_name(dataset, pair) for pair in (STIFFNESS, DAMPING))
    mass, period = dataset["inertia"].item(), dataset["period"].item()
    x_unit = mass / period**2 if stiffness == "stiffness_normalised" else 1.0
    y_unit = mass / period if damping == "damping_normalised" else 1.0
    left, right = dataset[stiffness].values[[0, -1]]
    low, high = dataset[damping].values[[0, -1]]
    lines = []
    for limit, largest, dampings in _limits(dataset, low * y_unit, high * y_unit):
        x, y = largest / x_unit, dampings / y_unit
        # A line outside the map would still be in its legend.
        if np.any((left <= x) & (x <= right) & (low <= y) & (y <= high)):
            lines.append(LimitLine(limit, x, y))
    return lines


def _limits(dataset: xr.Dataset, low: float, high: float) -> list[tuple[Limit, Array, Array]]:
    """Return stiffnesses [N·m/rad] and dampings [N·m·s/rad] for dampings from low to high."""
    mass, viscous, device, period, delay = (
        dataset[name].item()
        for name in ("inertia", "viscous", "device_viscous", "period", "loop_delay")
    )
    # Passivity ends at B equal to the device's own damping, which may be a small part of the map.
    fine = np.linspace(0.0, device, _POINTS // 3)
    dampings = np.linspace(low, high, _POINTS)
    dampings = np.unique(np.concatenate((dampings, fine[(low <= fine) & (fine <= high)])))
    approximate = [delayed_stiffness(viscous, b, period, delay) for b in dampings]
    limits = [(Limit.DELAYED, np.array(approximate), dampings)]
    if delay != int(delay):
        return limits
    whole = int(delay)
    exact = [stable_stiffness(mass, viscous, b, period, whole) for b in dampings]
    limits.append((Limit.EXACT, np.array(exact), dampings))
    if whole in CEILINGS:
        ceiling, at = CEILINGS[whole]
        point = np.array([ceiling * mass / period**2]), np.array([at * mass / period])
        limits.append((Limit.CEILING, *point))
    if whole in (0, 1):
        passive = [passive_stiffness(device, b, period, whole) for b in dampings]
        limits.append((Limit.PASSIVE, np.array(passive), dampings))
    if whole == 0 and low == 0.0:
        limit = quantised_stiffness(
            device, dataset["coulomb"].item(), dataset["count"].item(), period
        )
        limits.append((Limit.QUANTISED, np.array([limit]), np.array([0.0])))
    return limits
