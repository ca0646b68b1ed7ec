"""Equations as SVG, drawn while the site is built: no script and no font at the reader's side."""

import re
import xml.etree.ElementTree as ET
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import ziamath
from docutils import nodes
from sphinx.util import logging

if TYPE_CHECKING:
    from sphinx.application import Sphinx
    from sphinx.writers.html5 import HTML5Translator

#: Size of the letters and of the text around them, of which lengths are given in em.
_LETTERS_PX, _TEXT_PX = 18.0, 16.0
_logger = logging.getLogger(__name__)

# Shapes are written where they are used: several equations on a page would share their names.
ziamath.config.svg2 = False


@cache
def _drawn(latex: str, inline: bool) -> str:
    """The <svg> of an equation, in the colour of the text around it and as large."""
    # The renderer takes a minus after a relation for a difference, and spaces it so.
    signed = re.sub(r"(=|<|>|\\le|\\ge)\s*-", r"\1 {-}", latex)
    equation = ziamath.Latex(signed, size=_LETTERS_PX, color="currentColor", inline=inline)
    svg = equation.svgxml()
    for side in ("width", "height"):
        svg.set(side, f"{float(svg.get(side, '0')) / _TEXT_PX:.4f}em")
    if inline:
        below = equation.getyofst() - equation.margin
        svg.set("style", f"vertical-align: {below / _TEXT_PX:.4f}em")
    svg.set("role", "img")
    svg.set("aria-label", latex)
    return ET.tostring(svg, encoding="unicode")


def _visit(translator: "HTML5Translator", node: nodes.Element, inline: bool) -> None:
    latex = node.astext().strip()
    try:
        svg = _drawn(latex, inline)
    except Exception as error:  # whatever the renderer makes of what it cannot draw
        _logger.warning("equation %s: %r", latex, error, location=node)
        raise nodes.SkipNode from None
    tag, after = ("span", "") if inline else ("div", "\n")
    start = translator.starttag(node, tag, "", CLASS="equation")
    translator.body.append(f"{start}{svg}</{tag}>{after}")
    raise nodes.SkipNode


def setup(app: "Sphinx") -> dict[str, Any]:
    """Register the renderer `svg` for `html_math_renderer`."""
    app.add_html_math_renderer(
        "svg",
        inline_renderers=(partial(_visit, inline=True), None),
        block_renderers=(partial(_visit, inline=False), None),
    )
    return {"parallel_read_safe": True, "parallel_write_safe": True}
