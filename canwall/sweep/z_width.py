"""Z-width map: walls on which no strike chatters, with the analytic limits (docs/results.md)."""

from typing import Any

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from canwall.figure_style import CHATTER_AREA, COLOURS, QUIET_AREA
from canwall.sweep.axes import DAMPING, STIFFNESS, STRIKES
from canwall.sweep.labels import LABELS, axis_name, label_logarithmic
from canwall.sweep.limit_lines import Limit, limit_lines

_STYLES: dict[Limit, dict[str, Any]] = {
    Limit.DELAYED: {"color": COLOURS[0], "ls": "-"},
    Limit.EXACT: {"color": "#000000", "ls": "--"},
    Limit.CEILING: {"color": "#000000", "ls": "none", "marker": "*"},
    Limit.PASSIVE: {"color": COLOURS[2], "ls": "-."},
    Limit.QUANTISED: {"color": "#000000", "ls": "none", "marker": "^"},
}


def draw_z_width(axes: Axes, dataset: xr.Dataset) -> None:
    """Draw the map of one condition, K against B, with the limits of a spring-damper wall."""
    stiffness, damping = (axis_name(dataset, pair) for pair in (STIFFNESS, DAMPING))
    chatters = dataset["chatters"].any(STRIKES).transpose(damping, stiffness).values
    axes.pcolormesh(
        dataset[stiffness].values,
        dataset[damping].values,
        np.where(chatters, 1.0, 0.0),
        cmap=mpl.colors.ListedColormap([QUIET_AREA, CHATTER_AREA]),
        vmin=0.0,
        vmax=1.0,
        shading="nearest",
    )
    axes.canwall_patches = (  # type: ignore[attr-defined]
        Patch(color=QUIET_AREA, label="no strike chatters"),
        Patch(color=CHATTER_AREA, label="chatters"),
    )
    for line in limit_lines(dataset):
        axes.add_line(
            Line2D(
                line.stiffness,
                line.damping,
                ms=7,
                # Do not cut off a point on the edge.
                clip_on=len(line.stiffness) > 1,
                zorder=3,
                label=str(line.limit),
                **_STYLES[line.limit],
            )
        )
    axes.set_xscale("log")
    axes.set_xlim(*dataset[stiffness].values[[0, -1]])
    label_logarithmic(axes.xaxis)
    axes.set_ylim(*dataset[damping].values[[0, -1]])
    axes.set_xlabel(LABELS[stiffness])
    axes.set_ylabel(LABELS[damping])
