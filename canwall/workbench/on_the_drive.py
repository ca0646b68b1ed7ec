"""Figures 5.5, 5.18 and 5.19 of the source: strikes on the simulated drive, over the bus."""

import math
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from canwall import config
from canwall.analysis import metrics
from canwall.compiled import Record, compiled
from canwall.config import Settings, Wall
from canwall.cycle import make_cycle, run_laws, set_wall
from canwall.drive import DriveSetup, PdoLayout
from canwall.errors import RunFailedError
from canwall.figure_style import PAGE_IN
from canwall.record import read_signals
from canwall.record.pictures import draw_strikes, law_colours
from canwall.run import run
from canwall.units import DriveUnits, to_per_mille
from canwall.walls import find_law, set_applied_force, wall_force
from canwall.workbench.bounces import crossing_time
from canwall.workbench.figure_page import (
    ACCENT,
    REFERENT,
    SAMPLES,
    FigurePage,
    blank,
    legend_below,
    mark_delay,
    stairs,
)

Array = NDArray[np.float64]

#: Contacts of the first strike in the close-up, by number, and samples around them.
_CLOSE_UP = slice(1, 3)
_AROUND = 2


@dataclass(frozen=True)
class RecordedRun:
    """Settings, signals and summary of a recorded run."""

    settings: Settings
    signals: pa.Table
    summary: dict[str, Any]

    def column(self, name: str) -> Array:
        """Return a column of the record, shape (cycles,)."""
        return np.asarray(self.signals[name].to_numpy(), dtype=np.float64)


def record_run() -> RecordedRun:
    """Run config/ideal.toml. Raises RunFailedError if it trips or its record is incomplete."""
    settings = config.load(config.shipped("config/ideal.toml"))
    with tempfile.TemporaryDirectory() as scratch:
        result = run(settings, Path(scratch) / "run")
        if result.outcome.interrupted:
            raise KeyboardInterrupt
        if troubles := [*result.outcome.trips, *result.notes]:
            raise RunFailedError("; ".join(troubles))
        return RecordedRun(settings, read_signals(result.folder.signals), result.summary)


def draw_strip_chart(recorded: RecordedRun) -> Iterator[FigurePage]:
    """Draw figure 5.5: the first contact of the first strike, as recorded."""
    contact = contacts_of_first_strike(recorded)[0]
    shown = slice(contact.start - _AROUND, contact.stop + _AROUND)
    wall, cycle_s = recorded.settings.wall, recorded.settings.bus.cycle_s
    t, y = recorded.column("t_s")[shown] * 1e3, recorded.column("y")[shown] * 1e3
    held = 0.0 - recorded.column("force_applied")[shown] / wall.stiffness_nm_per_rad * 1e3
    title = "Figure 5.5: time chart of a recorded strike"
    figure, axes = blank(title, "time t [ms]", "position y, −f/K [mrad]")
    axes.axhline(0.0, color="0.6", lw=0.8)
    axes.plot(t, y, "o-", color=SAMPLES, lw=0.9, ms=3.0, label="position y, each SYNC")
    stairs(axes, t, held, "held force, −f/K")
    spline = CubicSpline(t, y)
    inside = np.flatnonzero(y < 0.0)
    entry, leave = (
        crossing_time(lambda s: float(spline(s)), 0.0, t[j], t[j + 1])
        for j in (inside[0] - 1, inside[-1])
    )
    on, off = np.flatnonzero(held != 0.0)[[0, -1]] + [0, 1]
    for name, crossed, switched in (("Δt$_a$", entry, t[on]), ("Δt$_b$", leave, t[off])):
        mark_delay(axes, name, crossed, switched)
    axes.margins(x=0.01, y=0.15)
    legend_below(figure, axes)
    yield FigurePage(
        "figure_5_05",
        title,
        "A strike of an experimental wall shows what the idealised time chart does: the force is "
        "switched on and off late, and lags the position in between.",
        f"The first contact of `config/ideal.toml` ({wall.law}, "
        f"K = {wall.stiffness_nm_per_rad:g} N·m/rad, T = {cycle_s * 1e3:g} ms) on the simulated "
        f"drive. The force begins {t[on] - entry:.2f} ms after the surface is crossed and ends "
        f"{t[off] - leave:.2f} ms after it is crossed again: a sample is up to one period late, "
        f"and its force takes effect a SYNC later.",
        {"t [ms]": t, "y [mrad]": y, "-f/K held [mrad]": held},
        figure,
    )


def draw_four_strikes(recorded: RecordedRun) -> Iterator[FigurePage]:
    """Draw figures 5.18 and 5.19 from one run."""
    yield _draw_strikes(recorded)
    yield _draw_efforts(recorded)


def contacts_of_first_strike(recorded: RecordedRun) -> list[slice]:
    """Return the contacts of the first strike as slices of cycles."""
    strike = recorded.summary["strikes"][0]
    start, end = (round(strike[k] / recorded.settings.bus.cycle_s) for k in ("start_s", "end_s"))
    y, force = recorded.column("y")[start:end], recorded.column("force_applied")[start:end]
    return [slice(start + c.start, start + c.stop) for c in metrics.contacts(y, force)]


def close_up(recorded: RecordedRun) -> slice:
    """Return the cycles of the close-up: the second and third contact of the first strike."""
    contacts = contacts_of_first_strike(recorded)[_CLOSE_UP]
    return slice(contacts[0].start - _AROUND, contacts[-1].stop + _AROUND)


def effort(recorded: RecordedRun, wall: Wall) -> Array:
    """Compute the force that a wall of the run, displayed or not, would hold from each SYNC on.

    Its law gets the sample and the estimated state of each cycle. The force is quantised and
    limited like the drive's torque, and acts one SYNC later (docs/laws.md).

    Returns:
        Force [N·m], shape (cycles,).
    """
    settings, laws = recorded.settings, run_laws(recorded.settings)
    scales = recorded.summary["drive"]
    units = DriveUnits(math.tau / scales["rad_per_count"], 1000.0 * scales["nm_per_mille"])
    # The signals are recorded, so no PDO has to be decoded.
    empty = PdoLayout(0, ())
    cycle = make_cycle(settings, DriveSetup(units, 0, empty, empty), laws)
    set_wall(cycle, wall, laws)
    y = recorded.column("y")
    v = np.diff(y, prepend=y[0]) / settings.bus.cycle_s
    inputs = np.stack([y, v, *(recorded.column(c) for c in ("y_est", "v_est", "d_est"))])
    held = np.zeros(len(y))
    address = find_law(wall.law, wall.deadbeat).address
    _fill_held_force(
        cycle["rendered"][0]["wall"][0],
        address,
        inputs,
        units.nm_per_mille,
        settings.limits.torque_nm,
        held,
    )
    return held


@compiled
def _fill_held_force(
    walls: NDArray[np.void], address: int, inputs: Array, step: float, limit: float, held: Array
) -> None:
    wall: Record = walls[0]
    for j in range(len(held) - 1):
        wall.y_sample, wall.v_sample = inputs[0, j], inputs[1, j]
        wall.y, wall.v, wall.d = inputs[2, j], inputs[3, j], inputs[4, j]
        held[j + 1] = to_per_mille(wall_force(address, wall), step, limit) * step
        set_applied_force(wall, held[j + 1])


def effort_crossing_phases(t: Array, y: Array, level: Array) -> tuple[Array, int]:
    """Return the phases, 0 … 1, at which the position crosses the level held in a period.

    Only periods that begin inside the wall are considered; the second value is their number.
    Between samples the position is a cubic spline through them.
    """
    spline = CubicSpline(t, y)
    inside = [j for j in range(len(t) - 1) if y[j] < 0.0 and level[j] != 0.0]
    times = np.array(
        [crossing_time(lambda s: float(spline(s)), level[j], t[j], t[j + 1]) for j in inside]
    )
    phases = (times - t[inside]) / np.diff(t)[inside]
    return phases[np.isfinite(phases)], len(inside)


def _draw_strikes(recorded: RecordedRun) -> FigurePage:
    title = "Figure 5.18: four strikes of a virtual wall, with two controllers"
    figure, axes = blank(f"{title} (grey: inside)", "time t [s]", "", (PAGE_IN, 3.6))
    strikes = recorded.summary["strikes"]
    draw_strikes(axes, recorded.signals, strikes, law_colours(strikes))
    t, y = recorded.column("t_s"), recorded.column("y")
    box = close_up(recorded)
    low, high = y[box].min() * 1e3, y[box].max() * 1e3
    axes.add_patch(
        Rectangle(
            (t[box][0], low - 5.0),
            np.ptp(t[box]),
            high - low + 10.0,
            fill=False,
            color=ACCENT,
            lw=2.0,
            zorder=3,
        )
    )
    findings = (
        f"strike {number} ({strike['law']}): {strike['contacts']} "
        f"contact{'s' if strike['contacts'] > 1 else ''}, "
        + (
            f"chatter at {strike['chatter_frequency_hz']:.1f} Hz with an amplitude of "
            f"{strike['chatter_amplitude_rad'] * 1e3:.1f} mrad, "
            if strike["chatter"]
            else "no chatter, "
        )
        + f"{strike['energy_out_j']:.3g} J out"
        for number, strike in enumerate(strikes, start=1)
    )
    return FigurePage(
        "figure_5_18",
        title,
        "Four strikes on the same wall with the controllers alternating: the old one chatters, "
        "the new one does not.",
        f"K = {recorded.settings.wall.stiffness_nm_per_rad:g} N·m/rad at "
        f"{1.0 / recorded.settings.bus.cycle_s:g} Hz; " + "; ".join(findings) + ".",
        {
            "t [s]": t,
            "y [mrad]": y * 1e3,
            "torque applied [N·m]": recorded.column("torque_applied"),
            "law": np.asarray(recorded.signals["law"].to_pylist()),
        },
        figure,
    )


def _draw_efforts(recorded: RecordedRun) -> FigurePage:
    displayed, other = (stage.wall for stage in recorded.settings.stages[:2])
    box = close_up(recorded)
    stiffness = displayed.stiffness_nm_per_rad
    t, y = recorded.column("t_s")[box], recorded.column("y")[box] * 1e3
    applied = 0.0 - recorded.column("force_applied")[box] / stiffness * 1e3
    hidden = 0.0 - effort(recorded, other)[box] / stiffness * 1e3
    title = "Figure 5.19: close-up, with the effort of both controllers"
    figure, axes = blank(title, "time t [s]", "position y, −f/K [mrad]")
    axes.axhline(0.0, color="0.6", lw=0.8)
    axes.plot(t, y, ".-", color=REFERENT, lw=0.9, ms=4.0, label="position y")
    colours = law_colours(recorded.summary["strikes"])
    stairs(axes, t, applied, f"{displayed.law}, displayed", color=colours[displayed.law])
    label = f"{other.law}, not displayed"
    stairs(axes, t, hidden, label, color=colours[other.law], ls="--")
    axes.margins(x=0.01)
    legend_below(figure, axes)
    phases, periods = effort_crossing_phases(t, y, hidden)
    displayed_phases, displayed_periods = effort_crossing_phases(t, y, applied)
    return FigurePage(
        "figure_5_19",
        title,
        "With the stiffness scaled to unity, the new control effort (dashed, not displayed) meets "
        "the position at the half-sample times; the old one (solid, displayed) lags it.",
        f"{other.law} meets the position in {len(phases)} of {periods} periods, at "
        f"{phases.mean():.2f} of the period ({phases.min():.2f} to {phases.max():.2f}); "
        f"{displayed.law} in {len(displayed_phases)} of {displayed_periods}: its force belongs to "
        "the sample before, because on the bus it takes effect one SYNC later.",
        {
            "t [s]": t,
            "y [mrad]": y,
            f"-f/K {displayed.law} displayed [mrad]": applied,
            f"-f/K {other.law} not displayed [mrad]": hidden,
        },
        figure,
    )
