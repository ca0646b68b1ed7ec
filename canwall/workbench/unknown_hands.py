"""Figure of strikes by several operators on one wall that finds out who holds the handle."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from numpy.typing import NDArray

from canwall import config
from canwall.analysis import AskedWall
from canwall.config import Settings
from canwall.figure_style import COLOURS, DPI, PAGE_IN
from canwall.record import Phase
from canwall.run.closed_loop import simulate
from canwall.run.referent import referent_motion
from canwall.sweep.axes import Value, settings_at
from canwall.sweep.strike import OPERATORS
from canwall.workbench.figure_page import REFERENT, FigurePage

Array = NDArray[np.float64]

#: The wall that is asked for [N·m/rad], and the speed of the strike [rad/s].
_STIFFNESS, _SPEED = 300.0, 0.7
#: Cycles before the contact and after it.
_BEFORE, _AFTER = 20, 140
#: Positions that are shown [mrad].
_SHOWN = (-4.5, 3.0)
_POSITION, _IN_FORCE, _MASS = COLOURS[4], COLOURS[0], COLOURS[3]


class OperatorStrike(NamedTuple):
    """First contact of a strike; arrays of shape (_BEFORE + _AFTER,).

    Attributes:
        y: Position relative to the wall [rad].
        referent: That of the continuous wall, as stiff as the mass allows [rad].
        stiffness: Stiffness in force [N·m/rad].
        mass: Mass in the laws' model [kg·m²].
        true_mass: Inertia of drive, handle and hand [kg·m²].
    """

    y: Array
    referent: Array
    stiffness: Array
    mass: Array
    true_mass: float


def strike_by(operator: str) -> OperatorStrike:
    """Strike the wall of config/sim.toml, as stiff as _STIFFNESS, with an operator."""
    settings = _struck_by(operator)
    assert settings.run.duration_s is not None
    assert settings.simulation is not None
    cycles = round(settings.run.duration_s / settings.bus.cycle_s)
    rows = simulate(settings, cycles).rows
    asked = AskedWall(*(rows[name].copy() for name in AskedWall._fields))
    referent = referent_motion(settings, asked, rows["wall_position_rad"])
    assert referent is not None
    contact = np.flatnonzero((rows["phase"] == Phase.RENDERING) & (rows["y"] < 0.0))[0]
    shown = slice(contact - _BEFORE, contact + _AFTER)
    return OperatorStrike(
        rows["y"][shown],
        referent.y[shown],
        rows["stiffness_in_force"][shown],
        rows["mass_est"][shown],
        settings.simulation.inertia_kg_m2 + settings.simulation.hand.inertia_kg_m2,
    )


def _struck_by(operator: str) -> Settings:
    settings = config.load(
        config.shipped("config/sim.toml"), {"wall.stiffness_nm_per_rad": _STIFFNESS}
    )
    point: dict[str, Value] = {
        "operator": operator,
        "model": "drive",
        "speed": _SPEED,
        "phase": 0.35,
    }
    return settings_at(settings, point)


def draw_unknown_hands() -> Iterator[FigurePage]:
    """Draw a strike by each operator, with what the cycle has found of it."""
    title = f"A strike by six operators, {_STIFFNESS:g} N·m/rad asked (inertia with the handle)"
    figure = Figure(figsize=(PAGE_IN, 8.0), layout="constrained", dpi=DPI)
    figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    grid = figure.add_gridspec(2, 3)
    t = np.arange(-_BEFORE, _AFTER, dtype=np.float64)
    columns: dict[str, Array] = {"t from contact [ms]": t}
    found = []
    for number, name in enumerate(OPERATORS):
        strike = strike_by(name)
        _draw_strike(figure, grid[divmod(number, 3)], t, name, strike)
        columns[f"y {name} [mrad]"] = strike.y * 1e3
        columns[f"y of the referent {name} [mrad]"] = strike.referent * 1e3
        columns[f"K in force {name} [N·m/rad]"] = strike.stiffness
        columns[f"mass {name} [g·m²]"] = strike.mass * 1e3
        found.append(
            f"{name} {1e3 * strike.mass[-1]:.3g} of {1e3 * strike.true_mass:.3g} g·m², "
            f"{strike.stiffness[-1]:.3g} N·m/rad"
        )
    handles, labels = figure.axes[0].get_legend_handles_labels()
    more = figure.axes[1].get_legend_handles_labels()
    figure.legend([*handles, *more[0]], [*labels, *more[1]], loc="outside lower center", ncols=4)
    yield FigurePage(
        "unknown_hands",
        title,
        "The wall begins as one for the lightest operator. The mass at the handle is learned from "
        "its answer to a probe before the contact and to the wall's own torques, and the wall is "
        "as stiff as it allows.",
        "Mass found of the true one, and stiffness in force, "
        f"{_AFTER} ms after the contact: {'; '.join(found)}.",
        columns,
        figure,
    )


def _draw_strike(
    figure: Figure, place: SubplotSpec, t: Array, name: str, strike: OperatorStrike
) -> None:
    """Draw position above, and shares of what was asked and of what is true below."""
    rows = place.subgridspec(2, 1, height_ratios=[1.5, 1.0], hspace=0.02)
    above = figure.add_subplot(rows[0])
    below = figure.add_subplot(rows[1], sharex=above)
    above.plot(t, strike.y * 1e3, color=_POSITION, lw=1.4, label="position")
    above.plot(t, strike.referent * 1e3, "--", color=REFERENT, lw=1.0, label="continuous wall")
    above.axhline(0.0, color="k", lw=0.8)
    above.set_ylim(*_SHOWN)
    above.set_title(f"{name}, {1e3 * strike.true_mass:.3g} g·m²")
    above.set_ylabel("y [mrad]")
    above.tick_params(labelbottom=False)
    below.plot(
        t,
        strike.mass / strike.true_mass,
        color=_MASS,
        lw=1.6,
        ls=(0, (3, 1, 1, 1)),
        label="mass ÷ true mass",
    )
    below.plot(
        t,
        strike.stiffness / _STIFFNESS,
        color=_IN_FORCE,
        lw=1.4,
        ls=(0, (5, 2)),
        label="K in force ÷ K asked",
    )
    below.axhline(1.0, color="k", lw=0.8)
    below.set_ylim(0.0, 1.5)
    below.set_ylabel("share [1]")
    below.set_xlabel("time from contact [ms]")
    below.margins(x=0.01)
