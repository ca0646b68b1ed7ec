"""Colours, sizes and style of all figures; imports no plotting library."""

from typing import Any

#: Chatter, and energy that a wall puts out; no law and no signal has this colour.
CHATTER = "#D55E00"
#: Laws and signals. With CHATTER these are the colours of Okabe and Ito (2008), which colour-blind
#: readers can tell apart, without their yellow, which is too light for lines.
COLOURS = ("#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
#: The continuous wall, or whatever a figure compares with.
REFERENT = "0.25"
#: Areas of walls that do not chatter, and, darker, of those that do.
QUIET_AREA, CHATTER_AREA = "#DDF0E6", "#EDB08E"
#: Lines differ in these as well, for readers without colours.
DASHES: tuple[Any, ...] = (
    "-",
    (0, (5, 2)),
    (0, (3, 1, 1, 1)),
    (0, (1, 1)),
    (0, (9, 3)),
    (0, (5, 1, 1, 1, 1, 1)),
    (0, (2, 2)),
)
MARKS = "osD^v<>P"

#: Widths that stay readable in a column of a journal (80 mm) and over its page (170 mm): the text
#: of STYLE is then larger than 6 points [inches].
COLUMN_IN, PAGE_IN = 4.6, 8.0
DPI = 160
#: rcParams for `matplotlib.rc_context`.
STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "hatch.linewidth": 0.6,
    "legend.frameon": False,
}


def line_style(number: int) -> dict[str, Any]:
    """Return colour, dashes and mark of the line of this number; no two of 24 are the same."""
    return {
        "color": COLOURS[number % len(COLOURS)],
        "ls": DASHES[number % len(DASHES)],
        "marker": MARKS[number % len(MARKS)],
    }
