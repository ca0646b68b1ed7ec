"""Text in the figures of a sweep: labels of axes, titles of panels, shared parameters."""

import math
import tomllib
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from canwall.config import short_law
from canwall.sweep.axes import STRIKES

if TYPE_CHECKING:
    from matplotlib.axis import Axis

#: Axis labels.
LABELS = {
    "stiffness": "K [N·m/rad]",
    "stiffness_normalised": "K·T²/m",
    "damping": "B [N·m·s/rad]",
    "damping_normalised": "B·T/m",
    "rate": "rate of the SYNC [Hz]",
    "delay": "delay D [cycles]",
    "model_error": "relative error of the model's inertia",
    "counts": "encoder [counts per turn]",
    "torque_step": "torque step [N·m]",
    "breakaway": "stiction over Coulomb friction",
    "sync_jitter": "standard deviation of the SYNC [s]",
    "press_torque": "torque with which the hand presses [N·m]",
}
#: Values of an axis in the title of a panel.
_TITLES = {
    "stiffness": "K = {} N·m/rad",
    "stiffness_normalised": "K·T²/m = {}",
    "damping": "B = {} N·m·s/rad",
    "damping_normalised": "B·T/m = {}",
    "rate": "{} Hz",
    "delay": "D = {}",
    "model": "model: {}",
    "operator": "operator: {}",
}


def axis_name(dataset: xr.Dataset, names: tuple[str, ...]) -> str:
    """Return the one of these names that the dataset has as an axis."""
    return next(name for name in names if name in dataset.coords)


def label_logarithmic(axis: "Axis") -> None:
    """Label a logarithmic axis with some round numbers, over less than a decade as well."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

    low, high = axis.get_view_interval()
    if high < 10.0 * low:
        axis.set_major_locator(MaxNLocator(5, steps=(1, 2, 5, 10)))
    else:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 100.0 * low else (1.0,)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def panel_title(dataset: xr.Dataset, point: dict[str, int]) -> str:
    """Return the title of a panel: the values in which it differs from the others.

    point: index of the panel on each of the axes.
    """
    parts = []
    for name, index in point.items():
        if dataset.sizes[name] > 1 or name in ("law", "operator"):
            title = _TITLES.get(name, "{}" if name == "law" else f"{name} = {{}}")
            value = dataset[name].values[index]
            parts.append(title.format(short_law(value) if isinstance(value, str) else f"{value:g}"))
    return ", ".join(parts)


def shared_parameters(dataset: xr.Dataset) -> str:
    """Return a line with the parameters that all panels share."""
    formats = (
        ("period", "T = {:g} ms", 1e3),
        ("loop_delay", "D = {:g}", 1.0),
        ("inertia", "m = {:.3g} kg·m²", 1.0),
        ("viscous", "b = {:.3g} N·m·s/rad", 1.0),
        ("coulomb", "f_c = {:.3g} N·m", 1.0),
        ("count", "Δ = {:.3g} µrad", 1e6),
        ("force_step", "torque step {:.3g} mN·m", 1e3),
    )
    parts = []
    for name, text, scale in formats:
        values = np.unique(dataset[name].values)
        if len(values) == 1:
            parts.append(text.format(values[0] * scale))
    # An axis that the figure shows at one of its values.
    for name in ("damping", "damping_normalised"):
        if name in dataset.coords and name not in dataset.dims:
            value = dataset[name].item()
            ratio = None if value else _damping_ratio(dataset)
            parts.append(_TITLES[name].format(f"{value:g}") if ratio is None else f"ζ = {ratio:g}")
    strikes = math.prod(dataset.sizes[name] for name in STRIKES)
    parts.append("1 strike" if strikes == 1 else f"the worst of {strikes} strikes")
    return ", ".join(parts)


def _damping_ratio(dataset: xr.Dataset) -> float | None:
    """Return the damping ratio of the configuration, which stands in for a damping of 0."""
    ratio: float = tomllib.loads(dataset.attrs["configuration"])["wall"]["damping_ratio"]
    return ratio or None
