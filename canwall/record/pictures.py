"""Picture of a run, drawn from its record alone."""

import io
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from canwall.config import short_law
from canwall.figure_style import CHATTER, COLOURS, DPI, PAGE_IN, STYLE
from canwall.record.folder import RunFolder, numbers, read_signals, whole_file

if TYPE_CHECKING:
    import pyarrow as pa

Array = NDArray[np.float64]

#: Length of a close-up [s].
_CLOSE_UP_S = 0.045
#: Depth of a strike that counts as one, as a share of the deepest of its law.
_GRAZING = 0.1
#: Columns of the record that the picture needs.
DRAWN = (
    *("t_s", "y", "torque_applied", "force_applied"),
    *("stiffness", "stiffness_in_force", "mass_est", "mass_spread"),
)
#: Fixed title positions: no title here has to avoid ticks, and looking for them takes time.
_QUICK = {"axes.titley": 1.0}
_FAST_PNG = {"compress_level": 1}
#: Margins of the picture and gaps in it [inches]; a layout engine would draw everything twice.
_LEFT, _RIGHT, _TOP, _BOTTOM, _GAP, _AXES_GAP = 0.8, 0.6, 0.3, 0.5, 0.15, 0.75
#: Heights of position, torque, mass and stiffness, and of the close-ups [inches].
_HEIGHTS = (1.75, 1.25, 0.95, 2.2)
#: Columns of pixels in which long signals are drawn, and the width of a letter [points].
_COLUMNS, _LETTER = 1200, 5.2
#: Largest stiffness asked for that is shown, in that of the largest in force.
_MOST_ASKED = 4.0
#: Intervals between ticks; each tick takes time.
_TICKS = 5


def plot_run(folder: RunFolder) -> Path:
    """Draw the run into run.png and return its path.

    Raises:
        ConfigError: If the folder holds no record.
        RecordError: If run.png cannot be written.
    """
    signals, summary = read_signals(folder.signals, DRAWN), folder.read_summary()
    return draw_run(folder.picture, signals, summary["strikes"])


def draw_run(picture: Path, signals: "pa.Table", strikes: list[dict[str, Any]]) -> Path:
    """Draw a run into a PNG file and return its path.

    Raises RecordError if it cannot be written.
    """
    with mpl.rc_context(STYLE | _QUICK):
        # Figure.savefig would draw everything twice, first only for the layout.
        canvas = FigureCanvasAgg(run_figure(signals, strikes))
        with whole_file(picture) as file:
            canvas.print_png(file, pil_kwargs=_FAST_PNG)  # type: ignore[no-untyped-call]
    return picture


def run_figure(signals: "pa.Table", strikes: list[dict[str, Any]]) -> Figure:
    """Draw a run.

    The figure shows position and torque over time with the strikes marked, a close-up of one
    contact of each law (Figure 5.19 of the source), and force over position (Figure 5.3); mass and
    stiffness in force as well if the cycle has found the mass itself, or lowered the stiffness.

    Args:
        signals: Rows of the run, with the columns DRAWN.
        strikes: Strikes of its summary.
    """
    strikes = [strike | {"law": short_law(strike["law"])} for strike in strikes]
    with mpl.rc_context(STYLE | _QUICK):
        colours = law_colours(strikes)
        shown = shown_strikes(signals, strikes)[:2]
        figure, (over_time, torque, *between), details = _lay_out(_finds(signals), len(shown))
        draw_strikes(over_time, signals, strikes, colours)
        over_time.set_title("Strikes on the wall (grey: inside)")
        over_time.tick_params(labelbottom=False)
        _torque(torque, signals, strikes, colours)
        for in_force in between:
            torque.tick_params(labelbottom=False)
            draw_in_force(in_force, signals)
            _mark_strikes(in_force, strikes, colours)
        (between or [torque])[0].set_xlabel("time [s]")
        for axes, strike in zip(details, shown, strict=False):
            _close_up(axes, signals, strike, colours)
        _force_over_position(details[-1], signals, shown, colours)
        for axes in figure.axes:
            axes.locator_params(axis="x", nbins=_TICKS if axes in details else 2 * _TICKS)
            axes.locator_params(axis="y", nbins=_TICKS)
    return figure


@cache
def warm_up() -> None:
    """Draw an empty run into memory, once: what a first picture takes longer is loaded then."""
    import pyarrow as pa

    nothing = pa.table({name: np.zeros(2) for name in DRAWN})
    with mpl.rc_context(STYLE | _QUICK):
        canvas = FigureCanvasAgg(run_figure(nothing, []))
        canvas.print_png(io.BytesIO(), pil_kwargs=_FAST_PNG)  # type: ignore[no-untyped-call]


def _lay_out(finds: bool, close_ups: int) -> tuple[Figure, list[Axes], list[Axes]]:
    """Return a figure with its axes over time and, below, those of the details."""
    heights = [*_HEIGHTS[: 3 if finds else 2], _HEIGHTS[-1]]
    gaps = [_TOP, _GAP, *([2.0 * _GAP] if finds else []), _AXES_GAP]
    height = sum(heights) + sum(gaps) + _BOTTOM
    figure = Figure(figsize=(PAGE_IN, height), dpi=DPI)
    width = PAGE_IN - _LEFT - _RIGHT
    over_time: list[Axes] = []
    top = height
    for gap, tall in zip(gaps[:-1], heights[:-1], strict=True):
        top -= gap + tall
        place = (_LEFT / PAGE_IN, top / height, width / PAGE_IN, tall / height)
        sharex = over_time[0] if over_time else None
        over_time.append(figure.add_axes(place, sharex=sharex))
    columns = close_ups + 1
    wide = (PAGE_IN - _LEFT - _GAP - (columns - 1) * _AXES_GAP) / columns
    details = [
        figure.add_axes(
            (
                (_LEFT + number * (wide + _AXES_GAP)) / PAGE_IN,
                _BOTTOM / height,
                wide / PAGE_IN,
                heights[-1] / height,
            )
        )
        for number in range(columns)
    ]
    return figure, over_time, details


def law_colours(strikes: list[dict[str, Any]]) -> dict[str, str]:
    """Return a colour for each law, in the order of the strikes."""
    laws = dict.fromkeys(strike["law"] for strike in strikes)
    return {law: COLOURS[number % len(COLOURS)] for number, law in enumerate(laws)}


def shown_strikes(signals: "pa.Table", strikes: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the first strike of each law in which the handle enters the wall from outside.

    The wall that surrounds the handle at the start fades in, and a handle that grazes the surface
    says little of a wall; these are shown only where a law has nothing else.
    """
    t, y = numbers(signals, "t_s"), numbers(signals, "y")
    of_law: dict[str, list[dict[str, Any]]] = {}
    for strike in strikes:
        of_law.setdefault(strike["law"], []).append(strike)

    def enters(strike: dict[str, Any]) -> bool:
        before = int(np.searchsorted(t, strike["start_s"] - 1e-9)) - 1
        return before >= 0 and y[before] >= 0.0

    shown = []
    for those in of_law.values():
        deep = _GRAZING * max(strike["peak_penetration_rad"] for strike in those)
        real = [s for s in those if enters(s) and s["peak_penetration_rad"] >= deep]
        shown.append((real or those)[0])
    return shown


def thin_out(t: Array, *values: Array, columns: int = _COLUMNS) -> tuple[Array, ...]:
    """Leave out what a picture cannot show: keep first, least, largest and last of each column.

    Args:
        t: Time, shape (n,).
        values: Signals, shape (n,).
        columns: Columns of pixels.

    Returns:
        Time and signals, shape (m,), m ≤ 4·(len(values))·columns and a few; all of a short record.
    """
    size = len(t) // columns
    if size <= 4 * len(values):
        return (t, *values)
    first = np.arange(columns) * size
    kept = [first, first + size - 1, np.arange(columns * size, len(t))]
    for value in values:
        parts = value[: columns * size].reshape(columns, size)
        kept += [first + parts.argmin(axis=1), first + parts.argmax(axis=1)]
    rows = np.unique(np.concatenate(kept))
    return (t[rows], *(value[rows] for value in values))


def _mark_strikes(axes: Axes, strikes: list[dict[str, Any]], colours: dict[str, str]) -> None:
    """Shade each strike in the colour of its law; a bar above says that it chattered."""
    for strike in strikes:
        start, end = strike["start_s"], strike["end_s"]
        axes.axvspan(start, end, color=colours[strike["law"]], alpha=0.1, lw=0)
        if strike["chatter"]:
            axes.axvspan(start, end, 0.98, 1.0, color=CHATTER, lw=0)


def verdict(strike: dict[str, Any]) -> str:
    """Return in words whether a strike chattered, with the frequency as the table has it."""
    if not strike["chatter"]:
        return "no chatter"
    frequency = strike["chatter_frequency_hz"]
    return f"chatter, {frequency:.0f} Hz" if frequency else "chatter"


def draw_strikes(
    axes: Axes, signals: "pa.Table", strikes: list[dict[str, Any]], colours: dict[str, str]
) -> None:
    """Draw position [mrad] over time, and mark each strike with its law and any chatter.

    colours maps each law to its colour. Strikes that are too many to be named get a legend.
    """
    t, y = thin_out(numbers(signals, "t_s"), numbers(signals, "y") * 1e3)
    axes.plot(t, y, color="0.2", lw=0.7)
    axes.axhline(0.0, color="k", lw=0.8)
    low, high = float(y.min(initial=0.0)), float(y.max(initial=0.0))
    span = max(high - low, 1e-6)
    axes.set_ylim(low - 0.05 * span, high + 0.4 * span)
    axes.margins(x=0.01)
    axes.axhspan(axes.get_ylim()[0], 0.0, color="0.85", zorder=0)
    _mark_strikes(axes, strikes, colours)
    axes.set_ylabel("position from\nthe wall [mrad]")
    if _names_fit(axes, t, strikes):
        for strike in strikes:
            middle = 0.5 * (strike["start_s"] + strike["end_s"])
            said, chatters = verdict(strike), strike["chatter"]
            for text, line, colour in (
                (strike["law"], 0, colours[strike["law"]]),
                (said, 1, CHATTER if chatters else "0.3"),
            ):
                axes.annotate(
                    text,
                    (middle, 1.0),
                    xycoords=axes.get_xaxis_transform(),
                    xytext=(0.0, -5.0 - 11.0 * line),
                    textcoords="offset points",
                    color=colour,
                    ha="center",
                    va="top",
                )
    elif strikes:
        laws: list[Patch] = [Patch(color=c, alpha=0.3, label=law) for law, c in colours.items()]
        chatter = [Patch(color=CHATTER, label="chatter")] if any(map(_chatters, strikes)) else []
        axes.legend(
            handles=[*laws, *chatter], loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=6
        )


def _chatters(strike: dict[str, Any]) -> bool:
    return bool(strike["chatter"])


def _names_fit(axes: Axes, t: Array, strikes: list[dict[str, Any]]) -> bool:
    """Return True if the names of the strikes do not overlap."""
    if not strikes:
        return True
    figure = axes.get_figure(root=True)
    assert figure is not None
    points = 72.0 * axes.get_position().width * figure.get_size_inches()[0]
    middles = np.array([0.5 * (s["start_s"] + s["end_s"]) for s in strikes])
    room = np.diff(middles, append=np.inf) * points / max(float(np.ptp(t)), 1e-9)
    letters = np.array([max(len(s["law"]), len(verdict(s))) for s in strikes])
    neighbours = 0.5 * (letters + np.append(letters[1:], 0))
    return bool(np.all(room > _LETTER * (neighbours + 1.0)))


def _torque(
    axes: Axes, signals: "pa.Table", strikes: list[dict[str, Any]], colours: dict[str, str]
) -> None:
    t, torque = thin_out(numbers(signals, "t_s"), numbers(signals, "torque_applied"))
    axes.plot(t, torque, color="0.2", lw=0.7, drawstyle="steps-post")
    _mark_strikes(axes, strikes, colours)
    axes.margins(x=0.01)
    axes.set_ylabel("torque\napplied [N·m]")


def _finds(signals: "pa.Table") -> bool:
    """Return True if the cycle has found the mass itself, or lowered the stiffness."""
    lowered = numbers(signals, "stiffness_in_force") < numbers(signals, "stiffness")
    return bool(np.any(numbers(signals, "mass_spread") > 0.0) or np.any(lowered))


def draw_in_force(axes: Axes, signals: "pa.Table") -> Axes:
    """Draw stiffness [N·m/rad], asked and in force, and mass [g·m²] over time.

    Returns:
        The axes of the mass, on the right.
    """
    names = ("t_s", "stiffness", "stiffness_in_force", "mass_est")
    t, asked, in_force, mass = thin_out(*(numbers(signals, name) for name in names))
    # Colours stand for laws here, so these lines have none.
    axes.plot(t, asked, color="0.2", lw=0.9, ls="--", label="K asked")
    axes.plot(t, in_force, color="0.2", lw=1.3, label="K in force")
    # A stiffness far beyond what the cap allows would hide that in force.
    top = _MOST_ASKED * np.max(in_force, initial=0.0)
    axes.set_ylim(0.0, top if 0.0 < top < np.max(asked, initial=0.0) else None)
    axes.margins(x=0.01)
    axes.set_title("Mass and stiffness in force")
    axes.set_ylabel("K\n[N·m/rad]")
    right = axes.twinx()
    right.plot(t, 1e3 * mass, color="0.45", lw=1.5, ls=(0, (1, 1)), label="mass")
    right.set_ylim(bottom=0.0)
    right.set_ylabel("mass [g·m²]")
    right.grid(visible=False)
    right.spines["right"].set_visible(True)
    handles = [*axes.get_lines(), *right.get_lines()]
    labels = [str(line.get_label()) for line in handles]
    # Above the axes: at the wall's stiffness there are lines all along.
    right.legend(
        handles, labels, loc="lower right", bbox_to_anchor=(1.0, 0.95), ncols=3, borderpad=0.1
    )
    return right


def _close_up(
    axes: Axes, signals: "pa.Table", strike: dict[str, Any], colours: dict[str, str]
) -> None:
    t = numbers(signals, "t_s")
    start = max(strike["start_s"] - 0.1 * _CLOSE_UP_S, t[0])
    window = (t >= start) & (t <= start + _CLOSE_UP_S)
    milliseconds = (t[window] - strike["start_s"]) * 1e3
    # As in the source's figure: the force in units of position, f/K, over the position it opposes.
    opposed = -numbers(signals, "y")[window] * 1e3
    held = numbers(signals, "force_applied")[window] / strike["stiffness"] * 1e3
    colour = colours[strike["law"]]
    axes.plot(milliseconds, opposed, ".-", color="0.3", lw=0.8, ms=3, label="penetration −y")
    axes.step(milliseconds, held, where="post", color=colour, lw=1.2, label="force held, f/K")
    axes.axhline(0.0, color="k", lw=0.8)
    # Room for the legend below all lines.
    low, high = axes.get_ylim()
    axes.set_ylim(low - 0.25 * (high - low), high)
    axes.set_xlabel("time from contact [ms]")
    axes.set_ylabel("penetration, f/K [mrad]")
    axes.set_title(f"{strike['law']}, {strike['start_s']:.2f} s")
    axes.legend(loc="lower center", borderpad=0.1, labelspacing=0.2)


def _force_over_position(
    axes: Axes, signals: "pa.Table", shown: list[dict[str, Any]], colours: dict[str, str]
) -> None:
    t, y = numbers(signals, "t_s"), numbers(signals, "y") * 1e3
    force = numbers(signals, "force_applied")
    deepest = 0.0
    for strike, dashes in zip(shown, ("-", (0, (3, 1))), strict=False):
        window = (t >= strike["start_s"]) & (t <= strike["start_s"] + _CLOSE_UP_S)
        # The force is held over each period: along y at constant force, then a step to the next.
        axes.plot(
            np.repeat(y[window], 2)[1:],
            np.repeat(force[window], 2)[:-1],
            color=colours[strike["law"]],
            ls=dashes,
            lw=1.0,
            label=strike["law"],
        )
        deepest = min(deepest, float(y[window].min(initial=0.0)))
    if shown:
        line = np.array([deepest, 0.0])
        axes.plot(line, -shown[0]["stiffness"] * line * 1e-3, "k:", lw=1.2, label="f = −K·y")
        axes.legend(loc="upper right", borderpad=0.1, labelspacing=0.2)
    axes.set_xlabel("position from the wall [mrad]")
    axes.set_ylabel("force out of the wall [N·m]")
    axes.set_title("Force over position")
