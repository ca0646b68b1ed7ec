"""Figures that notebooks display as they are."""

import io
import sys

from matplotlib.figure import Figure


def shown_in_notebooks(figure: Figure) -> Figure:
    """Return the figure; have IPython, if it is there, display figures without pyplot as well.

    Pyplot's own display, once it is in use, goes on as it is configured.
    """
    ipython = sys.modules.get("IPython")
    shell = ipython and ipython.get_ipython()
    if shell:
        formatter = shell.display_formatter.formatters["image/png"]
        if Figure not in formatter.type_printers:
            formatter.for_type(Figure, _png)
    return figure


def _png(figure: Figure) -> bytes:
    picture = io.BytesIO()
    figure.savefig(picture, format="png")
    return picture.getvalue()
