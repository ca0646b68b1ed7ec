"""Colours as colour-blind readers see them, and what of a figure they tell apart."""

import itertools

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text
from numpy.typing import NDArray

from canwall.figure_style import COLUMN_IN

Array = NDArray[np.float64]

#: Machado, Oliveira and Fernandes (2009), table 1, severity 1.0, for linear RGB.
VISIONS = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
    "tritanopia": np.array(
        [
            [1.255528, -0.076749, -0.178779],
            [-0.078411, 0.930809, 0.147602],
            [0.004733, 0.691367, 0.303900],
        ]
    ),
}
#: Least distance ΔE*ab of colours that stand for different things; 2.3 are just noticeable.
APART = 15.0
_MILLIMETRE = 1.0 / 25.4


def seen(colour: object, vision: str) -> Array:
    """Return the linear RGB of a colour as it is seen."""
    coded = np.array(to_rgb(colour))  # type: ignore[arg-type]
    linear = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    return np.clip(VISIONS[vision] @ linear, 0.0, 1.0)


def lab(linear: Array) -> Array:
    """Return L*, a*, b* of linear RGB, under D65."""
    to_xyz = np.array(
        [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    )
    xyz = to_xyz @ linear / to_xyz.sum(axis=1)
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz * (29 / 6) ** 2 / 3 + 4 / 29)
    return np.array([116.0 * f[1] - 16.0, 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])])


def distance(one: object, other: object, vision: str) -> float:
    """Return ΔE*ab (CIE 1976) of two colours as they are seen."""
    return float(np.linalg.norm(lab(seen(one, vision)) - lab(seen(other, vision))))


def least_distance(one: object, other: object) -> float:
    return min(distance(one, other, vision) for vision in VISIONS)


def _look(handle: object) -> tuple[object, tuple[object, ...]]:
    """Return the colour of a legend's entry, and what else it differs in."""
    if isinstance(handle, Line2D):
        pattern = handle._unscaled_dash_pattern  # type: ignore[attr-defined]
        marker = None if handle.get_marker() in ("None", "none", "") else handle.get_marker()
        return handle.get_color(), ("line", str(pattern), marker, handle.get_linewidth() > 1.8)
    assert isinstance(handle, Patch)
    face = handle.get_facecolor()
    return face, ("area", handle.get_hatch())


def _lightness(colour: object) -> float:
    return float(lab(seen(colour, "normal"))[0])


def assert_told_apart(figure: Figure) -> int:
    """Assert that entries of a legend differ in form, and in colour if they differ in it at all.

    Returns the number of pairs.
    """
    pairs = 0
    for legend in figure.findobj(Legend):
        handles = legend.legend_handles
        texts = [text.get_text() for text in legend.get_texts()]
        looks = [_look(handle) for handle in handles]
        for (one, a), (other, b) in itertools.combinations(zip(texts, looks, strict=True), 2):
            pairs += 1
            if a[1] == b[1]:  # areas may differ in their lightness
                shades = abs(_lightness(a[0]) - _lightness(b[0]))
                assert a[1][0] == "area", f"{one} and {other} differ in nothing but colour"
                assert shades >= 0.5 * APART, f"{one} and {other} are as light"
            if to_rgb(a[0]) != to_rgb(b[0]):  # type: ignore[arg-type]
                assert least_distance(a[0], b[0]) >= APART, f"{one} and {other}"
    return pairs


def assert_readable(figure: Figure) -> None:
    """Assert 6 points and more in a column of 80 mm, or, of a wider figure, on 170 mm."""
    width = figure.get_size_inches()[0]
    printed = (80.0 if width <= COLUMN_IN else 170.0) * _MILLIMETRE
    for text in figure.findobj(Text):
        if text.get_text() and text.get_visible():
            size = text.get_fontsize() * printed / width
            assert size >= 6.0, f"{text.get_text()!r} has {size:.1f} points"


def assert_nothing_overlaps(figure: Figure) -> None:
    """Assert that no title, label or legend overlaps another, or is cut off."""
    FigureCanvasAgg(figure).draw()
    boxes = []
    for axes in figure.axes:
        labels = [axes.title, axes._left_title, axes.xaxis.label, axes.yaxis.label]  # type: ignore[attr-defined]
        boxes += [
            (label.get_text(), label.get_window_extent())
            for label in labels
            if label.get_text() and label.get_visible()
        ]
    boxes += [("legend", legend.get_window_extent()) for legend in figure.legends]
    whole = figure.bbox
    for text, box in boxes:
        inside = box.x0 >= -1 and box.y0 >= -1 and box.x1 <= whole.x1 + 1 and box.y1 <= whole.y1 + 1
        assert inside, f"{text!r} is cut off"
    for (one, a), (other, b) in itertools.combinations(boxes, 2):
        assert not a.padded(-1.5).overlaps(b.padded(-1.5)), f"{one!r} and {other!r} overlap"
