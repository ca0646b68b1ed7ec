"""One page of the project's own: every law on the same floor, softer to harder.

A ball of 1 kg under 1 m/s² meets a floor of 1 N/m at 5 m/s; the period T of the laws runs, so
θ = T·√(K/m) does, and the ball comes at many instants of a period.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from numpy.typing import NDArray

from canwall.figure_style import COLOURS
from canwall.walls import HORIZON
from canwall.workbench.ball import CONTINUOUS, Ball
from canwall.workbench.bounces import Bounces, entering, over_phases
from canwall.workbench.figure_page import REFERENT, FigurePage

Array = NDArray[np.float64]

ENTRY_SPEED = 5.0
#: Damping of the floors that have one: ζ = 0.1 [N·s/m].
DAMPING = 0.2
#: Softest and hardest floor for its sample rate.
THETA = (0.05, 3.0)
#: Longer than any contact [s], with some more periods where these are long.
_CONTACT_S, _PERIODS = 12.0, 8
#: Up to this the axis of the energy is linear.
_LINEAR = 1e-3
#: What rounding may add to ln E.
_ROUNDING = 1e-9
#: The palette's lines; its yellow is for areas.
_LINES = (*COLOURS[:6], COLOURS[7])


@dataclass(frozen=True)
class Choice:
    """How a law is set for the comparison.

    The options that laws have are a bench's, in radians; those here suit a ball that dives 6 m.
    """

    damping: float = 0.0
    options: Mapping[str, float] = field(default_factory=dict)


#: The laws by what they know.
GROUPS: dict[str, dict[str, Choice]] = {
    "laws without a model": {
        "standard": Choice(),
        "damped": Choice(DAMPING),
        "hysteresis": Choice(options={"softening": 0.8}),
        "exponential": Choice(options={"length": 10.0}),
        "thresholded_damper": Choice(DAMPING, {"threshold": 1.0}),
        "unidirectional_damper": Choice(DAMPING),
        "offset_damper": Choice(DAMPING, {"offset": -1.0}),
    },
    "laws that predict": {
        "midpoint": Choice(),
        "half_sample": Choice(),
        "pole_placement": Choice(),
        "half_sample+deadbeat": Choice(),
        "pole_placement+deadbeat": Choice(),
    },
    "laws that plan an interval or a contact": {
        "mean_force": Choice(),
        "two_step": Choice(),
        "push_only": Choice(),
        "rigid": Choice(options={"restitution": 1.0}),
    },
}


@dataclass(frozen=True)
class LawResult:
    """One law at one θ, over all phases of entry.

    Change of ln E by a bounce (mean, least, most), largest tension and largest force [N], and
    the share of the balls that came out again at all: of the others there is no change to tell.
    """

    mean: float
    least: float
    most: float
    tension: float
    peak: float
    out: float

    @classmethod
    def of(cls, strikes: list[Bounces]) -> "LawResult":
        """Of the first contact of each."""
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


def floor(period: float, damping: float = 0.0) -> Ball:
    """The ball over its floor, for one contact at this period of the law."""
    periods = round(_CONTACT_S / period) + _PERIODS
    return Ball(damping=damping, period=period, periods=periods)


def measured(law: str, choice: Choice, theta: float, phases: int) -> LawResult:
    """A law at one θ. Raises UnknownLawError."""
    ball = floor(theta, choice.damping)
    return LawResult.of(list(over_phases(ball, law, ENTRY_SPEED, phases, choice.options)))


def continuous(damping: float) -> LawResult:
    """The continuous floor, for which θ and phase are nothing."""
    return LawResult.of([Bounces.on(entering(floor(1e-3, damping), ENTRY_SPEED, 0.5), CONTINUOUS)])


def thetas(count: int) -> Array:
    """The floors that are compared."""
    return np.geomspace(*THETA, count)


def all_laws(count: int, phases: int) -> Iterator[FigurePage]:
    """The page, for so many θ and phases of entry."""
    grid = thetas(count)
    results = {
        law: [measured(law, choice, theta, phases) for theta in grid]
        for laws in GROUPS.values()
        for law, choice in laws.items()
    }
    referents = {damping: continuous(damping) for damping in (0.0, DAMPING)}
    figure = _draw(grid, results, referents)
    yield FigurePage(
        "all_laws",
        "All laws: energy, tension and peak force of a bounce",
        "(no figure of its own) The standard wall puts out energy, the two new controllers hardly "
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
    """A force of each law over the peak force of the continuous wall that it renders."""
    damping = {law: choice.damping for laws in GROUPS.values() for law, choice in laws.items()}
    return {
        law: _values(of_law, name) / referents[damping[law]].peak for law, of_law in results.items()
    }


def _columns(
    grid: Array, results: Mapping[str, list[LawResult]], referents: Mapping[float, LawResult]
) -> dict[str, NDArray[np.generic]]:
    """One row for each law and θ."""
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
    """Largest θ up to which no phase of entry gains more than rounding; 0 where there is none."""
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
        f"{_listed(always)}, up to some θ with {_listed(partly)}, while already at "
        f"θ = {grid[0]:g} some phase gains with {_listed(never)} (push_only plans no more than "
        f"{HORIZON} periods at once). {_listed(pushing)} never pull; of the balls "
        f"that come at the θ worst for it, some never come out again as far as they were followed, "
        f"and do not count: {_listed(kept)}."
    )


def _listed(items: list[str]) -> str:
    return ", ".join(items) or "none"


def _draw(
    grid: Array, results: Mapping[str, list[LawResult]], referents: Mapping[float, LawResult]
) -> Figure:
    figure = Figure(figsize=(13.0, 11.0), layout="constrained", dpi=120)
    grids = figure.subplots(3, len(GROUPS), sharex=True, sharey="row", squeeze=False)
    tensions, peaks = (_shares(name, results, referents) for name in ("tension", "peak"))
    for column, (group, laws) in zip(grids.T, GROUPS.items(), strict=True):
        energy, tension, peak = column
        energy.set_title(group)
        for number, law in enumerate(laws):
            found = results[law]
            # Some laws agree to the last bit: broken lines, each in a rhythm of its own.
            style = {
                "color": _LINES[number],
                "lw": 1.6,
                "ls": ("-", (0, (5, 2)), (2, (3, 1, 1, 1)), (0, (1, 1)))[number % 4],
            }
            energy.plot(grid, _values(found, "mean"), label=law, **style)
            energy.fill_between(
                grid,
                _values(found, "least"),
                _values(found, "most"),
                color=_LINES[number],
                alpha=0.12,
                lw=0.0,
            )
            tension.plot(grid, tensions[law], **style)
            peak.plot(grid, peaks[law], **style)
        if any(choice.damping for choice in laws.values()):
            label = f"continuous, B = {DAMPING:g} N·s/m"
            energy.axhline(referents[DAMPING].mean, color=REFERENT, ls="--", lw=1.1, label=label)
        energy.axhline(0.0, color="k", lw=0.8, zorder=1, label="continuous, undamped")
        peak.axhline(1.0, color="k", lw=0.8, zorder=1)
        handles, labels = energy.get_legend_handles_labels()
        peak.legend(handles, labels, loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=2)
        peak.set_xlabel("θ = T·√(K/m)")
    _scales(*grids[:, 0])
    return figure


def _scales(energy: Axes, tension: Axes, peak: Axes) -> None:
    plain = FuncFormatter(lambda value, place: f"{value:g}")
    energy.set_xscale("log")
    energy.xaxis.set_major_locator(FixedLocator([0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 3.0]))
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
