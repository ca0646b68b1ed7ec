"""Figures of a sweep, drawn from its Dataset alone (`canwall plot FILE.nc`)."""

import itertools
import math
import textwrap
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from canwall.analysis.analytic_limits import stable_stiffness
from canwall.config import short_law
from canwall.errors import InputError
from canwall.figure_style import CHATTER, DPI, REFERENT, STYLE, line_style
from canwall.sweep.axes import DAMPING, STIFFNESS, STRIKES
from canwall.sweep.labels import (
    LABELS,
    axis_name,
    has_damping_ratio,
    label_logarithmic,
    panel_title,
    shared_parameters,
)
from canwall.sweep.z_width import draw_z_width

#: Panels of one figure; further ones go into further figures.
_PANELS = 6
#: Widths of a panel and of a figure's margins [inches].
_PANEL_IN, _MARGIN_IN = 3.5, 1.0
#: Letters of a legend per inch, and those that the handle of an entry and its gaps take.
_LETTERS_PER_INCH, _HANDLE_LETTERS = 13.0, 9
#: Letters of a line of a panel's title, as wide as its axes.
_TITLE_LETTERS = 38

Draw = Callable[[Axes, xr.Dataset], None]
_Kind: TypeAlias = tuple[str, xr.Dataset, tuple[str, ...], Draw]


def write_sweep_figures(dataset: xr.Dataset, stem: Path) -> list[Path]:
    """Draw every figure that the axes of the sweep allow.

    Args:
        dataset: Result of a sweep.
        stem: Path of the figures without "-NAME.png".

    Returns:
        Paths of the figures.

    Raises:
        InputError: If the sweep is a single stiffness, or the result of a table, or the figures
            cannot be written.
    """
    written: list[Path] = []
    for name, figure in draw_sweep(dataset):
        path = stem.with_name(f"{stem.name}-{name}.png")
        try:
            with mpl.rc_context(STYLE):
                figure.savefig(path)
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror or error}") from None
        written.append(path)
    return written


def draw_sweep(dataset: xr.Dataset) -> Iterator[tuple[str, Figure]]:
    """Yield name and figure of everything that the axes of the sweep allow to be drawn.

    Raises InputError if the sweep is a single stiffness, or the result of a table.
    """
    if "table" in dataset.attrs:
        raise InputError(
            f"{dataset.attrs['title']}: a table has no figures; canwall sweep --table "
            f"{dataset.attrs['table']} prints it"
        )
    if gone := [axis for axis in ("law", *STRIKES) if axis not in dataset.dims]:
        raise InputError(
            f"{', '.join(gone)}: no axis of this Dataset; figures are of whole sweeps: select with "
            f"a list, {gone[0]}=[…]"
        )
    kinds = _kinds(dataset)
    if not kinds:
        raise InputError("the sweep has a single stiffness: there is nothing to draw")
    for name, of_kind, drawn, draw in kinds:
        with mpl.rc_context(STYLE):
            figures = _draw_panels(of_kind, drawn, draw)
        for number, figure in enumerate(figures, start=1):
            yield f"{name}-{number}" if len(figures) > 1 else name, figure


def _kinds(dataset: xr.Dataset) -> Sequence[_Kind]:
    """Return the kinds of figures: name, part of the sweep, axes within its panels, drawing."""
    if "worst" in dataset:
        over: list[_Kind] = [
            (f"limit-over-{axis.replace('.', '-')}", dataset, ("law", axis), _limit_over(axis))
            for axis in _lines_over(dataset["worst"])
        ]
        return over or [("limits", dataset, ("law",), _limits_by_law)]
    stiffness, damping = (axis_name(dataset, pair) for pair in (STIFFNESS, DAMPING))
    if dataset.sizes[stiffness] == 1:
        return []
    # Over K at the least damping; the map shows the others.
    least = dataset.isel({damping: 0})
    kinds: list[_Kind] = [
        (name, least, ("law", stiffness), draw(stiffness))
        for name, draw in (
            ("energy", _energy),
            ("amplitude", _amplitude),
            ("frequency", _frequency),
        )
    ]
    if dataset.sizes[damping] > 1:
        kinds.append(("z-width", dataset, (damping, stiffness), draw_z_width))
    return kinds


def _lines_over(array: xr.DataArray) -> list[str]:
    """Return the numeric axes with three values or more; without any, those with two."""
    numbers = [str(d) for d in array.dims if array[d].dtype.kind in "if" and array.sizes[d] > 1]
    return [d for d in numbers if array.sizes[d] > 2] or numbers


def _draw_panels(dataset: xr.Dataset, drawn: tuple[str, ...], draw: Draw) -> list[Figure]:
    """Draw a panel for each point of the axes that are not drawn inside the panels."""
    others = [str(d) for d in dataset.sizes if d not in drawn and d not in STRIKES]
    points = list(itertools.product(*(range(dataset.sizes[d]) for d in others)))
    figures = []
    for number in range(math.ceil(len(points) / _PANELS)):
        of_figure = points[number * _PANELS : (number + 1) * _PANELS]
        columns = min(len(of_figure), 2)
        rows = math.ceil(len(of_figure) / columns)
        width = _PANEL_IN * columns + _MARGIN_IN
        figure = Figure(figsize=(width, 3.3 * rows + 0.7), layout="constrained", dpi=DPI)
        for position, point in enumerate(of_figure, start=1):
            axes = figure.add_subplot(rows, columns, position)
            draw(axes, dataset.isel(dict(zip(others, point, strict=True))))
            title = panel_title(dataset, dict(zip(others, point, strict=True)))
            axes.set_title(textwrap.fill(title, _TITLE_LETTERS, break_on_hyphens=False))
        # Lines end between two parameters.
        joined = shared_parameters(dataset).replace(" ", "\N{NO-BREAK SPACE}")
        separated = joined.replace(",\N{NO-BREAK SPACE}", ", ")
        parameters = textwrap.fill(separated, round(13 * width))
        figure.suptitle(parameters, fontsize=9, color="0.3", x=0.01, ha="left")
        handles, labels = _legend(figure)
        if handles:
            room = int(_LETTERS_PER_INCH * width / (max(map(len, labels)) + _HANDLE_LETTERS))
            ncols = max(1, min(room, len(labels)))
            figure.legend(handles, labels, loc="outside lower center", ncols=ncols)
        figures.append(figure)
    return figures


def _legend(figure: Figure) -> tuple[list[Any], list[str]]:
    """Collect handles and labels of all panels, each label once."""
    handles: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
        for patch in getattr(axes, "canwall_patches", ()):
            handles.setdefault(patch.get_label(), patch)
    return list(handles.values()), list(handles)


def _styles(dataset: xr.Dataset) -> list[tuple[str, dict[str, Any]]]:
    """Return each law with the style of its lines; markers distinguish lines that coincide."""
    return [(str(law), line_style(i)) for i, law in enumerate(np.atleast_1d(dataset["law"].values))]


def _limit_over(axis: str) -> Draw:
    def draw(axes: Axes, dataset: xr.Dataset) -> None:
        x = dataset[axis].values
        for law, style in _styles(dataset):
            one = dataset.sel(law=law)
            worst = one["worst_normalised"].values
            best = (one["limit"].max(STRIKES) * one["period"] ** 2 / one["inertia"]).values
            axes.plot(x, worst, ms=4, mfc="none", label=short_law(law), **style)
            axes.fill_between(x, worst, best, color=style["color"], alpha=0.08, lw=0)
        linear = _linear_limit(dataset.isel(law=0), axis)
        if linear is not None:
            walls = "spring alone" if has_damping_ratio(dataset) else "spring and damper"
            axes.plot(x, linear, "k--", lw=1.0, label=f"{walls}, linear, exact")
        if dataset["worst_normalised"].max() > 0:
            axes.set_yscale("log")
            label_logarithmic(axes.yaxis)
        axes.set_xlabel(LABELS.get(axis, axis))
        axes.set_ylabel("K-limit, K·T²/m [1] (band: strikes)")

    return draw


def _linear_limit(dataset: xr.Dataset, axis: str) -> NDArray[np.float64] | None:
    """Return K·T²/m up to which the sampled spring and damper are stable; None for fractional D."""
    limits = []
    for i in range(dataset.sizes[axis]):
        point = dataset.isel({axis: i})
        mass, viscous, period, delay = (
            point[name].item() for name in ("inertia", "viscous", "period", "loop_delay")
        )
        if delay != int(delay):
            return None
        name = axis_name(dataset, DAMPING)
        damping = point[name].item() * (mass / period if name == "damping_normalised" else 1.0)
        stiffness = stable_stiffness(mass, viscous, damping, period, int(delay))
        limits.append(stiffness * period**2 / mass)
    return np.array(limits)


def _limits_by_law(axes: Axes, dataset: xr.Dataset) -> None:
    for row, (law, style) in enumerate(_styles(dataset)):
        colour = style["color"]
        one = dataset.sel(law=law)
        strikes = (one["limit"] * one["period"] ** 2 / one["inertia"]).values.ravel()
        axes.plot(strikes, np.full(strikes.shape, row), ".", color=colour, alpha=0.5)
        axes.plot(one["worst_normalised"].item(), row, "D", color=colour)
    axes.set_yticks(range(dataset.sizes["law"]), [short_law(law) for law, _ in _styles(dataset)])
    axes.invert_yaxis()
    if dataset["limit"].max() > 0:
        axes.set_xscale("log")
        label_logarithmic(axes.xaxis)
    axes.set_xlabel("K-limit, K·T²/m [1] (◆ worst, · each strike)")


def _label_over_stiffness(axes: Axes, dataset: xr.Dataset, name: str, label: str) -> None:
    axes.set_xscale("log")
    low, high = dataset[name].values[[0, -1]]
    axes.set_xlim(low / 1.05, high * 1.05)
    label_logarithmic(axes.xaxis)
    axes.set_xlabel(LABELS[name])
    axes.set_ylabel(label)


def _energy(stiffness: str) -> Draw:
    def draw(axes: Axes, dataset: xr.Dataset) -> None:
        for law, style in _styles(dataset):
            one = dataset.sel(law=law)
            worst = one["energy_out"].max(STRIKES).values * 1e6
            chatters = one["chatters"].any(STRIKES).values
            x = one[stiffness].values
            axes.plot(x, worst, label=short_law(law), **style | {"marker": ""})
            axes.plot(x[chatters], worst[chatters], "x", color=CHATTER, ms=5, zorder=3)
        # One count times the peak torque: the resolution of the energy.
        tolerance = dataset["energy_tolerance"].max((*STRIKES, "law")).values * 1e6
        axes.plot(
            dataset[stiffness].values,
            tolerance,
            color=REFERENT,
            ls=(0, (8, 2, 1, 2)),
            lw=0.9,
            label="one encoder count × peak torque",
        )
        axes.set_yscale("symlog", linthresh=1.0)
        axes.set_ylim(bottom=-0.1)
        label = "energy out, worst strike [µJ] (×: chatters)"
        _label_over_stiffness(axes, dataset, stiffness, label)

    return draw


def _amplitude(stiffness: str) -> Draw:
    def draw(axes: Axes, dataset: xr.Dataset) -> None:
        for law, style in _styles(dataset):
            worst = dataset["amplitude"].sel(law=law).max(STRIKES).values * 1e3
            axes.plot(
                dataset[stiffness].values, worst, ms=3, mfc="none", label=short_law(law), **style
            )
        axes.set_yscale("symlog", linthresh=0.01)
        # No chatter is drawn as zero: keep that line off the axis.
        axes.set_ylim(bottom=-0.001)
        _label_over_stiffness(axes, dataset, stiffness, "amplitude of chatter, worst strike [mrad]")

    return draw


def _frequency(stiffness: str) -> Draw:
    def draw(axes: Axes, dataset: xr.Dataset) -> None:
        for law, style in _styles(dataset):
            frequency = dataset["frequency"].sel(law=law).transpose(stiffness, ...).values
            frequency = frequency.reshape(len(frequency), -1)
            x = np.repeat(dataset[stiffness].values, frequency.shape[1])
            chatters = frequency.ravel() > 0.0
            points = style | {"ls": "none", "mfc": "none", "ms": 4}
            axes.plot(x[chatters], frequency.ravel()[chatters], label=short_law(law), **points)
        axes.set_ylim(0.0, max(axes.get_ylim()[1], 10.0))
        _label_over_stiffness(axes, dataset, stiffness, "frequency of chatter, each strike [Hz]")

    return draw
