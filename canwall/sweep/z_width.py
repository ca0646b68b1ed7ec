"""Z-width map: walls on which no strike chatters, with the analytic limits (theory, section 6)."""

from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from canwall.analysis.analytic_limits import (
    CEILINGS,
    delayed_stiffness,
    passive_stiffness,
    quantised_stiffness,
    stable_stiffness,
)
from canwall.sweep.axes import DAMPING, STIFFNESS, STRIKES
from canwall.sweep.labels import LABELS, axis_name

Array = NDArray[np.float64]

_FREE, _CHATTERS = "#cfe8dc", "#f6d5c3"
#: Points of each line.
_POINTS = 60


@dataclass(frozen=True)
class _LimitLine:
    """Largest stiffnesses [N·m/rad] over dampings [N·m·s/rad], as a line or a single point."""

    label: str
    stiffness: Array
    damping: Array
    colour: str
    dashes: str = "-"
    mark: str = "none"


def draw_z_width(axes: Axes, dataset: xr.Dataset) -> None:
    """Draw the map of one condition, K against B, with the limits of a spring-damper wall."""
    stiffness, damping = (axis_name(dataset, pair) for pair in (STIFFNESS, DAMPING))
    mass, period = dataset["inertia"].item(), dataset["period"].item()
    x_unit = mass / period**2 if stiffness == "stiffness_normalised" else 1.0
    y_unit = mass / period if damping == "damping_normalised" else 1.0
    chatters = dataset["chatters"].any(STRIKES).transpose(damping, stiffness).values
    axes.pcolormesh(
        dataset[stiffness].values,
        dataset[damping].values,
        np.where(chatters, 1.0, 0.0),
        cmap=mpl.colors.ListedColormap([_FREE, _CHATTERS]),
        vmin=0.0,
        vmax=1.0,
        shading="nearest",
    )
    axes.canwall_patches = (  # type: ignore[attr-defined]
        Patch(color=_FREE, label="no strike chatters"),
        Patch(color=_CHATTERS, label="chatters"),
    )
    left, right = dataset[stiffness].values[[0, -1]]
    low, high = dataset[damping].values[[0, -1]]
    for limit in _analytic_limits(dataset, low * y_unit, high * y_unit):
        x, y = limit.stiffness / x_unit, limit.damping / y_unit
        is_point = len(x) == 1
        if not np.any((left <= x) & (x <= right) & (low <= y) & (y <= high)):
            continue  # a line outside the map would still be in its legend
        axes.add_line(
            Line2D(
                x,
                y,
                color=limit.colour,
                ls=limit.dashes,
                marker=limit.mark,
                ms=7,
                # Do not cut off a point on the edge.
                clip_on=not is_point,
                zorder=3,
                label=limit.label,
            )
        )
    axes.set_xscale("log")
    axes.set_xlim(left, right)
    axes.set_ylim(low, high)
    axes.set_xlabel(LABELS[stiffness])
    axes.set_ylabel(LABELS[damping])


def _analytic_limits(dataset: xr.Dataset, low: float, high: float) -> list[_LimitLine]:
    """Return the limits that exist for the delay of the map, for dampings from low to high."""
    mass, viscous, device, period, delay = (
        dataset[name].item()
        for name in ("inertia", "viscous", "device_viscous", "period", "loop_delay")
    )
    # Passivity ends at B equal to the device's own damping, which may be a small part of the map.
    fine = np.linspace(0.0, device, _POINTS // 3)
    dampings = np.linspace(low, high, _POINTS)
    dampings = np.unique(np.concatenate((dampings, fine[(low <= fine) & (fine <= high)])))
    approximate = [delayed_stiffness(viscous, b, period, delay) for b in dampings]
    lines = [
        _LimitLine(
            "spring and damper: (b + B)/(T/2 + D·T)",
            np.array(approximate),
            dampings,
            "#0072B2",
        )
    ]
    if delay not in CEILINGS and delay != int(delay):
        return lines
    whole = int(delay)
    exact = [stable_stiffness(mass, viscous, b, period, whole) for b in dampings]
    lines.append(_LimitLine("the same, exact", np.array(exact), dampings, "#000000", "--"))
    if whole in CEILINGS:
        ceiling, at = CEILINGS[whole]
        lines.append(
            _LimitLine(
                "the same, ceiling at b = 0",
                np.array([ceiling * mass / period**2]),
                np.array([at * mass / period]),
                "#000000",
                "none",
                "*",
            )
        )
    if whole in (0, 1):
        passive = [passive_stiffness(device, b, period, whole) for b in dampings]
        lines.append(
            _LimitLine(
                "passive with any operator (Colgate, Schenkel)",
                np.array(passive),
                dampings,
                "#CC79A7",
                "-.",
            )
        )
    if whole == 0 and low == 0.0:
        limit = quantised_stiffness(
            device, dataset["coulomb"].item(), dataset["count"].item(), period
        )
        lines.append(
            _LimitLine(
                "passive with encoder, B = 0 (Abbott, Okamura)",
                np.array([limit]),
                np.array([0.0]),
                "#D55E00",
                "none",
                "^",
            )
        )
    return lines
