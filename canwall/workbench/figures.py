"""The figures of the source, drawn anew: each a picture beside its data, and an index of them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl

from canwall.figure_style import STYLE
from canwall.workbench import comparison, designs, energy_sources
from canwall.workbench.figure_page import FigurePage, writing
from canwall.workbench.on_the_drive import four_strikes
from canwall.workbench.traces import BALL

INDEX = "index.md"


@dataclass(frozen=True)
class Extent:
    """How far the figures go that average over many balls.

    long_s: time of Figure 5.12 [s]; drops: heights of drop that tell how typical it is; phases:
    instants of a period at which balls enter; thetas: floors in the comparison of all laws.
    """

    long_s: float = 900.0
    drops: int = 101
    phases: int = 64
    thetas: int = 48


#: What draws which figures, in the order of the source.
_FIGURES: tuple[tuple[str, Callable[[Extent], Iterator[FigurePage]]], ...] = (
    ("Figure 5.3", lambda extent: energy_sources.tracing_out()),
    ("Figure 5.4", lambda extent: energy_sources.time_chart(extent.phases)),
    ("Figures 5.8 and 5.9", lambda extent: designs.sampled_data()),
    ("Figures 5.10 and 5.11", lambda extent: designs.half_sample()),
    ("Figure 5.12", lambda extent: designs.long_term(extent.long_s, extent.drops)),
    ("Figure 5.14", lambda extent: designs.digital_design()),
    ("Figures 5.16 and 5.17", lambda extent: designs.with_deadbeat()),
    ("Figures 5.18 and 5.19", lambda extent: four_strikes()),
    ("all laws", lambda extent: comparison.all_laws(extent.thetas, extent.phases)),
)

_PREFACE = f"""# Figures

The figures of the chapter *Passive Rendering of the Virtual Wall*, drawn anew by
`canwall figures`, and one page that compares all laws. Up to Figure 5.17 a ball of
{BALL.mass:g} kg falls from {BALL.height:g} m under {BALL.gravity:g} m/s²
onto a floor of K = {BALL.stiffness:g} N/m, sampled every {BALL.period:g} s
(θ = T·√(K/m) = {BALL.theta:g}). A force f > 0 pushes out of the wall; drawn as −f/K it
lies on the position for which a continuous wall would give it.
"""


def write_figures(
    output: Path,
    extent: Extent = Extent(),
    progress: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> Path:
    """Every figure as PNG and CSV into `output`, and the index, whose path is returned.

    progress is told what is drawn next, how many steps are done, and of how many. Raises
    InputError where the folder cannot be written, RunFailedError where the run on the simulated
    drive fails.
    """
    with writing(output):
        output.mkdir(parents=True, exist_ok=True)
    texts = [_PREFACE]
    for done, (name, draw) in enumerate(_FIGURES):
        progress(name, done, len(_FIGURES))
        with mpl.rc_context(STYLE):
            for sheet in draw(extent):
                sheet.write(output)
                texts.append(sheet.text())
    progress("written", len(_FIGURES), len(_FIGURES))
    with writing(output):
        (output / INDEX).write_text("\n".join(texts), encoding="utf-8")
    return output / INDEX
