"""Comparison of all laws on the same floor, as a figure of its own.

A ball of 1 kg under 1 m/s² meets a floor of 1 N/m at 5 m/s. The period T varies, and with it
θ = T·√(K/m), and for each T the phase at which the ball enters.
"""

import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from numpy.typing import NDArray

from canwall.figure_style import DPI, PAGE_IN, line_style
from canwall.walls import HORIZON
from canwall.workbench.ball import CONTINUOUS, Ball
from canwall.workbench.bounces import Bounces, entering, over_phases
from canwall.workbench.figure_page import REFERENT, FigurePage

Array = NDArray[np.float64]

ENTRY_SPEED = 5.0
#: Damping of the floors that have one: ζ = 0.1 [N·s/m].
DAMPING = 0.2
#: Range of θ.
THETA = (0.05, 3.0)
#: Time that exceeds any contact [s], and further periods for large T.
_CONTACT_S, _PERIODS = 12.0, 8
#: Bound of the linear part of the energy axis.
_LINEAR = 1e-3
#: Line of the continuous wall without damping, below those of the laws.
_UNDAMPED: dict[str, Any] = {"color": "0.75", "lw": 3.0, "zorder": 1}
#: Dashes of the continuous wall with damping, unlike those of the laws.
_FINE = (0, (8, 2, 1, 2))
#: Gain in ln E that rounding may cause.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class LawParameters:
    """Damping and options of a law in the comparison.

    The defaults of the options suit a bench, in radians; those here suit a ball that dives 6 m.
    """

    damping: float = 0.0
    options: Mapping[str, float] = field(default_factory=dict)


#: The laws, grouped by the knowledge that they use. Those that bound their force by the damping of
#: the device are left out: the ball has none (FORCELESS).
GROUPS: dict[str, dict[str, LawParameters]] = {
    "laws without a model": {
        "standard": LawParameters(),
        "damped": LawParameters(DAMPING),
        "hysteresis": LawParameters(options={"softening": 0.8}),
        "exponential": LawParameters(options={"length": 10.0}),
        "thresholded_damper": LawParameters(DAMPING, {"threshold": 1.0}),
        "unidirectional_damper": LawParameters(DAMPING),
        "offset_damper": LawParameters(DAMPING, {"offset": -1.0}),
    },
    "laws that predict": {
        "midpoint": LawParameters(),
        "half_sample": LawParameters(),
        "pole_placement": LawParameters(),
        "half_sample+deadbeat": LawParameters(),
        "pole_placement+deadbeat": LawParameters(),
    },
    "laws that plan an interval or a contact": {
        "mean_force": LawParameters(),
        "two_step": LawParameters(),
        "push_only": LawParameters(),
        "rigid": LawParameters(options={"restitution": 1.0}),
    },
}

#: Laws that give a ball no force, since it has no damping.
FORCELESS = ("energy_bounding", "virtual_coupling")


@dataclass(frozen=True)
class LawResult:
    """Result of a law at one θ, over all phases of entry.

    Attributes:
        mean: Mean change of ln E in the first bounce.
        least: Smallest change.
        most: Largest change.
        tension: Largest pulling force [N].
        peak: Largest force [N].
        out: Share of the balls that left the floor again; the others have no change of ln E.
    """

    mean: float
    least: float
    most: float
    tension: float
    peak: float
    out: float

    @classmethod
    def of(cls, strikes: list[Bounces]) -> "LawResult":
        """Evaluate the first contact of each ball."""
        gains = np.array([strike.gains[0] for strike in strikes if len(strike.gains)])
        forces = np.concatenate(
            [s.force[: s.contacts[0].stop] if s.contacts else s.force for s in strikes]
        )
        known = gains if len(gains) else np.array([np.nan])
        return cls(
            float(known.mean()),
            float(known.min()),
            float(known.max()),
            float(max(0.0, -forces.min())),
            float(forces.max()),
            len(gains) / len(strikes),
        )


def one_contact_ball(period: float, damping: float = 0.0) -> Ball:
    """Return a ball that is simulated for one contact at this sampling period."""
    periods = round(_CONTACT_S / period) + _PERIODS
    return Ball(damping=damping, period=period, periods=periods)


def law_result(law: str, parameters: LawParameters, theta: float, phases: int) -> LawResult:
    """Simulate a law at one θ. Raises UnknownLawError."""
    ball = one_contact_ball(theta, parameters.damping)
    return LawResult.of(list(over_phases(ball, law, ENTRY_SPEED, phases, parameters.options)))


def continuous_result(damping: float) -> LawResult:
    """Simulate the continuous floor, which depends on neither θ nor phase."""
    ball = entering(one_contact_ball(1e-3, damping), ENTRY_SPEED, 0.5)
    return LawResult.of([Bounces.on(ball, CONTINUOUS)])


def draw_comparison(count: int, phases: int) -> Iterator[FigurePage]:
    """Draw the comparison for `count` values of θ and `phases` phases of entry."""
    grid = np.geomspace(*THETA, count)
    results = {
        law: [law_result(law, parameters, theta, phases) for theta in grid]
        for laws in GROUPS.values()
        for law, parameters in laws.items()
    }
    referents = {damping: continuous_result(damping) for damping in (0.0, DAMPING)}
    figure = _draw(grid, results, referents)
    yield FigurePage(
        "all_laws",
        "All laws: energy, tension and peak force of a bounce",
        "As the chapter says, the standard wall puts out energy, the two new controllers hardly "
        "any, and none with the compensation for asynchronous switching.",
        _finding(grid, results),
        _columns(grid, results, referents),
        figure,
    )


def _values(results: list[LawResult], name: str) -> Array:
    return np.array([getattr(result, name) for result in results])


def _shares(
    name: str, results: Mapping[str, list[LawResult]], referents: Mapping[float, LawResult]
) -> dict[str, Array]:
    """Divide a force of each law by the peak force of the continuous wall that it renders."""
    damping = {law: chosen.damping for laws in GROUPS.values() for law, chosen in laws.items()}
    return {
        law: _values(of_law, name) / referents[damping[law]].peak for law, of_law in results.items()
    }


def _columns(
    grid: Array, results: Mapping[str, list[LawResult]], referents: Mapping[float, LawResult]
) -> dict[str, NDArray[np.generic]]:
    """Return the columns of the CSV file, with a row for each law and θ."""
    rows = [result for of_law in results.values() for result in of_law]
    tension, peak = (_shares(name, results, referents) for name in ("tension", "peak"))
    return {
        "law": np.repeat(list(results), len(grid)),
        "theta [1]": np.tile(grid, len(results)),
        "change of ln E, mean [1]": _values(rows, "mean"),
        "change of ln E, least [1]": _values(rows, "least"),
        "change of ln E, most [1]": _values(rows, "most"),
        "largest tension over the continuous wall's peak [1]": np.concatenate([*tension.values()]),
        "peak force over the continuous wall's [1]": np.concatenate([*peak.values()]),
        "share of the balls that came out [1]": _values(rows, "out"),
    }


def passive_up_to(grid: Array, results: list[LawResult]) -> float:
    """Return the largest θ up to which no phase of entry gains energy; 0 if there is none."""
    gaining = np.flatnonzero(~(_values(results, "most") <= _ROUNDING))
    passive = grid[: gaining[0]] if len(gaining) else grid
    return float(passive[-1]) if len(passive) else 0.0


def _finding(grid: Array, results: Mapping[str, list[LawResult]]) -> str:
    reach = {law: passive_up_to(grid, found) for law, found in results.items()}
    always = [law for law, theta in reach.items() if theta == grid[-1]]
    partly = [f"{law} up to {theta:.2f}" for law, theta in reach.items() if 0 < theta < grid[-1]]
    never = [f"{law} {results[law][0].most:+.1g}" for law, theta in reach.items() if theta == 0.0]
    pushing = [law for law, found in results.items() if _values(found, "tension").max() == 0.0]
    outs = {law: _values(found, "out").min() for law, found in results.items()}
    kept = [f"{law} {1.0 - out:.0%}" for law, out in outs.items() if out < 1.0]
    return (
        f"No phase of entry gains more than {_ROUNDING:g} in ln E at any θ shown with "
        f"{_join(always)}, up to some θ with {_join(partly)}, while already at "
        f"θ = {grid[0]:g} some phase gains with {_join(never)} (push_only plans at most "
        f"{HORIZON} periods at once). {_join(pushing)} never pull. Balls that do not leave the "
        f"floor within the simulated time are not counted; their share at the worst θ: "
        f"{_join(kept)}."
    )


def _join(items: list[str]) -> str:
    return ", ".join(items) or "none"


def _draw(
    grid: Array, results: Mapping[str, list[LawResult]], referents: Mapping[float, LawResult]
) -> Figure:
    figure = Figure(figsize=(PAGE_IN, 9.0), layout="constrained", dpi=DPI)
    grids = figure.subplots(3, len(GROUPS), sharex=True, sharey="row", squeeze=False)
    tensions, peaks = (_shares(name, results, referents) for name in ("tension", "peak"))
    for column, (group, laws) in zip(grids.T, GROUPS.items(), strict=True):
        energy, tension, peak = column
        energy.set_title(textwrap.fill(group, 24))
        for number, law in enumerate(laws):
            found = results[law]
            # Some laws agree to the last bit: different dashes keep both lines visible.
            style = line_style(number) | {"lw": 1.4, "marker": None}
            energy.plot(grid, _values(found, "mean"), label=law, **style)
            energy.fill_between(
                grid,
                _values(found, "least"),
                _values(found, "most"),
                color=style["color"],
                alpha=0.12,
                lw=0.0,
            )
            tension.plot(grid, tensions[law], **style)
            peak.plot(grid, peaks[law], **style)
        if any(chosen.damping for chosen in laws.values()):
            label = f"continuous, B = {DAMPING:g} N·s/m"
            energy.axhline(referents[DAMPING].mean, color=REFERENT, ls=_FINE, lw=1.1, label=label)
        energy.axhline(0.0, **_UNDAMPED, label="continuous, undamped")
        peak.axhline(1.0, **_UNDAMPED)
        handles, labels = energy.get_legend_handles_labels()
        peak.legend(handles, labels, loc="upper center", bbox_to_anchor=(0.5, -0.25), ncols=1)
        peak.set_xlabel("θ = T·√(K/m)")
    _set_scales(*grids[:, 0])
    return figure


def _set_scales(energy: Axes, tension: Axes, peak: Axes) -> None:
    plain = FuncFormatter(lambda value, place: f"{value:g}")
    energy.set_xscale("log")
    energy.xaxis.set_major_locator(FixedLocator([0.05, 0.1, 0.2, 0.5, 1.0, 3.0]))
    energy.xaxis.set_major_formatter(plain)
    energy.xaxis.set_minor_locator(NullLocator())
    energy.set_yscale("symlog", linthresh=_LINEAR)
    energy.set_ylabel("change of ln E by a bounce\n(mean; band: all phases of entry)")
    tension.set_ylabel("largest tension over the\ncontinuous wall's peak force")
    peak.set_yscale("log")
    peak.yaxis.set_major_locator(FixedLocator([0.5, 1.0, 2.0, 5.0, 10.0, 20.0]))
    peak.yaxis.set_major_formatter(plain)
    peak.yaxis.set_minor_locator(NullLocator())
    peak.set_ylabel("peak force over the\ncontinuous wall's")
