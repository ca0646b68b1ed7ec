"""Figures 5.8 to 5.17 of the source: the standard floor and the controllers that replace it."""

from collections.abc import Iterator

import numpy as np
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from canwall.figure_style import COLUMN_IN, PAGE_IN, line_style
from canwall.workbench.ball import CONTINUOUS, Ball, simulate_ball
from canwall.workbench.bounces import Bounces
from canwall.workbench.figure_page import (
    FORCE,
    REFERENT,
    RENDERED,
    SAMPLES,
    FigurePage,
    blank,
    legend_below,
    mark_delay,
)
from canwall.workbench.traces import BALL, POINTS, POSITION, TIME, Traces, around, drop_ball

Array = NDArray[np.float64]

#: Range of drop heights with which the variability in Figure 5.12 is judged [m].
DROPS = (11.0, 13.0)
#: Laws whose roots are in Figure 5.13, and the values of θ over which they move and at marks.
_ROOTS = ("standard", "half_sample", "pole_placement")
_THETAS = np.linspace(0.01, 2.0, 200)
_MARKED = (0.25, 1.0, 2.0)


def _draw_overview(
    name: str, title: str, bounces: Bounces, box: slice | None, claim: str, finding: str
) -> FigurePage:
    """Draw a few bounces with the referent's, and a box around the samples of the close-up."""
    traces = Traces.of(bounces)
    figure, axes = blank(title, TIME, POSITION)
    traces.draw(axes, samples=False)
    if box is not None:
        part = Traces.of(bounces, box)
        low, high = part.y.min(), max(part.y.max(), part.referent.max())
        span = part.t[-1] - part.t[0]
        axes.add_patch(
            Rectangle((part.t[0], low - 0.7), span, high - low + 1.4, fill=False, lw=0.9)
        )
    legend_below(figure, axes)
    return FigurePage(name, title, claim, finding, traces.columns(), figure)


def _draw_close_up(
    name: str, title: str, bounces: Bounces, contact: slice, claim: str, finding: str
) -> FigurePage:
    """Draw one contact with its samples, and the area of a pulling force."""
    traces = Traces.of(bounces, around(contact))
    figure, axes = blank(title, TIME, POSITION)
    traces.draw(axes, samples=True)
    if (pull := -traces.force).max() > 0.0:
        axes.fill_between(
            traces.t,
            0.0,
            pull / BALL.stiffness,
            where=(pull > 0.0).tolist(),
            step="post",
            color=FORCE,
            alpha=0.3,
            hatch="////",
            lw=0.0,
            label="the floor pulls",
        )
    legend_below(figure, axes)
    return FigurePage(name, title, claim, finding, traces.columns(), figure)


def draw_standard_floor() -> Iterator[FigurePage]:
    """Draw figures 5.8 and 5.9."""
    bounces = drop_ball("standard")
    contact = bounces.contacts[0]
    heights = ", ".join(f"{h:.2f}" for h in bounces.heights)
    kept = float(np.abs(drop_ball(CONTINUOUS).heights - BALL.height).max())
    yield _draw_overview(
        "figure_5_08",
        "Figure 5.8: sampled-data ball on the standard floor",
        bounces,
        around(contact),
        "The ball bounces higher and higher; the continuous ball keeps its height.",
        f"Heights of {heights} m: ln E grows by {bounces.gains.mean():.3f} a bounce. "
        f"The continuous ball keeps its {BALL.height:g} m to {kept:.0e} m.",
    )
    leaving = bounces.v[contact.stop - 1]
    traces = Traces.of(bounces, around(contact))
    yield _draw_close_up(
        "figure_5_09",
        "Figure 5.9: sampled-data ball on the standard floor, close-up",
        bounces,
        contact,
        "The floor's behaviour is non-physical: as in Figure 5.3 the held force is too small on "
        "the way in and too large on the way out.",
        f"The ball came in at {np.sqrt(2.0 * BALL.gravity * BALL.height):.2f} m/s and passes the "
        f"first sample outside at {leaving:.2f} m/s. It dives to {traces.y.min():.2f} m (the "
        f"continuous ball to {traces.referent.min():.2f} m), and at the end of the close-up is "
        f"{traces.y[-1] - traces.referent[-1]:.2f} m above the continuous ball.",
    )


def force_crossing_phases(bounces: Bounces, contact: slice) -> Array:
    """Return the phases, 0 … 1, at which the held forces of a contact fit the position: f = −K·y.

    Periods in which the position does not cross −f/K are left out: at the turning point and at
    the end of the contact.
    """
    times = [
        bounces.crossing(j, -bounces.force[j] / bounces.ball.stiffness)
        for j in range(contact.start, contact.stop - 2)
    ]
    return np.array([t / bounces.ball.period for t in times if np.isfinite(t)])


def strongest_pull(bounces: Bounces) -> slice:
    """Return the contact in which the floor pulls most."""
    return min(bounces.contacts, key=lambda c: float(bounces.force[c].min()))


def draw_half_sample() -> Iterator[FigurePage]:
    """Draw figures 5.10 and 5.11."""
    bounces, standard = drop_ball("half_sample"), drop_ball("standard")
    contact = strongest_pull(bounces)
    off = np.abs(bounces.heights[1:] / BALL.height - 1.0)
    yield _draw_overview(
        "figure_5_10",
        "Figure 5.10: half-sample prediction",
        bounces,
        around(contact),
        "Vastly improved over the standard floor, but deviations from the desired path can "
        "already be seen.",
        f"After {len(bounces.contacts)} bounces the height is {bounces.heights[-1]:.2f} m "
        f"(standard floor, after {len(standard.contacts)}: {standard.heights[-1]:.2f} m); it is "
        f"off the {BALL.height:g} m by up to {off.max():.1%}.",
    )
    phases = force_crossing_phases(bounces, contact)
    last = contact.stop - 2
    pull = -bounces.force[last]
    taken = pull * (bounces.y[last + 1] - bounces.y[last])
    yield _draw_close_up(
        "figure_5_11",
        "Figure 5.11: half-sample prediction, close-up",
        bounces,
        contact,
        "The stairs of the held force meet the position about midway between the samples; in the "
        "last period of the contact the floor pulls, and the ball does work on it.",
        f"They meet at {phases.mean():.3f} of the period ({phases.min():.3f} to "
        f"{phases.max():.3f}, {len(phases)} periods). In the last one the floor pulls with "
        f"{pull:.3f} N and takes {taken:.3f} J.",
    )


def draw_long_term(seconds: float, drops: int) -> Iterator[FigurePage]:
    """Draw figure 5.12 over this time, and judge its variability with `drops` drop heights."""
    bounces = drop_ball("half_sample", seconds)
    t, y = bounces.between(POINTS)
    title = "Figure 5.12: half-sample prediction, long-term"
    figure, axes = blank(title, TIME, "height y [m]", (PAGE_IN, 3.6))
    axes.axhline(0.0, color="0.6", lw=0.8)
    axes.plot(t, y, color=SAMPLES, lw=0.4, alpha=0.7, label="sampled-data floor")
    top = 1 + np.flatnonzero((y[1:-1] > 0.0) & (y[1:-1] > y[:-2]) & (y[1:-1] >= y[2:]))
    axes.plot(t[top], y[top], "o", color=SAMPLES, ms=4.0, label="height of a bounce")
    axes.axhline(BALL.height, color=REFERENT, ls="--", lw=1.3, label="continuous floor's height")
    axes.margins(x=0.01)
    legend_below(figure, axes)
    heights = bounces.heights[1:]
    both = sum(
        h.min() < 0.99 * h[0] and h.max() > 1.01 * h[0]
        for h in (drop_ball("half_sample", seconds, s).heights for s in np.linspace(*DROPS, drops))
    )
    yield FigurePage(
        "figure_5_12",
        title,
        "The height of the bounces is irregular, sometimes above the target, sometimes below it.",
        f"Over {len(heights)} bounces the height lies between {heights.min() / BALL.height:.1%} "
        f"and {heights.max() / BALL.height:.1%} of the target; ln E changes by "
        f"{bounces.gains.mean():+.4f} a bounce, standard deviation {bounces.gains.std():.4f}. Of "
        f"{drops} drops from {DROPS[0]:g} to {DROPS[1]:g} m {both} deviate both more than 1% above "
        "and more than 1% below their first height in this time.",
        {"t [s]": t, "y rendered [m]": y, "y target [m]": np.full(len(t), BALL.height)},
        figure,
    )


def closed_loop_roots(law: str, theta: float) -> NDArray[np.complex128]:
    """Return the roots of the ball on a law's floor, from state to state inside; shape (2,).

    They are those of the law as it is compiled: of the affine map of one period, which three
    states tell. Time is in units of √(m/K), as θ = T·√(K/m).
    """
    inside = ((-9.0, 0.0), (-9.1, 0.0), (-9.0, 0.1))
    after = np.array(
        [
            [z[1] for z in simulate_ball(Ball(height=y, speed=v, period=theta, periods=1), law)[:2]]
            for y, v in inside
        ]
    )
    steps = (after[1:] - after[0]) / np.array([[-0.1], [0.1]])
    return np.asarray(np.linalg.eigvals(steps.T), dtype=np.complex128)


def draw_roots() -> Iterator[FigurePage]:
    """Draw figure 5.13."""
    title = "Figure 5.13: roots of the floor in the z-plane"
    figure, axes = blank(title, "Re z [1]", "Im z [1]", (COLUMN_IN, 4.4))
    angle = np.linspace(0.0, np.pi, 200)
    axes.plot(np.cos(angle), np.sin(angle), color=REFERENT, lw=1.0, ls="--", label="unit circle")
    columns: dict[str, Array] = {"theta [1]": _THETAS}
    found = {}
    for number, law in enumerate(_ROOTS):
        roots = {theta: closed_loop_roots(law, theta) for theta in (*_THETAS, *_MARKED)}
        upper = {theta: pair[np.argmax(pair.imag)] for theta, pair in roots.items()}
        locus = np.array([upper[theta] for theta in _THETAS])
        style = line_style(number)
        mark = style.pop("marker")
        # Marks where θ has the values that are named.
        marked = [int(np.argmin(np.abs(_THETAS - theta))) for theta in _MARKED]
        axes.plot(
            locus.real,
            locus.imag,
            lw=1.5,
            marker=mark,
            markevery=marked,
            ms=6.0,
            label=law,
            **style,
        )
        at = np.array([upper[theta] for theta in _MARKED])
        columns |= {f"Re z {law} [1]": locus.real, f"Im z {law} [1]": locus.imag}
        found[law] = np.abs(at)
    columns |= {"Re z desired [1]": np.cos(_THETAS), "Im z desired [1]": np.sin(_THETAS)}
    for theta in _MARKED:
        place = 0.9 * np.array([np.cos(theta), np.sin(theta)])
        left = theta > 0.5 * np.pi
        axes.annotate(f"θ = {theta:g}", place, ha="left" if left else "right", va="top")
    axes.locator_params(nbins=6)
    axes.axhline(0.0, color="0.6", lw=0.8)
    axes.set_aspect("equal")
    legend_below(figure, axes)
    moduli = "; ".join(
        f"{law} {', '.join(f'{modulus:.4f}' for modulus in of_law)}"
        for law, of_law in found.items()
    )
    yield FigurePage(
        "figure_5_13",
        title,
        "The roots of the sampled system that are wanted are those of a mass on a spring, a pair "
        "on the unit circle; the state feedback puts them there.",
        f"The wanted roots are exp(±iθ). Modulus at θ = {', '.join(f'{x:g}' for x in _MARKED)} "
        f"(above 1 a contact gains energy): {moduli}.",
        columns,
        figure,
    )


def continuous_crossings() -> tuple[float, float]:
    """Return the times at which the ball enters the continuous floor and leaves it [s] (5.11)."""
    entry = np.sqrt(2.0 * BALL.height / BALL.gravity)
    omega = np.sqrt(BALL.stiffness / BALL.mass)
    inside = 2.0 * (np.pi - np.arctan(omega * entry)) / omega
    return float(entry), float(entry + inside)


def draw_sampling_points() -> Iterator[FigurePage]:
    """Draw figure 5.15."""
    entry, leave = continuous_crossings()
    period = BALL.period
    m, n = int(np.ceil(entry / period)), int(np.ceil(leave / period))
    traces = Traces.of(drop_ball("half_sample+deadbeat"), slice(m - 2, n + 1))
    title = "Figure 5.15: sampling points in one contact"
    figure, axes = blank(title, TIME, "height y [m]")
    axes.axhline(0.0, color="0.6", lw=0.8)
    axes.plot(traces.t, traces.referent, color=RENDERED, lw=2.0, label="continuous floor")
    at = traces.at_sample == 1
    t, y = traces.t[at], traces.referent[at]
    axes.plot(t, y, "o", color=SAMPLES, ms=4.0, label="sampling points")
    mark_delay(axes, "Δt$_a$", (m - 1) * period, entry)
    mark_delay(axes, "Δt$_b$", leave, n * period)
    for name, sample, x, side in (
        ("$t_{m-1}$", m - 1, -8.0, "right"),
        ("$t_m$", m, -8.0, "right"),
        ("$t_{n-1}$", n - 1, 8.0, "left"),
        ("$t_n$", n, 8.0, "left"),
    ):
        axes.annotate(
            name,
            (sample * period, y[sample - (m - 2)]),
            xytext=(x, 0.0),
            textcoords="offset points",
            ha=side,
            va="center",
            fontsize=11,
        )
    axes.margins(x=0.15, y=0.15)
    legend_below(figure, axes)
    yield FigurePage(
        "figure_5_15",
        title,
        "Samples fall anywhere on the motion of a strike; the first inside is named m, the first "
        "outside again n, and the times next to them, before the entry and after the exit, are "
        "what the compensation computes.",
        f"m = {m}, n = {n}: the ball flies for Δt_a = {entry - (m - 1) * period:.4f} s after the "
        f"last sample outside, and has left for Δt_b = {n * period - leave:.4f} s at the first one "
        f"(T = {period:g} s).",
        {"t [s]": traces.t, "at a sample [0 or 1]": traces.at_sample, "y [m]": traces.referent},
        figure,
    )


def draw_pole_placement() -> Iterator[FigurePage]:
    """Draw figure 5.14."""
    bounces, other = drop_ball("pole_placement"), drop_ball("half_sample")
    count = min(len(bounces.heights), len(other.heights))
    apart = np.abs(bounces.heights[:count] / other.heights[:count] - 1.0)
    off = np.abs(bounces.heights[1:] / BALL.height - 1.0)
    yield _draw_overview(
        "figure_5_14",
        "Figure 5.14: controller designed in the digital domain (pole placement)",
        bounces,
        None,
        "Essentially the response of the half-sample prediction; still not perfect, because of "
        "the switching at the threshold.",
        f"The heights differ from the half-sample prediction's by up to {apart.max():.1%}, and "
        f"from the target by up to {off.max():.1%}.",
    )


def draw_deadbeat() -> Iterator[FigurePage]:
    """Draw figures 5.16 and 5.17."""
    bounces = drop_ball("half_sample+deadbeat")
    contact = strongest_pull(bounces)
    error = np.abs(bounces.heights / BALL.height - 1.0).max()
    traces = Traces.of(bounces)
    outside = (traces.at_sample == 1) & (traces.y >= 0.0) & (traces.force == 0.0)
    apart = np.abs(traces.y - traces.referent)
    yield _draw_overview(
        "figure_5_16",
        "Figure 5.16: full control algorithm (half-sample prediction with deadbeat)",
        bounces,
        around(contact),
        "The result is indistinguishable from the continuous target.",
        f"Every bounce regains its height to {error:.0e}; at the samples outside the ball is "
        f"within {apart[outside].max():.0e} m of the continuous one, inside within "
        f"{apart[traces.y < 0.0].max():.3f} m.",
    )
    last = contact.stop - 2
    forces = bounces.force[last - 1 : last + 1]
    part = Traces.of(bounces, around(contact))
    inside = np.abs(part.y - part.referent).max()
    yield _draw_close_up(
        "figure_5_17",
        "Figure 5.17: full control algorithm, close-up",
        bounces,
        contact,
        "The last two forces of the contact drive the ball to the state that the continuous floor "
        "would give it at the first sample outside.",
        f"Those two are {forces[0]:.3f} N and {forces[1]:.3f} N. Within the contact the two "
        f"balls are up to {inside:.3f} m apart; at the first sample outside "
        f"{abs(part.y[-1] - part.referent[-1]):.0e} m.",
    )
