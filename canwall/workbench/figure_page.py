"""A figure with its data, the claim of the source and the finding: PNG, CSV and Markdown."""

import csv
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
from canwall.figure_style import COLOURS

Array = NDArray[np.float64]

# Colours with the same meaning in every figure.
FORCE, RENDERED, SAMPLES, ACCENT = COLOURS[0], COLOURS[5], COLOURS[1], COLOURS[2]
REFERENT = "0.25"


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
        claim: What the source says of it.
        finding: What the numbers show.
        columns: Plotted data by column name with unit, all of one length.
        figure: The figure itself.
    """

    name: str
    title: str
    claim: str
    finding: str
    columns: Mapping[str, NDArray[Any]]
    figure: Figure

    def write(self, folder: Path) -> None:
        """Write PNG and CSV, in full precision, into the folder. Raises InputError."""
        rows = zip(*(column.tolist() for column in self.columns.values()), strict=True)
        with raising_input_error(folder):
            self.figure.savefig(folder / f"{self.name}.png")
            with (folder / f"{self.name}.csv").open("w", encoding="utf-8", newline="") as file:
                writer = csv.writer(file, lineterminator="\n")
                writer.writerow(self.columns)
                writer.writerows(rows)

    def text(self) -> str:
        """Return its section of the index, in Markdown."""
        return (
            f"## {self.title}\n\n![{self.title}]({self.name}.png)\n\n"
            f"*The chapter:* {self.claim}\n\n*Here:* {self.finding} "
            f"([data]({self.name}.csv))\n"
        )


def blank(title: str, x: str, y: str, size: tuple[float, float] = (9.0, 4.6)) -> tuple[Figure, Any]:
    """Make a figure with one pair of axes."""
    figure = Figure(figsize=size, layout="constrained", dpi=120)
    axes = figure.add_subplot()
    axes.set_title(title)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    return figure, axes


def legend_below(figure: Figure, axes: Axes) -> None:
    """Put the legend below the axes, clear of the data."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5)


def stairs(axes: Axes, t: Array, level: Array, label: str, **style: Any) -> None:
    """Draw a level that is held from each sample to the next."""
    axes.step(t, level, where="post", **{"color": FORCE, "lw": 1.3, "label": label, **style})
