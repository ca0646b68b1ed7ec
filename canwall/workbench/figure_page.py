"""A figure with its data and with what is to be said of it: on disk a PNG, a CSV, and a text."""

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

# One colour for one thing, in every figure.
FORCE, RENDERED, SAMPLES, ACCENT = COLOURS[0], COLOURS[5], COLOURS[1], COLOURS[2]
REFERENT = "0.25"


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """What cannot be written there is an InputError."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from None


@dataclass(frozen=True)
class FigurePage:
    """One figure: `name` of its files, what the source claims of it, what the numbers show.

    columns are what is plotted, of one length; their names carry the units.
    """

    name: str
    title: str
    claim: str
    finding: str
    columns: Mapping[str, NDArray[Any]]
    figure: Figure

    def write(self, folder: Path) -> None:
        """PNG and CSV into the folder; all digits of a double. Raises InputError."""
        rows = zip(*(column.tolist() for column in self.columns.values()), strict=True)
        with writing(folder):
            self.figure.savefig(folder / f"{self.name}.png")
            with (folder / f"{self.name}.csv").open("w", encoding="utf-8", newline="") as file:
                writer = csv.writer(file, lineterminator="\n")
                writer.writerow(self.columns)
                writer.writerows(rows)

    def text(self) -> str:
        """Its section of the index, in Markdown."""
        return (
            f"## {self.title}\n\n![{self.title}]({self.name}.png)\n\n"
            f"*The chapter:* {self.claim}\n\n*Here:* {self.finding} "
            f"([data]({self.name}.csv))\n"
        )


def blank(title: str, x: str, y: str, size: tuple[float, float] = (9.0, 4.6)) -> tuple[Figure, Any]:
    """A figure of one pair of axes."""
    figure = Figure(figsize=size, layout="constrained", dpi=120)
    axes = figure.add_subplot()
    axes.set_title(title)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    return figure, axes


def legend_below(figure: Figure, axes: Axes) -> None:
    """The legend where no data can be."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5)


def stairs(axes: Axes, t: Array, level: Array, label: str, **style: Any) -> None:
    """What is held from each sample to the next."""
    axes.step(t, level, where="post", **{"color": FORCE, "lw": 1.3, "label": label, **style})
