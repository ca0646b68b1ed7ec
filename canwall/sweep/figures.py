"""The figures of a sweep, drawn from its Dataset alone (`canwall plot FILE.nc`)."""

import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from canwall.errors import InputError
from canwall.plots import COLOURS, STYLE
from canwall.sweep.analytic import (
    delayed_stiffness,
    passive_stiffness,
    quantised_stiffness,
    stable_stiffness,
)
from canwall.sweep.axes import DAMPING, STIFFNESS, STRIKES

#: Panels of one figure; what else there is goes into figures of its own.
_PANELS = 6
_LABELS = {
    "stiffness": "K [N·m/rad]",
    "stiffness_normalised": "K·T²/m",
    "damping": "B [N·m·s/rad]",
    "damping_normalised": "B·T/m",
    "rate": "rate of the SYNC [Hz]",
    "delay": "delay D [cycles]",
    "model_error": "relative error of the model's inertia",
    "counts": "encoder [counts per turn]",
    "torque_step": "torque step [N·m]",
}
#: Lines of one colour are told apart by these.
_DASHES = ("-", "--", "-.", ":")

Draw = Callable[[Axes, xr.Dataset], None]


def write_sweep_figures(dataset: xr.Dataset, stem: Path) -> list[Path]:
    """Every figure that the axes of a sweep allow, as STEM-NAME.png; their paths.

    Raises InputError where there is none, or where they cannot be written.
    """
    written: list[Path] = []
    with mpl.rc_context(STYLE):
        if "worst" in dataset:
            for axis in _long_axes(dataset["worst"]):
                if axis != "law" and dataset[axis].dtype.kind in "if":
                    label = f"limit-over-{axis.replace('.', '-')}"
                    written += _paneled(dataset, stem, label, ("law", axis), _limit_over(axis))
            if not written:
                written += _paneled(dataset, stem, "limits", ("law",), _limits_by_law)
        else:
            stiffness, damping = (_named(dataset, pair) for pair in (STIFFNESS, DAMPING))
            if dataset.sizes[stiffness] > 1:
                # Over K at the least damping; the map shows the others.
                least = dataset.isel({damping: 0})
                over = ("law", stiffness)
                written += _paneled(least, stem, "energy", over, _energy(stiffness))
                written += _paneled(least, stem, "amplitude", over, _chatter(stiffness))
                written += _paneled(least, stem, "frequency", over, _frequency(stiffness))
            if dataset.sizes[damping] > 1 and dataset.sizes[stiffness] > 1:
                written += _paneled(dataset, stem, "z-width", (damping, stiffness), _z_width)
    if not written:
        raise InputError("the sweep has one point alone: there is nothing to draw")
    return written


def _named(dataset: xr.Dataset, names: tuple[str, ...]) -> str:
    return next(name for name in names if name in dataset.dims)


def _long_axes(array: xr.DataArray) -> list[str]:
    return [str(dim) for dim in array.dims if array.sizes[dim] > 1]


def _paneled(
    dataset: xr.Dataset, stem: Path, name: str, kept: tuple[str, ...], draw: Draw
) -> list[Path]:
    """A panel for each point of the axes that the panels do not have."""
    others = [str(d) for d in dataset.sizes if d not in kept and d not in STRIKES]
    points = list(itertools.product(*(range(dataset.sizes[d]) for d in others)))
    paths = []
    for number in range(math.ceil(len(points) / _PANELS)):
        shown = points[number * _PANELS : (number + 1) * _PANELS]
        columns = min(3, len(shown))
        rows = math.ceil(len(shown) / columns)
        figure = Figure(figsize=(4.6 * columns + 1.0, 3.8 * rows), layout="constrained", dpi=120)
        for place, point in enumerate(shown, start=1):
            axes = figure.add_subplot(rows, columns, place)
            draw(axes, dataset.isel(dict(zip(others, point, strict=True))))
            axes.set_title(_title(dataset, dict(zip(others, point, strict=True))))
        handles, labels = _legend(figure)
        if handles:
            figure.legend(handles, labels, loc="outside lower center", ncols=min(4, len(labels)))
        last = f"-{number + 1}" if len(points) > _PANELS else ""
        path = stem.with_name(f"{stem.name}-{name}{last}.png")
        try:
            figure.savefig(path)
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror or error}") from None
        paths.append(path)
    return paths


def _title(dataset: xr.Dataset, point: dict[str, int]) -> str:
    parts = []
    for name, place in point.items():
        if dataset.sizes[name] > 1 or name in ("law", "operator"):
            value = dataset[name].values[place]
            said = value if isinstance(value, str) else f"{name} {value:g}"
            parts.append(f"operator {said}" if name == "operator" else said)
    return ", ".join(parts)


def _legend(figure: Figure) -> tuple[list[Any], list[str]]:
    """Each label once, whatever the panel."""
    found: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
        for patch in getattr(axes, "canwall_patches", ()):
            found.setdefault(patch.get_label(), patch)
    return list(found.values()), list(found)


def _styles(dataset: xr.Dataset) -> list[tuple[str, str, str]]:
    """Law, colour and dashes."""
    return [
        (str(law), COLOURS[i % 6], _DASHES[i // 6 % 4])
        for i, law in enumerate(np.atleast_1d(dataset["law"].values))
    ]


def _limit_over(axis: str) -> Draw:
    def draw(axes: Axes, dataset: xr.Dataset) -> None:
        x = dataset[axis].values
        for law, colour, dashes in _styles(dataset):
            one = dataset.sel(law=law)
            worst = one["worst_normalised"].values
            best = worst * (one["limit"].max(STRIKES) / one["worst"].where(one["worst"] > 0)).values
            axes.plot(x, worst, dashes, marker="o", ms=3, color=colour, label=law)
            axes.fill_between(x, worst, best, color=colour, alpha=0.12, lw=0)
        if dataset["worst_normalised"].max() > 0:
            axes.set_yscale("log")
        axes.set_xlabel(_LABELS.get(axis, axis))
        axes.set_ylabel("K-limit, K·T²/m (band: strikes)")

    return draw


def _limits_by_law(axes: Axes, dataset: xr.Dataset) -> None:
    for place, (law, colour, _) in enumerate(_styles(dataset)):
        one = dataset.sel(law=law)
        scale = one["worst_normalised"].item() / one["worst"].item() if one["worst"] > 0 else 0.0
        strikes = one["limit"].values.ravel() * scale
        axes.plot(strikes, np.full(strikes.shape, place), ".", color=colour, alpha=0.5)
        axes.plot(one["worst_normalised"].item(), place, "D", color=colour)
    axes.set_yticks(range(dataset.sizes["law"]), [law for law, _, _ in _styles(dataset)])
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlabel("K-limit, K·T²/m (◆ worst, · each strike)")


def _over_stiffness(axes: Axes, dataset: xr.Dataset, name: str, label: str) -> None:
    axes.set_xscale("log")
    axes.set_xlim(*dataset[name].values[[0, -1]])
    axes.set_xlabel(_LABELS[name])
    axes.set_ylabel(label)


def _energy(stiffness: str) -> Draw:
    def draw(axes: Axes, dataset: xr.Dataset) -> None:
        for law, colour, dashes in _styles(dataset):
            one = dataset.sel(law=law)
            worst = one["energy_out"].max(STRIKES).values * 1e6
            chatters = one["chatters"].any(STRIKES).values
            x = one[stiffness].values
            axes.plot(x, worst, dashes, color=colour, label=law)
            axes.plot(x[chatters], worst[chatters], "x", color=colour, ms=4)
        # One count times the peak torque: what the encoder cannot tell.
        tolerance = dataset["energy_tolerance"].max((*STRIKES, "law")).values * 1e6
        axes.plot(dataset[stiffness].values, tolerance, color="0.4", lw=0.8, label="1 count × peak")
        axes.set_yscale("symlog", linthresh=1.0)
        axes.set_ylim(bottom=0.0)
        _over_stiffness(axes, dataset, stiffness, "energy out, worst strike [µJ] (×: chatters)")

    return draw


def _chatter(stiffness: str) -> Draw:
    def draw(axes: Axes, dataset: xr.Dataset) -> None:
        for law, colour, dashes in _styles(dataset):
            worst = dataset["amplitude"].sel(law=law).max(STRIKES).values * 1e3
            axes.plot(dataset[stiffness].values, worst, dashes, color=colour, label=law)
        axes.set_yscale("symlog", linthresh=0.01)
        axes.set_ylim(bottom=0.0)
        _over_stiffness(axes, dataset, stiffness, "amplitude of chatter, worst strike [mrad]")

    return draw


def _frequency(stiffness: str) -> Draw:
    def draw(axes: Axes, dataset: xr.Dataset) -> None:
        for law, colour, _ in _styles(dataset):
            found = dataset["frequency"].sel(law=law).transpose(stiffness, ...).values
            found = found.reshape(len(found), -1)
            x = np.repeat(dataset[stiffness].values, found.shape[1])
            seen = found.ravel() > 0.0
            axes.plot(x[seen], found.ravel()[seen], ".", color=colour, ms=4, label=law)
        _over_stiffness(axes, dataset, stiffness, "frequency of chatter, each strike [Hz]")

    return draw


def _z_width(axes: Axes, dataset: xr.Dataset) -> None:
    """Where no strike chatters, and the analytic limits over it."""
    stiffness, damping = (_named(dataset, pair) for pair in (STIFFNESS, DAMPING))
    mass, period = dataset["inertia"].item(), dataset["period"].item()
    x_unit = mass / period**2 if stiffness == "stiffness_normalised" else 1.0
    y_unit = mass / period if damping == "damping_normalised" else 1.0
    chatters = dataset["chatters"].any(STRIKES).transpose(damping, stiffness).values
    axes.pcolormesh(
        dataset[stiffness].values,
        dataset[damping].values,
        np.where(chatters, 1.0, 0.0),
        cmap=mpl.colors.ListedColormap(["#cfe8dc", "#f6d5c3"]),
        vmin=0.0,
        vmax=1.0,
        shading="nearest",
    )
    axes.canwall_patches = (  # type: ignore[attr-defined]
        Patch(color="#cfe8dc", label="no strike chatters"),
        Patch(color="#f6d5c3", label="chatters"),
    )
    delay, viscous = dataset["loop_delay"].item(), dataset["viscous"].item()
    low, high = dataset[damping].values[[0, -1]]
    dampings = np.linspace(low, high, 60) * y_unit
    lines: list[tuple[str, list[float]]] = [
        (
            "linear, small b·T/m: (b + B)/(T/2 + D·T)",
            [delayed_stiffness(viscous, b, period, delay) for b in dampings],
        )
    ]
    if delay == int(delay):
        lines.append(
            (
                "linear, exact",
                [stable_stiffness(mass, viscous, b, period, int(delay)) for b in dampings],
            )
        )
    device = dataset["device_viscous"].item()
    if delay in (0.0, 1.0):
        lines.append(
            (
                "passive (Colgate, Schenkel; D)",
                [passive_stiffness(device, b, period, int(delay)) for b in dampings],
            )
        )
    if delay == 0.0:
        limit = quantised_stiffness(
            device, dataset["coulomb"].item(), dataset["count"].item(), period
        )
        lines.append(("passive, quantised (Abbott, Okamura; B = 0)", [limit] * 60))
    axes.set_xscale("log")
    box = dataset[stiffness].values[[0, -1]]
    for (label, limits), colour, dashes in zip(lines, COLOURS[1:], _DASHES, strict=False):
        axes.add_line(
            Line2D(
                np.array(limits) / x_unit, dampings / y_unit, color=colour, ls=dashes, label=label
            )
        )
    axes.set_xlim(*box)
    axes.set_ylim(low, high)
    axes.set_xlabel(_LABELS[stiffness])
    axes.set_ylabel(_LABELS[damping])
