"""Figures 5.1, 5.2, 5.6 and 5.7 of the source as diagrams of this program's own."""

from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch, Rectangle

from canwall.figure_style import DPI, PAGE_IN
from canwall.workbench.figure_page import FORCE, REFERENT, RENDERED, FigurePage

#: Fills: what is continuous in time, and what is sampled.
_CONTINUOUS, _SAMPLED = "#DCEBF5", "#F7EBD2"
_INK = "0.1"

Point = tuple[float, float]


class _Canvas:
    """Axes without ticks, a unit of which is as wide as it is high."""

    def __init__(self, width: float, height: float) -> None:
        size = (PAGE_IN, PAGE_IN * height / width)
        self.figure = Figure(figsize=size, layout="constrained", dpi=DPI)
        self.axes: Axes = self.figure.add_subplot()
        self.axes.set(xlim=(0.0, width), ylim=(0.0, height), aspect="equal")
        self.axes.axis("off")

    def text(self, at: Point, text: str, **style: object) -> None:
        chosen = {"ha": "center", "va": "center", "color": _INK, **style}
        self.axes.text(*at, text, **chosen)  # type: ignore[arg-type]

    def box(self, centre: Point, text: str, fill: str, size: Point = (1.5, 0.9)) -> None:
        corner = (centre[0] - 0.5 * size[0], centre[1] - 0.5 * size[1])
        self.axes.add_patch(Rectangle(corner, *size, facecolor=fill, edgecolor=_INK, lw=1.1))
        self.text(centre, text)

    def sum(self, centre: Point, signs: dict[str, Point]) -> None:
        """Draw a summing point with a sign for each input, at an offset."""
        self.axes.add_patch(Circle(centre, 0.17, facecolor="white", edgecolor=_INK, lw=1.1))
        for sign, (x, y) in signs.items():
            self.text((centre[0] + x, centre[1] + y), sign)

    def line(self, *points: Point, **style: object) -> None:
        x, y = zip(*points, strict=True)
        self.axes.plot(x, y, **{"color": _INK, "lw": 1.1, **style})  # type: ignore[arg-type]

    def arrow(self, *points: Point, **style: object) -> None:
        """Draw a line through the points with a head at its end."""
        if len(points) > 2:
            self.line(*points[:-1], **style)
        arrow = {"arrowstyle": "-|>", "shrinkA": 0.0, "shrinkB": 0.0, "color": _INK, "lw": 1.1}
        self.axes.annotate("", points[-1], points[-2], arrowprops={**arrow, **style})

    def sampler(self, left: Point, name: str) -> None:
        """Draw a switch that closes each period, one unit long, closing towards the left."""
        x, y = left
        self.line((x + 1.0, y), (x + 0.72, y))
        self.line((x + 0.72, y), (x + 0.32, y + 0.3))
        self.line((x + 0.28, y), (x, y))
        self.text((x + 0.5, y - 0.25), name)

    def unilateral(self, centre: Point, fill: str) -> None:
        """Draw a block with the graph that lets only one sign through."""
        x, y = centre
        self.box(centre, "", fill, (1.2, 0.9))
        self.line((x - 0.5, y), (x + 0.5, y), lw=0.6, color="0.5")
        self.line((x, y - 0.38), (x, y + 0.38), lw=0.6, color="0.5")
        self.line((x - 0.42, y - 0.36), (x, y), (x + 0.45, y), lw=1.8)

    def spring(self, bottom: Point, top: float, **style: object) -> None:
        """Draw a spring upwards from a point."""
        turns = 5
        x, low = bottom
        lead = 0.12 * (top - low)
        inner = np.linspace(low + lead, top - lead, 2 * turns + 2)
        side = np.r_[0.0, 0.22 * (-1.0) ** np.arange(2 * turns), 0.0]
        points = [(x, low), *zip(x + side, inner, strict=True), (x, top)]
        self.line(*((float(a), float(b)) for a, b in points), **style)


def _page(name: str, title: str, claim: str, finding: str, canvas: _Canvas) -> FigurePage:
    canvas.axes.set_title(title)
    return FigurePage(name, title, claim, finding, {}, canvas.figure)


def _sampled_loop(canvas: _Canvas, y: float, right: float, left: float) -> None:
    """Draw the way from position back to force: sampler, unilateral element, C(z), hold.

    From (right, 2.9) to (left, 2.73), along a line at the height y.
    """
    canvas.line((right, 2.9), (right, y), (right - 0.3, y))
    canvas.sampler((right - 1.3, y), "$T$")
    canvas.arrow((right - 1.3, y), (right - 1.9, y))
    canvas.text((right - 1.55, y + 0.25), "$y_k$")
    canvas.unilateral((right - 2.5, y), _SAMPLED)
    canvas.arrow((right - 3.1, y), (right - 3.7, y))
    canvas.box((right - 4.45, y), "$C(z)$", _SAMPLED)
    canvas.arrow((right - 5.2, y), (right - 5.9, y))
    canvas.text((right - 5.5, y + 0.25), "$f_k$")
    canvas.box((right - 6.65, y), "hold", _SAMPLED)
    canvas.arrow((right - 7.4, y), (left, y), (left, 2.73))
    canvas.text((left - 0.27, 0.5 * (y + 2.9)), "$f$")
    canvas.text((right - 2.5, y + 0.65), "only for $y_k < 0$")


def _legend(canvas: _Canvas, at: Point) -> None:
    for number, (fill, text) in enumerate(
        ((_CONTINUOUS, "continuous in time"), (_SAMPLED, "sampled, every $T$"))
    ):
        x, y = at[0] + 3.0 * number, at[1]
        canvas.axes.add_patch(Rectangle((x, y - 0.13), 0.4, 0.26, facecolor=fill, edgecolor=_INK))
        canvas.text((x + 0.55, y), text, ha="left")


def _draw_sampled_wall() -> FigurePage:
    canvas = _Canvas(11.0, 5.2)
    canvas.sum((2.17, 2.9), {"+": (-0.3, 0.22), "+ ": (0.25, -0.32)})
    canvas.arrow((2.34, 2.9), (4.3, 2.9))
    canvas.text((3.2, 3.15), "force")
    canvas.box((5.4, 2.9), "handle, drive\n$P(s)$", _CONTINUOUS, (2.2, 1.0))
    canvas.arrow((6.5, 2.9), (10.7, 2.9))
    canvas.text((10.3, 3.15), "$y(t)$")
    # The operator answers to the motion, about what he intends.
    canvas.arrow((8.2, 2.9), (8.2, 4.5), (6.5, 4.5))
    canvas.box((5.4, 4.5), "operator\n$H(s)$", _CONTINUOUS, (2.2, 1.0))
    canvas.arrow((4.3, 4.5), (2.17, 4.5), (2.17, 3.07))
    canvas.text((3.2, 4.75), "hand")
    _sampled_loop(canvas, 1.1, 9.7, 2.17)
    _legend(canvas, (3.2, 0.25))
    return _page(
        "figure_5_01",
        "Figure 5.1: virtual wall as a sampled-data system",
        "Handle and operator are continuous, the wall's controller is discrete; a sampler and a "
        "hold link them, and a unilateral element switches the controller.",
        "A diagram. In this program T is bus.cycle_s, C(z) one of the laws, and the hold is the "
        "drive, which keeps a torque until the next SYNC.",
        canvas,
    )


def _draw_bench() -> FigurePage:
    canvas = _Canvas(11.0, 4.6)
    axes = canvas.axes
    # The shaft from handle to encoder.
    axes.add_patch(Rectangle((1.2, 3.05), 4.6, 0.16, facecolor="0.75", edgecolor=_INK, lw=1.0))
    canvas.box((3.5, 3.13), "motor", _CONTINUOUS, (1.3, 1.1))
    canvas.box((5.6, 3.13), "encoder", _CONTINUOUS, (1.2, 0.8))
    axes.add_patch(Rectangle((1.1, 2.95), 0.28, 1.25, facecolor="0.55", edgecolor=_INK, lw=1.0))
    axes.add_patch(Circle((1.24, 4.2), 0.22, facecolor="0.35", edgecolor=_INK))
    canvas.arrow((2.15, 4.2), (1.52, 4.2), lw=1.6)
    canvas.text((2.25, 4.2), "hand", ha="left")
    # The wall, where the handle would meet it.
    axes.add_patch(
        Rectangle((0.2, 3.7), 0.5, 0.85, facecolor="0.9", edgecolor="0.5", ls="--", hatch="////")
    )
    canvas.text((0.45, 3.45), "virtual\nwall", color="0.3", va="top")
    canvas.box((3.5, 1.1), "current loop:\ntorque held", _CONTINUOUS, (1.7, 1.0))
    canvas.box((5.6, 1.1), "position\nlatched", _SAMPLED, (1.4, 1.0))
    axes.add_patch(
        FancyBboxPatch(
            (2.4, 0.35),
            4.15,
            1.45,
            boxstyle="round,pad=0.05",
            facecolor="none",
            edgecolor="0.5",
            ls="--",
        )
    )
    canvas.text((2.45, 0.1), "servo drive", color="0.3", ha="left")
    canvas.arrow((3.5, 1.6), (3.5, 2.58))
    canvas.arrow((5.6, 2.73), (5.6, 1.6))
    canvas.box((9.5, 1.1), "law of the wall\n$f_k = -K\\,y_k$ if $y_k < 0$", _SAMPLED, (2.3, 1.2))
    canvas.arrow((6.3, 1.35), (8.35, 1.35))
    canvas.text((7.45, 1.58), "TPDO: position")
    canvas.arrow((8.35, 0.85), (6.72, 0.85), (6.72, 0.2), (3.5, 0.2), (3.5, 0.6))
    canvas.text((7.55, 0.62), "RPDO: torque")
    canvas.arrow((9.5, 2.6), (9.5, 1.7))
    canvas.text((9.5, 2.8), "SYNC, every $T$")
    canvas.text((7.45, 3.5), "CAN bus between drive\nand computer", color="0.3")
    _legend(canvas, (5.9, 4.4))
    return _page(
        "figure_5_02",
        "Figure 5.2: a bench with a virtual wall",
        "A backdrivable device with an encoder and a motor; the controller gets the sampled "
        "position, and its output is held, amplified and turned into a force.",
        "A diagram of the bench that this program is for: shaft and handle in the place of a "
        "linear device, and a servo drive on a CAN bus in that of converters and amplifier.",
        canvas,
    )


def _draw_ball_on_floor() -> FigurePage:
    canvas = _Canvas(8.0, 4.4)
    axes = canvas.axes
    for x, height, title in ((2.0, 2.6, "a) floor off: y > 0"), (6.0, 1.25, "b) floor on: y < 0")):
        axes.add_patch(
            Rectangle((x - 1.3, 0.1), 2.6, 0.25, facecolor="0.9", edgecolor=_INK, hatch="////")
        )
        canvas.line((x - 1.5, 1.9), (x + 1.5, 1.9), ls="--", color=REFERENT, lw=1.0)
        canvas.text((x + 1.55, 1.9), "$y = 0$", ha="left")
        on = height < 1.9
        canvas.spring((x, 0.35), height if on else 1.9, color=FORCE, lw=1.5)
        if not on:
            canvas.line((x - 0.5, 1.9), (x + 0.5, 1.9), color=FORCE, lw=2.5)
        axes.add_patch(Circle((x, height + 0.4), 0.4, facecolor=RENDERED, edgecolor=_INK, zorder=3))
        canvas.text((x, height + 0.4), "$m$", zorder=4)
        canvas.arrow((x + 0.75, height + 0.6), (x + 0.75, height - 0.1))
        canvas.text((x + 0.9, height + 0.3), "$m\\,g$", ha="left")
        if on:
            canvas.arrow((x - 0.75, height - 0.1), (x - 0.75, height + 0.9), color=FORCE, lw=1.6)
            canvas.text((x - 0.9, height + 0.4), "$f$", ha="right")
        canvas.text((x, 4.1), title)
    return _page(
        "figure_5_06",
        "Figure 5.6: the bouncing ball as a model of operator and wall",
        "The ball stands for handle and hand, gravity for the force with which the hand presses, "
        "and a spring, in the loop below the threshold only, for the wall.",
        "A diagram; `canwall ball` simulates it, with exact motion between the samples.",
        canvas,
    )


def _draw_ball_loop() -> FigurePage:
    canvas = _Canvas(11.0, 3.9)
    canvas.arrow((0.9, 2.9), (2.0, 2.9))
    canvas.text((1.2, 3.2), "$-m\\,g$")
    canvas.sum((2.17, 2.9), {"+": (-0.3, 0.22), "+ ": (0.25, -0.32)})
    canvas.arrow((2.34, 2.9), (4.3, 2.9))
    canvas.box((5.4, 2.9), "ball\n$1/(m\\,s^2)$", _CONTINUOUS, (2.2, 1.0))
    canvas.arrow((6.5, 2.9), (10.7, 2.9))
    canvas.text((10.3, 3.15), "$y(t)$")
    _sampled_loop(canvas, 1.1, 9.7, 2.17)
    _legend(canvas, (3.2, 0.25))
    return _page(
        "figure_5_07",
        "Figure 5.7: block diagram of the bouncing ball",
        "The ball is the plant and the floor the discrete controller, which is in the loop only "
        "while the sampled position is below the threshold.",
        "A diagram. Its laws are those of the loop on the bus, where the force takes effect one "
        "SYNC later; here it acts at once.",
        canvas,
    )


def draw_wall_diagrams() -> Iterator[FigurePage]:
    """Draw figures 5.1 and 5.2."""
    yield _draw_sampled_wall()
    yield _draw_bench()


def draw_ball_diagrams() -> Iterator[FigurePage]:
    """Draw figures 5.6 and 5.7."""
    yield _draw_ball_on_floor()
    yield _draw_ball_loop()
