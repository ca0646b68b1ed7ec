"""Figures of the impedance that a person feels of a wall, and of where the wall is stable."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from numpy.typing import NDArray

from canwall import config
from canwall.analysis.analytic_limits import DiolaitiRegion, diolaiti_region
from canwall.analysis.impedance import EffectiveImpedance, impedance_at_lines, multisine
from canwall.config import Settings
from canwall.figure_style import (
    CHATTER,
    CHATTER_AREA,
    COLOURS,
    COLUMN_IN,
    DPI,
    PAGE_IN,
    QUIET_AREA,
    line_style,
)
from canwall.record import ROW
from canwall.run.closed_loop import (
    ENABLING_CYCLES,
    SIGNALS,
    ClosedLoop,
    loop_delay,
    simulate_loop,
    simulated_units,
)
from canwall.sweep.strike import OPERATORS, law_model, strike_settings
from canwall.workbench.figure_page import REFERENT, FigurePage, blank, legend_below

Array = NDArray[np.float64]

#: Laws whose impedance is drawn.
LAWS = ("standard", "damped", "energy_bounding", "virtual_coupling", "mean_force")
#: Wall and push of that figure: K [N·m/rad], B [N·m·s/rad], damping of the handle that keeps the
#: plain wall stable [N·m·s/rad], bias and amplitude of the push [N·m].
_STIFFNESS, _DAMPING, _VISCOUS = 10.0, 0.01, 0.02
_BIAS, _AMPLITUDE = -0.3, 0.15
#: Cycles of a period of the push, periods in all, and those left out at the start.
_SAMPLES, _PERIODS, _FIRST = 1000, 8, 2
#: Lines of the push, up to a quarter of the rate: beyond, the images of a push that is straight
#: between two SYNCs move the handle as well.
_LINES = np.unique(np.geomspace(1.0, 250.0, 30).round().astype(np.int64))

#: Stiffness of the plain wall in Diolaiti's plane [N·m/rad], and its axes.
_PLANE_STIFFNESS = 200.0
_BETA, _SIGMA = (0.3, 8.0), (0.03, 8.0)
#: Part of the strike in which the motion is judged [cycles before its end], and the counts of
#: motion that a limit cycle of the quantised position may have.
_JUDGED, _FEW_COUNTS = slice(-450, -300), 20
_SHADES = {
    DiolaitiRegion.PASSIVE: QUIET_AREA,
    DiolaitiRegion.LIMIT_CYCLE: "#dbe7f3",
    DiolaitiRegion.LOCALLY_STABLE: "#f7efcb",
    DiolaitiRegion.UNSTABLE: CHATTER_AREA,
}


def _bare_drive(viscous: float, coulomb: float) -> Settings:
    """Return config/ideal.toml with nobody at the handle."""
    settings = config.load(config.shipped("config/ideal.toml"))
    assert settings.simulation is not None
    nobody = {key.rsplit(".")[-1]: value for key, value in OPERATORS["none"].keys.items()}
    simulation = settings.simulation.model_copy(
        update={
            "viscous_nm_s_per_rad": viscous,
            "coulomb_nm": coulomb,
            "hand": settings.simulation.hand.model_copy(update=nobody),
        }
    )
    settings = settings.model_copy(update={"simulation": simulation, "schedule": ()})
    return settings.model_copy(update={"mechanics": law_model(settings, "matched", 0.0)})


def _on_wall(settings: Settings, law: str, stiffness: float, damping: float) -> Settings:
    wall = {
        "law": law,
        "stiffness_nm_per_rad": stiffness,
        "damping_nm_s_per_rad": damping,
    }
    return settings.model_copy(update={"wall": settings.wall.model_copy(update=wall)})


def measure_impedance(law: str) -> EffectiveImpedance:
    """Measure G of a law on the simulated drive by a multisine about a steady press."""
    damping = 0.0 if law == "standard" else _DAMPING
    settings = _on_wall(_bare_drive(_VISCOUS, 0.0), law, _STIFFNESS, damping)
    cycles = _SAMPLES * _PERIODS
    push = _BIAS + _AMPLITUDE * multisine(_LINES, _SAMPLES, _PERIODS)
    push[:ENABLING_CYCLES] = 0.0
    slope = np.diff(push, append=push[-1]) / settings.bus.cycle_s
    loop = ClosedLoop(settings, cycles).records()._replace(push=push, slope=slope)
    signals = np.empty((SIGNALS, cycles))
    simulate_loop(loop, np.zeros(1, ROW), signals)
    push, y = push.reshape(_PERIODS, -1), signals[0].reshape(_PERIODS, -1)
    found = impedance_at_lines(push[_FIRST:], y[_FIRST:], settings.bus.cycle_s, _LINES)
    # Of a line at the SYNCs, sinc² is in the straight pieces between them.
    straight = np.sinc(found.frequency * settings.bus.cycle_s) ** 2
    return replace(found, impedance=found.impedance * straight)


def draw_impedance() -> Iterator[FigurePage]:
    """Draw the stiffness and the damping that are felt, over frequency."""
    title = "Effective impedance of a wall"
    figure = Figure(figsize=(PAGE_IN, 4.2), layout="constrained", dpi=DPI)
    left, right = figure.subplots(1, 2)
    left.set_title(title)
    columns: dict[str, NDArray[np.float64]] = {}
    for number, law in enumerate(LAWS):
        style = line_style(number) | {"ms": 4.0, "mfc": "none", "lw": 1.2}
        found = measure_impedance(law)
        columns["frequency [Hz]"] = found.frequency
        columns[f"Re G {law} [N·m/rad]"] = found.impedance.real
        columns[f"B_eff {law} [N·m·s/rad]"] = found.damping
        left.plot(found.frequency, found.impedance.real, label=law, **style)
        right.plot(found.frequency, found.damping, **style)
    frequency = columns["frequency [Hz]"]
    simulation = config.load(config.shipped("config/ideal.toml")).simulation
    assert simulation is not None
    ideal = _STIFFNESS - simulation.inertia_kg_m2 * (2.0 * np.pi * frequency) ** 2
    left.plot(frequency, ideal, "--", color=REFERENT, label="continuous wall")
    right.axhline(_VISCOUS + _DAMPING, ls="--", color=REFERENT, lw=1.5)
    right.axhline(0.0, color="k", lw=0.8)
    for axes, label in (
        (left, "Re G = $K_{eff} - M_{eff}\\,ω^2$ [N·m/rad]"),
        (right, "$B_{eff}$ = Im G/ω [N·m·s/rad]"),
    ):
        axes.set_xscale("log")
        axes.set_xlabel("frequency [Hz]")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.set_ylabel(label)
    left.set_yscale("symlog", linthresh=10.0)
    left.yaxis.set_major_formatter("{x:g}")
    legend_below(figure, left)
    at_rest = ", ".join(f"{law} {columns[f'Re G {law} [N·m/rad]'][0]:.2f}" for law in LAWS)
    yield FigurePage(
        "effective_impedance",
        title,
        "What the operator feels of a wall is G(ω) = F_h/Y: a stiffness, a damping and a mass at "
        "each frequency; where the damping is negative the wall gives off energy.",
        f"K = {_STIFFNESS:g} N·m/rad on a handle of {_VISCOUS:g} N·m·s/rad, pressed with "
        f"{-_BIAS:g} N·m. Stiffness at 1 Hz: {at_rest} N·m/rad.",
        columns,
        figure,
    )


def plain_wall_motion(beta: float, sigma: float) -> float:
    """Return the motion of a plain wall that is pressed long after a strike [counts]."""
    settings = _bare_drive(0.0, 0.0)
    count, period = simulated_units(settings).rad_per_count, settings.bus.cycle_s
    viscous, coulomb = beta * _PLANE_STIFFNESS * period, sigma * _PLANE_STIFFNESS * count
    settings = _on_wall(_bare_drive(viscous, coulomb), "standard", _PLANE_STIFFNESS, 0.0)
    settings = strike_settings(settings, 0.5, 0.3, 0.01, 0.5, 0.15)
    assert settings.run.duration_s is not None
    cycles = round(settings.run.duration_s / period)
    signals = np.empty((SIGNALS, cycles))
    done = simulate_loop(ClosedLoop(settings, cycles).records(), np.zeros(1, ROW), signals)
    if done < cycles:
        return float("inf")  # a limit has ended it
    return float(np.ptp(signals[0, _JUDGED]) / count)


def draw_diolaiti_plane(points: int) -> Iterator[FigurePage]:
    """Draw the four regions, and what a plain wall does at `points` × `points` places."""
    title = "Plain wall in the plane of viscous damping and Coulomb friction (Diolaiti)"
    figure, axes = blank(title, "β = b/(K·T) [1]", "σ = $f_c$/(K·Δ) [1]", (COLUMN_IN, 4.4))
    settings = _bare_drive(0.0, 0.0)
    delay = loop_delay(settings)
    edge = 0.5 + delay
    for low, high, bottom, top in (
        (_BETA[0], edge, _SIGMA[0], 0.5),
        (_BETA[0], edge, 0.5, _SIGMA[1]),
        (edge, _BETA[1], _SIGMA[0], 0.5),
        (edge, _BETA[1], 0.5, _SIGMA[1]),
    ):
        region = diolaiti_region(np.sqrt(low * high), np.sqrt(bottom * top), delay)
        axes.fill_between([low, high], bottom, top, color=_SHADES[region], lw=0.0)
        axes.text(low * 1.06, top / 1.08, str(region), va="top")
    beta, sigma = (
        grid.ravel()
        for grid in np.meshgrid(np.geomspace(*_BETA, points), np.geomspace(*_SIGMA, points))
    )
    motion = np.array([plain_wall_motion(b, s) for b, s in zip(beta, sigma, strict=True)])
    outcomes = (
        ("comes to rest", motion <= 1.0, "o", COLOURS[1]),
        ("a cycle of some counts", (motion > 1.0) & (motion <= _FEW_COUNTS), "s", COLOURS[0]),
        ("buzzes", motion > _FEW_COUNTS, "x", CHATTER),
    )
    for label, chosen, mark, colour in outcomes:
        axes.plot(
            beta[chosen], sigma[chosen], mark, color=colour, ms=4.5, label=label, clip_on=False
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(*_BETA)
    axes.set_ylim(*_SIGMA)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")
    legend_below(figure, axes)
    passive = np.array(
        [
            diolaiti_region(b, s, delay) is DiolaitiRegion.PASSIVE
            for b, s in zip(beta, sigma, strict=True)
        ]
    )
    yield FigurePage(
        "diolaiti_plane",
        title,
        "Enough viscous damping makes up for sampling and delay, enough Coulomb friction for the "
        "encoder; without the one large motions grow, without the other small ones stay.",
        f"K = {_PLANE_STIFFNESS:g} N·m/rad, D = {delay:g}. In the passive region "
        f"{np.count_nonzero(motion[passive] <= 1.0)} of {np.count_nonzero(passive)} walls come to "
        f"rest, outside it {np.count_nonzero(motion[~passive] <= 1.0)} of "
        f"{np.count_nonzero(~passive)}.",
        {"beta [1]": beta, "sigma [1]": sigma, "motion [counts]": motion},
        figure,
    )
