"""Figures 5.3 to 5.17 of the source: the ball on a floor rendered by its laws.

One ball for all of them: 1 kg dropped from 12 m onto 1 N/m under 1 m/s², sampled every 0.25 s
(θ = 0.25): contacts of some 14 periods, few enough for the held force to be seen as stairs.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from canwall import metrics
from canwall.workbench.ball import Ball
from canwall.workbench.bounces import Bounces, continuous_between, over_phases
from canwall.workbench.sheet import (
    ACCENT,
    FORCE,
    REFERENT,
    RENDERED,
    Sheet,
    blank,
    legend_below,
    stairs,
)

Array = NDArray[np.float64]

BALL = Ball(stiffness=1.0, mass=1.0, gravity=1.0, height=12.0, period=0.25)
#: What the figures of a few bounces cover, and Figure 5.12 [s].
SHORT_S = 45.0
LONG_S = 900.0
#: Instants to the period at which the motion is drawn.
POINTS = 20
#: Entry speed for what is averaged over the phases of entry (theory, section 7) [m/s].
ENTRY_SPEED = 5.0

_TIME, _POSITION = "time t [s]", "height y, held force as −f/K [m]"


def fall(law: str, seconds: float = SHORT_S, height: float = BALL.height) -> Bounces:
    """The ball of the figures on a floor rendered by that law."""
    periods = round(seconds / BALL.period)
    return Bounces.on(replace(BALL, height=height, periods=periods), law)


def gains_over_phases(law: str, phases: int) -> Array:
    """Change of ln E by one bounce, for entries spread evenly over a period; shape (phases,)."""
    ball = replace(BALL, periods=round(10.0 / BALL.period))
    strikes = over_phases(ball, law, ENTRY_SPEED, phases)
    return np.array([strike.gains[0] for strike in strikes])


@dataclass(frozen=True)
class Traces:
    """What is drawn of a stretch of samples: motion, held force, continuous referent."""

    t: Array
    y: Array
    force: Array
    referent: Array
    at_sample: NDArray[np.int64]

    @classmethod
    def of(cls, bounces: Bounces, samples: slice | None = None) -> "Traces":
        """Of the samples from samples.start to samples.stop, both with; or of all."""
        t, y = bounces.between(POINTS)
        fine = slice(None)
        if samples is not None:
            fine = slice(samples.start * POINTS, samples.stop * POINTS + 1)
        force = np.append(np.repeat(bounces.force[:-1], POINTS), bounces.force[-1])
        at_sample = (np.arange(len(t)) % POINTS == 0).astype(np.int64)
        referent = continuous_between(bounces.ball, POINTS)
        return cls(t[fine], y[fine], force[fine], referent[fine], at_sample[fine])

    def columns(self) -> dict[str, Array | NDArray[np.int64]]:
        """For the CSV."""
        return {
            "t [s]": self.t,
            "at a sample [0 or 1]": self.at_sample,
            "y rendered [m]": self.y,
            "y continuous [m]": self.referent,
            "f held [N]": self.force,
            "-f/K [m]": -self.force / BALL.stiffness,
        }

    def draw(self, axes: Axes, samples: bool) -> None:
        """Referent dashed, rendered motion solid, force as stairs; where wanted its samples."""
        axes.axhline(0.0, color="k", lw=0.8)
        axes.plot(self.t, self.y, color=RENDERED, lw=1.6, label="sampled-data floor")
        # Dashed over solid: where the two agree, both are to be seen.
        axes.plot(self.t, self.referent, color=REFERENT, lw=1.1, ls="--", label="continuous floor")
        if samples:
            at = self.at_sample == 1
            axes.plot(self.t[at], self.y[at], "o", color=RENDERED, ms=3.5, label="samples")
        stairs(axes, self.t, -self.force / BALL.stiffness, "held force, −f/K")
        axes.margins(x=0.01)


def _around(contact: slice) -> slice:
    """A contact with a few samples of flight on either side."""
    return slice(contact.start - 3, contact.stop + 2)


def _short(
    name: str, title: str, bounces: Bounces, box: slice | None, claim: str, finding: str
) -> Sheet:
    """A few bounces beside the referent's, the close-up's part of them boxed."""
    traces = Traces.of(bounces)
    figure, axes = blank(title, _TIME, _POSITION)
    traces.draw(axes, samples=False)
    if box is not None:
        part = Traces.of(bounces, box)
        low, high = part.y.min(), max(part.y.max(), part.referent.max())
        span = part.t[-1] - part.t[0]
        axes.add_patch(
            Rectangle((part.t[0], low - 0.7), span, high - low + 1.4, fill=False, lw=0.9)
        )
    legend_below(figure, axes)
    return Sheet(name, title, claim, finding, traces.columns(), figure)


def _close_up(
    name: str, title: str, bounces: Bounces, contact: slice, claim: str, finding: str
) -> Sheet:
    """One contact, the samples marked; a force that pulls filled out."""
    traces = Traces.of(bounces, _around(contact))
    figure, axes = blank(title, _TIME, _POSITION)
    traces.draw(axes, samples=True)
    if (pull := -traces.force).max() > 0.0:
        axes.fill_between(
            traces.t,
            0.0,
            pull / BALL.stiffness,
            where=(pull > 0.0).tolist(),
            step="post",
            color=FORCE,
            alpha=0.35,
            lw=0.0,
            label="the floor pulls",
        )
    legend_below(figure, axes)
    return Sheet(name, title, claim, finding, traces.columns(), figure)


def work_in_and_out(bounces: Bounces, contact: slice) -> tuple[float, float]:
    """Work done on the floor while the ball moves in, and by it while the ball moves out [J]."""
    traces = Traces.of(bounces, slice(contact.start - 1, contact.stop - 1))
    work = traces.force[:-1] * np.diff(traces.y)
    return float(-work[work < 0.0].sum()), float(work[work > 0.0].sum())


def tracing_out() -> Iterator[Sheet]:
    """Figure 5.3."""
    bounces = fall("standard")
    contact = bounces.contacts[0]
    traces = Traces.of(bounces, slice(contact.start - 1, contact.stop - 1))
    depth = -traces.y
    deepest = float(depth.max())
    title = "Figure 5.3: tracing out the virtual wall"
    figure, axes = blank(title, "penetration x = −y [m]", "force f out of the wall [N]", (7.0, 5.4))
    # Held over each interval: along x at constant force, then the step to the next.
    x, force = np.repeat(depth, 2)[1:], np.repeat(traces.force, 2)[:-1]
    axes.fill(x, force, color=FORCE, alpha=0.15, lw=0.0, label="energy put out")
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
    yield Sheet(
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
    """What the ball's first contact takes and gives on the continuous floor: ½·K·x² [J]."""
    depth = -continuous_between(replace(BALL, periods=round(SHORT_S / BALL.period)), 200).min()
    return float(0.5 * BALL.stiffness * depth**2)


def switching_delays(bounces: Bounces, contact: slice) -> tuple[float, float]:
    """(Δt_a, Δt_b): from crossing the threshold to the sample that switches the wall [s]."""
    period = bounces.ball.period
    return (
        period - bounces.passing(contact.start - 1),
        period - bounces.passing(contact.stop - 2),
    )


def time_chart(phases: int) -> Iterator[Sheet]:
    """Figure 5.4; its effect on the energy from this many phases of entry."""
    bounces = fall("standard")
    contact = bounces.contacts[0]
    traces = Traces.of(bounces, _around(contact))
    title = "Figure 5.4: time chart of one strike"
    figure, axes = blank(title, _TIME, _POSITION)
    axes.axhline(0.0, color="k", lw=0.8)
    axes.plot(traces.t, traces.y, color=RENDERED, lw=1.4, label="position y")
    at = traces.at_sample == 1
    axes.plot(traces.t[at], traces.y[at], "o", color=RENDERED, ms=3.5, label="samples")
    stairs(axes, traces.t, -traces.force / BALL.stiffness, "held force, −f/K")
    on_s, off_s = switching_delays(bounces, contact)
    for name, switched, delay in (
        ("Δt$_a$", bounces.t[contact.start], on_s),
        ("Δt$_b$", bounces.t[contact.stop - 1], off_s),
    ):
        axes.axvspan(switched - delay, switched, color=ACCENT, alpha=0.3, lw=0.0)
        axes.annotate(
            name,
            (switched - 0.5 * delay, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0.0, -3.0),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=12,
        )
    axes.margins(x=0.01, y=0.1)
    legend_below(figure, axes)
    stored = 0.5 * BALL.stiffness * bounces.y[contact.start] ** 2
    pushed = bounces.force[contact.stop - 2] * bounces.y[contact.stop - 1]
    hold, alone = gains_over_phases("standard", phases), gains_over_phases("half_sample", phases)
    yield Sheet(
        "figure_5_04",
        title,
        "The wall is switched on Δt_a after the threshold, with its spring compressed by no work, "
        "and off Δt_b after it; both delays are energy-producing.",
        f"Δt_a = {on_s:.4f} s, with {stored:.4f} J in the spring that nobody put there; "
        f"Δt_b = {off_s:.4f} s, in which the last force does {pushed:.4f} J. "
        f"Over all phases of entry at {ENTRY_SPEED:g} m/s the strike changes ln E by "
        f"{hold.min():+.3f} to {hold.max():+.3f}; with the hold compensated (half_sample), the "
        f"switching that is left changes it by {alone.min():+.3f} to {alone.max():+.3f}, "
        f"{alone.mean():+.4f} on average: by itself it gives at some phases and takes at others.",
        traces.columns(),
        figure,
    )


def sampled_data() -> Iterator[Sheet]:
    """Figures 5.8 and 5.9."""
    bounces = fall("standard")
    contact = bounces.contacts[0]
    heights = ", ".join(f"{h:.2f}" for h in bounces.heights)
    yield _short(
        "figure_5_08",
        "Figure 5.8: sampled-data ball on the standard floor",
        bounces,
        _around(contact),
        "The ball bounces higher and higher; the continuous ball keeps its height.",
        f"Heights of {heights} m: ln E grows by {bounces.gains.mean():.3f} a bounce. "
        f"The continuous ball deviates from its {BALL.height:g} m by "
        f"{_continuous_deviation():.0e} m.",
    )
    leaving = bounces.v[contact.stop - 1]
    traces = Traces.of(bounces, _around(contact))
    yield _close_up(
        "figure_5_09",
        "Figure 5.9: sampled-data ball on the standard floor, close-up",
        bounces,
        contact,
        "The stairs of the held force lag the position, and the ball leaves the floor faster than "
        "it came.",
        f"Each force is held from the sample it belongs to, half a period "
        f"({0.5 * BALL.period:g} s) late on average. At the end of the close-up the ball is "
        f"{traces.y[-1] - traces.referent[-1]:.2f} m above the continuous one; the first sample "
        f"outside it passes at {leaving:.2f} m/s, and it had come in at "
        f"{np.sqrt(2.0 * BALL.gravity * BALL.height):.2f} m/s.",
    )


def _continuous_deviation() -> float:
    energies = fall("continuous").heights
    return float(np.abs(energies - BALL.height).max())


def meetings(bounces: Bounces, contact: slice) -> Array:
    """Where in its period each force of a contact meets the position that it stands for; 0 … 1.

    Left out are the periods within which they do not meet once: about the turning point, and
    where the ball leaves.
    """
    found = [
        bounces.passing(j, -bounces.force[j] / bounces.ball.stiffness)
        for j in range(contact.start, contact.stop - 2)
    ]
    return np.array([t / bounces.ball.period for t in found if np.isfinite(t)])


def strongest_pull(bounces: Bounces) -> slice:
    """The contact in which the floor pulls most."""
    return min(bounces.contacts, key=lambda c: float(bounces.force[c].min()))


def half_sample() -> Iterator[Sheet]:
    """Figures 5.10 and 5.11."""
    bounces = fall("half_sample")
    contact = strongest_pull(bounces)
    off = np.abs(bounces.heights[1:] / BALL.height - 1.0)
    yield _short(
        "figure_5_10",
        "Figure 5.10: half-sample prediction",
        bounces,
        _around(contact),
        "Vastly improved over the standard floor, but deviations from the desired path can "
        "already be seen.",
        f"After {len(bounces.contacts)} bounces the height is {bounces.heights[-1]:.2f} m "
        f"(standard after {len(fall('standard').contacts)}: "
        f"{fall('standard').heights[-1]:.2f} m); it is off the {BALL.height:g} m by up to "
        f"{off.max():.1%}.",
    )
    met = meetings(bounces, contact)
    last = contact.stop - 2
    pull = -bounces.force[last]
    taken = pull * (bounces.y[last + 1] - bounces.y[last])
    yield _close_up(
        "figure_5_11",
        "Figure 5.11: half-sample prediction, close-up",
        bounces,
        contact,
        "The stairs of the held force meet the position about midway between the samples; in the "
        "last period of the contact the floor pulls, and the ball does work on it.",
        f"They meet at {met.mean():.3f} of the period ({met.min():.3f} to {met.max():.3f}, "
        f"{len(met)} periods). In the last one the floor pulls with {pull:.3f} N and takes "
        f"{taken:.3f} J.",
    )


def long_term(seconds: float, drops: int) -> Iterator[Sheet]:
    """Figure 5.12 over that time; how typical it is from this many heights of drop."""
    bounces = fall("half_sample", seconds)
    t, y = bounces.between(POINTS)
    title = "Figure 5.12: half-sample prediction, long-term"
    figure, axes = blank(title, _TIME, "height y [m]", (11.0, 4.6))
    axes.axhline(0.0, color="k", lw=0.8)
    axes.plot(t, y, color=RENDERED, lw=0.4, alpha=0.7, label="sampled-data floor")
    top = 1 + np.flatnonzero((y[1:-1] > 0.0) & (y[1:-1] > y[:-2]) & (y[1:-1] >= y[2:]))
    axes.plot(t[top], y[top], "o", color=RENDERED, ms=4.0, label="height of a bounce")
    axes.axhline(BALL.height, color=REFERENT, ls="--", lw=1.3, label="continuous floor's height")
    axes.margins(x=0.01)
    legend_below(figure, axes)
    heights = bounces.heights[1:]
    both = sum(
        h.min() < 0.99 * h[0] and h.max() > 1.01 * h[0]
        for h in (fall("half_sample", seconds, start).heights for start in drop_heights(drops))
    )
    yield Sheet(
        "figure_5_12",
        title,
        "The height of the bounces is irregular, sometimes above the target, sometimes below it.",
        f"Over {len(heights)} bounces the height lies between {heights.min() / BALL.height:.1%} "
        f"and {heights.max() / BALL.height:.1%} of the target; ln E changes by "
        f"{bounces.gains.mean():+.4f} a bounce, standard deviation {bounces.gains.std():.4f}. Of "
        f"{drops} drops from 11 to 13 m {both} come out more than 1 % above their height as well "
        "as more than 1 % below it in this time.",
        {"t [s]": t, "y rendered [m]": y, "y target [m]": np.full(len(t), BALL.height)},
        figure,
    )


def drop_heights(drops: int) -> Array:
    """From where the balls fall that tell how typical Figure 5.12 is [m]."""
    return np.linspace(11.0, 13.0, drops)


def digital_design() -> Iterator[Sheet]:
    """Figure 5.14."""
    bounces, other = fall("pole_placement"), fall("half_sample")
    count = min(len(bounces.heights), len(other.heights))
    apart = np.abs(bounces.heights[:count] / other.heights[:count] - 1.0)
    off = np.abs(bounces.heights[1:] / BALL.height - 1.0)
    yield _short(
        "figure_5_14",
        "Figure 5.14: controller designed in the digital domain (pole placement)",
        bounces,
        None,
        "Essentially the response of the half-sample prediction; still not perfect, because of "
        "the switching at the threshold.",
        f"The heights differ from the half-sample prediction's by up to {apart.max():.1%}, and "
        f"from the target by up to {off.max():.1%}.",
    )


def with_deadbeat() -> Iterator[Sheet]:
    """Figures 5.16 and 5.17."""
    bounces = fall("half_sample+deadbeat")
    contact = strongest_pull(bounces)
    error = np.abs(bounces.heights / BALL.height - 1.0).max()
    traces = Traces.of(bounces)
    outside = (traces.at_sample == 1) & (traces.y >= 0.0) & (traces.force == 0.0)
    apart = np.abs(traces.y - traces.referent)
    yield _short(
        "figure_5_16",
        "Figure 5.16: full control algorithm (half-sample prediction with deadbeat)",
        bounces,
        _around(contact),
        "The result is indistinguishable from the continuous target.",
        f"Every bounce regains its height to {error:.0e}; at the samples outside the ball is "
        f"within {apart[outside].max():.0e} m of the continuous one, inside within "
        f"{apart[traces.y < 0.0].max():.3f} m.",
    )
    last = contact.stop - 2
    forces = bounces.force[last - 1 : last + 1]
    part = Traces.of(bounces, _around(contact))
    inside = np.abs(part.y - part.referent).max()
    yield _close_up(
        "figure_5_17",
        "Figure 5.17: full control algorithm, close-up",
        bounces,
        contact,
        "The last two forces of the contact drive the ball to the state that the continuous floor "
        "would give it at the first sample outside.",
        f"Here these two are {forces[0]:.3f} N and {forces[1]:.3f} N. Within the contact the two "
        f"balls are up to {inside:.3f} m apart; at the first sample outside "
        f"{abs(part.y[-1] - part.referent[-1]):.0e} m.",
    )
