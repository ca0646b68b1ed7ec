"""Figures 5.3 and 5.4 of the source: the origin of the energy that the standard wall puts out."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from canwall.analysis import metrics
from canwall.figure_style import CHATTER
from canwall.workbench.bounces import Bounces, continuous_between, over_phases
from canwall.workbench.figure_page import (
    FORCE,
    REFERENT,
    RENDERED,
    SAMPLES,
    FigurePage,
    blank,
    legend_below,
    mark_delay,
    stairs,
)
from canwall.workbench.traces import BALL, POSITION, SHORT_S, TIME, Traces, around, drop_ball

Array = NDArray[np.float64]

#: Entry speed of the balls with which all phases of entry are judged (docs/results.md) [m/s].
ENTRY_SPEED = 5.0
#: Time that includes one contact of the ball, but not the next [s].
_ONE_BOUNCE_S = 10.0


def gains_over_phases(law: str, phases: int, tension: str = "allow") -> Array:
    """Return the change of ln E in a bounce for evenly spread phases of entry, shape (phases,)."""
    ball = replace(BALL, tension=tension, periods=round(_ONE_BOUNCE_S / BALL.period))
    strikes = over_phases(ball, law, ENTRY_SPEED, phases)
    return np.array([strike.gains[0] for strike in strikes])


def work_in_and_out(bounces: Bounces, contact: slice) -> tuple[float, float]:
    """Return the work done on the floor on the way in, and by the floor on the way out [J]."""
    traces = Traces.of(bounces, slice(contact.start - 1, contact.stop - 1))
    work = traces.force[:-1] * np.diff(traces.y)
    return float(-work[work < 0.0].sum()), float(work[work > 0.0].sum())


def draw_hysteresis_loop() -> Iterator[FigurePage]:
    """Draw figure 5.3."""
    bounces = drop_ball("standard")
    contact = bounces.contacts[0]
    traces = Traces.of(bounces, slice(contact.start - 1, contact.stop - 1))
    depth = -traces.y
    deepest = float(depth.max())
    title = "Figure 5.3: tracing out the virtual wall"
    figure, axes = blank(title, "penetration x = −y [m]", "force f out of the wall [N]", (4.6, 4.2))
    # Held over each interval: a line along x at constant force, then the step to the next force.
    x, force = np.repeat(depth, 2)[1:], np.repeat(traces.force, 2)[:-1]
    axes.fill(x, force, color=CHATTER, alpha=0.2, lw=0.0, label="energy put out")
    axes.plot(x, force, color=FORCE, lw=1.3, label="held force")
    line = np.array([0.0, deepest])
    axes.plot(line, BALL.stiffness * line, color=REFERENT, ls="--", lw=1.1, label="f = K·x")
    for text, tail, head in (
        ("moving in", (0.55, 0.22), (0.75, 0.42)),
        ("moving out", (0.42, 0.75), (0.22, 0.55)),
    ):
        axes.annotate(
            text,
            (head[0] * deepest, head[1] * deepest * BALL.stiffness),
            (tail[0] * deepest, tail[1] * deepest * BALL.stiffness),
            ha="center",
            color="0.2",
            arrowprops={"arrowstyle": "->", "color": "0.2"},
        )
    legend_below(figure, axes)
    put_in, given_back = work_in_and_out(bounces, contact)
    out = metrics.energy_out(bounces.y[contact], bounces.force[contact])[-1]
    columns = {
        "t [s]": traces.t,
        "at a sample [0 or 1]": traces.at_sample,
        "x [m]": depth,
        "f held [N]": traces.force,
        "K*x [N]": BALL.stiffness * depth,
    }
    yield FigurePage(
        "figure_5_03",
        title,
        "On the way in the held force is on average too low, on the way out too high against "
        "f = K·x; the negative hysteresis produces energy each time it is traversed.",
        f"Moving in takes {put_in:.3f} J, moving out gives {given_back:.3f} J: the loop's area is "
        f"{out:.3f} J, {out / bounces.energies[0]:.1%} of the ball's energy. The continuous wall "
        f"would take and give {continuous_work():.3f} J.",
        columns,
        figure,
    )


def continuous_work() -> float:
    """Return the work of the first contact on the continuous floor, in and out: ½·K·x² [J]."""
    depth = -continuous_between(replace(BALL, periods=round(SHORT_S / BALL.period)), 200).min()
    return float(0.5 * BALL.stiffness * depth**2)


def switching_delays(bounces: Bounces, contact: slice) -> tuple[float, float]:
    """Return (Δt_a, Δt_b) from crossing the threshold to the sample that switches the wall [s]."""
    period = bounces.ball.period
    return (
        period - bounces.crossing(contact.start - 1),
        period - bounces.crossing(contact.stop - 2),
    )


def draw_time_chart(phases: int) -> Iterator[FigurePage]:
    """Draw figure 5.4, and judge the effect on the energy with this many phases of entry."""
    bounces = drop_ball("standard")
    contact = bounces.contacts[0]
    traces = Traces.of(bounces, around(contact))
    title = "Figure 5.4: time chart of one strike"
    figure, axes = blank(title, TIME, POSITION)
    axes.axhline(0.0, color="0.6", lw=0.8)
    axes.plot(traces.t, traces.y, color=RENDERED, lw=2.4, label="position y")
    at = traces.at_sample == 1
    axes.plot(traces.t[at], traces.y[at], "o", color=SAMPLES, ms=4.0, label="samples")
    stairs(axes, traces.t, -traces.force / BALL.stiffness, "held force, −f/K")
    on_s, off_s = switching_delays(bounces, contact)
    for name, switched, delay in (
        ("Δt$_a$", bounces.t[contact.start], on_s),
        ("Δt$_b$", bounces.t[contact.stop - 1], off_s),
    ):
        mark_delay(axes, name, switched - delay, switched)
    axes.margins(x=0.01, y=0.1)
    legend_below(figure, axes)
    stored = 0.5 * BALL.stiffness * bounces.y[contact.start] ** 2
    pushed = bounces.force[contact.stop - 2] * bounces.y[contact.stop - 1]
    standard, pulling, pushing = (
        _format_spread(gains_over_phases(law, phases, tension))
        for law, tension in (
            ("standard", "allow"),
            ("half_sample", "allow"),
            ("half_sample", "clamp"),
        )
    )
    yield FigurePage(
        "figure_5_04",
        title,
        "The wall is switched on Δt_a after the threshold, with its spring compressed by no work, "
        "and off Δt_b after it; both delays are energy-producing.",
        f"Δt_a = {on_s:.4f} s, with {stored:.4f} J in the spring without any work done on it; "
        f"Δt_b = {off_s:.4f} s, in which the last force does {pushed:.4f} J. Over all phases of "
        f"entry at {ENTRY_SPEED:g} m/s the strike changes ln E by {standard}; the switching alone, "
        f"with the hold compensated (half_sample), by {pushing} for a wall that only pushes, and "
        f"by {pulling} for one that may pull.",
        traces.columns(),
        figure,
    )


def _format_spread(gains: Array) -> str:
    return f"{gains.mean():+.4f} ({gains.min():+.4f} to {gains.max():+.4f})"
