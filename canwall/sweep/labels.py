"""Text in the figures of a sweep: labels of axes, titles of panels, shared parameters."""

import math
import tomllib
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from canwall.config import short_law
from canwall.sweep.axes import DAMPING, STRIKES

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
_RATIO = "wall.damping_ratio"


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


def value_text(value: str | float | bool | np.bool_) -> str:
    """Return the text of a value on an axis: a name, a number, or true and false as in TOML."""
    if isinstance(value, str):
        return short_law(value)
    return str(value).lower() if isinstance(value, bool | np.bool_) else f"{value:g}"


def panel_title(dataset: xr.Dataset, point: dict[str, int]) -> str:
    """Return the title of a panel: the values in which it differs from the others.

    point: index of the panel on each of the axes.
    """
    parts = []
    for name, index in point.items():
        if dataset.sizes[name] > 1 or name in ("law", "operator"):
            title = _TITLES.get(name, "{}" if name == "law" else f"{name} = {{}}")
            value = dataset[name].values[index]
            parts.append(title.format(value_text(value)))
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
    damping = dataset[axis_name(dataset, DAMPING)]
    if damping.size == 1:
        value = damping.item()
        ratios = [0.0] if value else _damping_ratios(dataset)
        if ratios == [0.0]:
            parts.append(_TITLES[str(damping.name)].format(f"{value:g}"))
        elif len(ratios) == 1:
            parts.append(f"ζ = {ratios[0]:g}")
    strikes = math.prod(dataset.sizes[name] for name in STRIKES)
    parts.append("1 strike" if strikes == 1 else f"the worst of {strikes} strikes")
    return ", ".join(parts)


def has_damping_ratio(dataset: xr.Dataset) -> bool:
    """Return True if a damping ratio is in force anywhere, in place of a damping of 0."""
    return any(_damping_ratios(dataset))


def _damping_ratios(dataset: xr.Dataset) -> list[float]:
    """Return the damping ratios, of an axis or of the configuration."""
    if _RATIO in dataset.coords:
        return [float(ratio) for ratio in np.atleast_1d(dataset[_RATIO].values)]
    return [tomllib.loads(dataset.attrs["configuration"])["wall"]["damping_ratio"]]
