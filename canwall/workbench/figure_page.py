"""A figure with its data, the claim of the source and the finding: PNG, CSV and Markdown."""

import csv
import textwrap
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from canwall.errors import InputError
from canwall.figure_style import COLOURS, COLUMN_IN, DPI
from canwall.figure_style import REFERENT as REFERENT

Array = NDArray[np.float64]

#: Letters of a title per inch of its figure.
_LETTERS_PER_INCH = 12.0

# Colours with the same meaning in every figure.
FORCE, RENDERED, SAMPLES, ACCENT = COLOURS[5], COLOURS[4], COLOURS[0], COLOURS[3]


@contextmanager
def raising_input_error(folder: Path) -> Iterator[None]:
    """Turn an OSError while the folder is written into an InputError."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from None


@dataclass(frozen=True)
class FigurePage:
    """One figure with its data and text.

    Attributes:
        name: Name of its files.
        title: Title.
        claim: What the source says of it, or, of a figure that it does not have, what it shows.
        finding: What the numbers show.
        columns: Plotted data by column name with unit, all of one length; none of a diagram.
        figure: The figure itself.
    """

    name: str
    title: str
    claim: str
    finding: str
    columns: Mapping[str, NDArray[Any]]
    figure: Figure

    def write(self, folder: Path) -> None:
        """Write PNG and, of data, CSV in full precision into the folder. Raises InputError."""
        rows = zip(*(column.tolist() for column in self.columns.values()), strict=True)
        with raising_input_error(folder):
            self.figure.savefig(folder / f"{self.name}.png")
            if not self.columns:
                return
            with (folder / f"{self.name}.csv").open("w", encoding="utf-8", newline="") as file:
                writer = csv.writer(file, lineterminator="\n")
                writer.writerow(self.columns)
                writer.writerows(rows)

    def text(self) -> str:
        """Return its section of the index, in Markdown."""
        data = f" ([data]({self.name}.csv))" if self.columns else ""
        says = "The chapter" if self.name.startswith("figure_") else "Shown"
        return (
            f"## {self.title}\n\n![{self.title}]({self.name}.png)\n\n"
            f"*{says}:* {self.claim}\n\n*Here:* {self.finding}{data}\n"
        )


def blank(
    title: str, x: str, y: str, size: tuple[float, float] = (COLUMN_IN, 3.4)
) -> tuple[Figure, Any]:
    """Make a figure with one pair of axes, as wide as a column if no size is given [inches]."""
    figure = Figure(figsize=size, layout="constrained", dpi=DPI)
    axes = figure.add_subplot()
    axes.set_title(textwrap.fill(title, round(_LETTERS_PER_INCH * size[0])))
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    return figure, axes


def legend_below(figure: Figure, axes: Axes) -> None:
    """Put the legend below the axes, clear of the data."""
    handles, labels = axes.get_legend_handles_labels()
    columns = 2 if figure.get_size_inches()[0] <= COLUMN_IN else 3
    figure.legend(handles, labels, loc="outside lower center", ncols=columns)


def stairs(axes: Axes, t: Array, level: Array, label: str, **style: Any) -> None:
    """Draw a level that is held from each sample to the next."""
    axes.step(t, level, where="post", **{"color": FORCE, "lw": 1.3, "label": label, **style})


def mark_delay(axes: Axes, name: str, crossed: float, switched: float) -> None:
    """Shade the time from crossing the surface to the switching of the wall, and name it."""
    axes.axvspan(crossed, switched, color=ACCENT, alpha=0.3, lw=0.0)
    axes.annotate(
        name,
        (0.5 * (crossed + switched), 1.0),
        xycoords=("data", "axes fraction"),
        xytext=(0.0, -3.0),
        textcoords="offset points",
        ha="center",
        va="top",
        fontsize=11,
    )
