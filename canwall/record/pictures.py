"""Picture of a run, drawn from its record alone."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from canwall.figure_style import COLOURS, STYLE
from canwall.record.folder import RunFolder, numbers, read_signals, whole_file

if TYPE_CHECKING:
    import pyarrow as pa

Array = NDArray[np.float64]

#: Length of a close-up [s].
_CLOSE_UP_S = 0.045
#: Columns of the record that the picture needs.
DRAWN = (
    *("t_s", "y", "torque_applied", "force_applied"),
    *("stiffness", "stiffness_in_force", "mass_est", "mass_spread"),
)
#: Fixed title positions: no title here has to avoid ticks, and looking for them takes time.
_QUICK = {"axes.titley": 1.0}


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

    The picture shows position and torque over time with the strikes marked, a close-up of one
    contact of each law (Figure 5.19 of the source), and force over position (Figure 5.3); mass and
    stiffness in force as well if the cycle has found the mass itself, or lowered the stiffness.

    Raises:
        RecordError: If the file cannot be written.
    """
    laws = list(dict.fromkeys(strike["law"] for strike in strikes))
    colours = dict(zip(laws, COLOURS * 4, strict=False))
    shown = [next(s for s in strikes if s["law"] == law) for law in laws[:2]]
    with mpl.rc_context(STYLE | _QUICK):
        finds = _finds(signals)
        figure = Figure(figsize=(12, 10.5 if finds else 9), layout="constrained", dpi=120)
        heights = [1.1, 0.9, *([0.7] if finds else []), 1.5]
        rows = figure.add_gridspec(len(heights), 1, height_ratios=heights)
        over_time = figure.add_subplot(rows[0])
        torque = figure.add_subplot(rows[1], sharex=over_time)
        draw_strikes(over_time, signals, strikes, colours)
        _torque(torque, signals, strikes, colours)
        if finds:
            torque.set_xlabel("")
            torque.tick_params(labelbottom=False)
            in_force = figure.add_subplot(rows[2], sharex=over_time)
            draw_in_force(in_force, signals)
            _mark_strikes(in_force, strikes, colours)
        details = rows[-1].subgridspec(1, max(len(shown), 1) + 1)
        for column, strike in enumerate(shown):
            _close_up(figure.add_subplot(details[column]), signals, strike, colours)
        _force_over_position(figure.add_subplot(details[-1]), signals, shown, colours)
        # Figure.savefig would draw everything twice, first only for the layout.
        canvas = FigureCanvasAgg(figure)
        quick = {"compress_level": 1}
        with whole_file(picture) as file:
            canvas.print_png(file, pil_kwargs=quick)  # type: ignore[no-untyped-call]
    return picture


def _mark_strikes(axes: Axes, strikes: list[dict[str, Any]], colours: dict[str, str]) -> None:
    for strike in strikes:
        axes.axvspan(
            strike["start_s"], strike["end_s"], color=colours[strike["law"]], alpha=0.08, lw=0
        )


def draw_strikes(
    axes: Axes, signals: "pa.Table", strikes: list[dict[str, Any]], colours: dict[str, str]
) -> None:
    """Draw position [mrad] over time, and mark each strike with its law and any chatter.

    colours maps each law to its colour.
    """
    t, y = numbers(signals, "t_s"), numbers(signals, "y") * 1e3
    axes.plot(t, y, color="0.2", lw=0.7)
    axes.axhline(0.0, color="k", lw=0.8)
    low, high = float(y.min(initial=0.0)), float(y.max(initial=0.0))
    span = max(high - low, 1e-6)
    axes.set_ylim(low - 0.05 * span, high + 0.25 * span)
    axes.axhspan(axes.get_ylim()[0], 0.0, color="0.85", zorder=0)
    _mark_strikes(axes, strikes, colours)
    for strike in strikes:
        verdict = "no chatter"
        if strike["chatter"]:
            verdict = f"chatter, {strike['chatter_frequency_hz']:.0f} Hz"
        axes.text(
            0.5 * (strike["start_s"] + strike["end_s"]),
            high + 0.22 * span,
            f"{strike['law']}\n{verdict}",
            color=colours[strike["law"]],
            ha="center",
            va="top",
        )
    axes.set_ylabel("position from the wall [mrad]")
    axes.set_title("Strikes on the wall (grey: inside)")
    axes.tick_params(labelbottom=False)


def _torque(
    axes: Axes, signals: "pa.Table", strikes: list[dict[str, Any]], colours: dict[str, str]
) -> None:
    axes.plot(
        numbers(signals, "t_s"),
        numbers(signals, "torque_applied"),
        color="0.2",
        lw=0.7,
        drawstyle="steps-post",
    )
    _mark_strikes(axes, strikes, colours)
    axes.margins(x=0.01)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("torque applied [N·m]")


def _finds(signals: "pa.Table") -> bool:
    """Return True if the cycle has found the mass itself, or lowered the stiffness."""
    lowered = numbers(signals, "stiffness_in_force") < numbers(signals, "stiffness")
    return bool(np.any(numbers(signals, "mass_spread") > 0.0) or np.any(lowered))


def draw_in_force(axes: Axes, signals: "pa.Table") -> Axes:
    """Draw stiffness [N·m/rad], asked and in force, and mass [g·m²] over time.

    Returns:
        The axes of the mass, on the right.
    """
    t = numbers(signals, "t_s")
    asked, in_force = numbers(signals, "stiffness"), numbers(signals, "stiffness_in_force")
    axes.plot(t, asked, color=COLOURS[2], lw=0.8, ls="--", label="K asked")
    axes.plot(t, in_force, color=COLOURS[2], lw=1.2, label="K in force")
    axes.set_ylim(bottom=0.0)
    axes.set_title("Mass and stiffness in force")
    axes.set_ylabel("K [N·m/rad]")
    axes.set_xlabel("time [s]")
    mass = axes.twinx()
    mass.plot(t, 1e3 * numbers(signals, "mass_est"), color=COLOURS[3], lw=1.2, label="mass")
    mass.set_ylim(bottom=0.0)
    mass.set_ylabel("mass [g·m²]")
    mass.grid(visible=False)
    mass.spines["right"].set_visible(True)
    handles = [*axes.get_lines(), *mass.get_lines()]
    labels = [str(line.get_label()) for line in handles]
    # Above the axes: at the wall's stiffness there are lines all along.
    mass.legend(handles, labels, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3)
    return mass


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
    axes.set_xlabel("time from contact [ms]")
    axes.set_ylabel("penetration, f/K [mrad]")
    axes.set_title(f"First contact: {strike['law']}")
    axes.legend()


def _force_over_position(
    axes: Axes, signals: "pa.Table", shown: list[dict[str, Any]], colours: dict[str, str]
) -> None:
    t, y = numbers(signals, "t_s"), numbers(signals, "y") * 1e3
    force = numbers(signals, "force_applied")
    deepest = 0.0
    for strike in shown:
        window = (t >= strike["start_s"]) & (t <= strike["start_s"] + _CLOSE_UP_S)
        # The force is held over each period: along y at constant force, then a step to the next.
        axes.plot(
            np.repeat(y[window], 2)[1:],
            np.repeat(force[window], 2)[:-1],
            color=colours[strike["law"]],
            lw=0.8,
            label=strike["law"],
        )
        deepest = min(deepest, float(y[window].min(initial=0.0)))
    if shown:
        line = np.array([deepest, 0.0])
        axes.plot(line, -shown[0]["stiffness"] * line * 1e-3, "k--", lw=1.0, label="f = −K·y")
        axes.legend(loc="upper right")
    axes.set_xlabel("position from the wall [mrad]")
    axes.set_ylabel("force out of the wall [N·m]")
    axes.set_title("Force over position, same time")
