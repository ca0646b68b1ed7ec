"""Table of K-limits in Markdown: every law with every operator, for two models of the laws.

Each cell has K [N·m/rad], K·T²/m in bold (at the best B·T/m for a law with a damper), and the
ratios to the standard wall and to the best damped one.
"""

from collections.abc import Callable, Sequence

import xarray as xr

from canwall.config import Settings
from canwall.sweep.dataset import assemble_dataset
from canwall.sweep.plan import Plan, make_plan
from canwall.sweep.workers import compute_pieces
from canwall.walls import LAWS

#: Laws of the table unless others are asked for. A rigid stop has no stiffness to find a limit of.
TABLE_LAWS = tuple(name for name in LAWS if name != "rigid")
#: Laws with a damper: the table has them at the damping B·T/m with the largest K-limit.
DAMPED = ("damped", "thresholded_damper", "unidirectional_damper", "offset_damper")
DAMPINGS = tuple(round(0.05 * n, 2) for n in range(1, 21))
MODELS = {"matched": "the model matched", "drive": "a model that knows only the drive"}


def compute_k_limit_table(
    base: Settings,
    laws: Sequence[str],
    operators: Sequence[str],
    through: str = "sim",
    workers: int | None = None,
    dask: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> xr.Dataset:
    """Search the K-limits of the laws, with every operator and both models.

    Args:
        base: Configuration of the drive; the table has its own axes, `[sweep]` is ignored.
        laws: Names of the laws; "standard" and "damped" are added, for the ratios.
        operators: Names of OPERATORS.
        through: As for `make_plan`.
        workers: As for `sweep`.
        dask: As for `sweep`.
        progress: Called with the pieces of work done and their total.

    Returns:
        K-limits `worst` [N·m/rad] and `worst_normalised` (K·T²/m) over law, operator and model,
        with the coordinate `damping_normalised` (B·T/m) at which they are reached.

    Raises:
        InputError: For a law or an operator that does not exist.
    """
    base = base.model_copy(update={"sweep": {}})
    chosen = dict.fromkeys(["standard", "damped", *laws])
    undamped = [law for law in chosen if law not in DAMPED]
    damped = [law for law in chosen if law in DAMPED]
    plans = [
        _make_plan(base, undamped, operators, (0.0,), through),
        _make_plan(base, damped, operators, DAMPINGS, through),
    ]
    done, total = 0, sum(plan.pieces for plan in plans)
    tables = []
    for plan in plans:
        pieces = {}
        progress(done, total)
        for number, piece in compute_pieces(plan, range(plan.pieces), workers, dask):
            pieces[number] = piece
            done += 1
            progress(done, total)
        dataset = assemble_dataset(plan, pieces)[["worst", "worst_normalised"]]
        best = dataset["worst_normalised"].argmax("damping_normalised")
        tables.append(dataset.isel(damping_normalised=best))
    return xr.concat(tables, "law", join="outer")


def _make_plan(
    base: Settings,
    laws: Sequence[str],
    operators: Sequence[str],
    dampings: Sequence[float],
    through: str,
) -> Plan:
    axes = {
        "law": list(laws),
        "operator": list(operators),
        "model": list(MODELS),
        "damping_normalised": list(dampings),
    }
    return make_plan(base, axes, through)


def format_k_limit_table(table: xr.Dataset, laws: Sequence[str]) -> str:
    """Format the result of `compute_k_limit_table` as Markdown, with a row for each of the laws."""
    operators = [str(name) for name in table["operator"].values]
    lines = []
    for model, description in MODELS.items():
        lines += ["", f"With {description}:", ""]
        lines += ["| law | " + " | ".join(operators) + " |", "|---|" + "---|" * len(operators)]
        for law in laws:
            cells = (_format_cell(table.sel(model=model, operator=o), law) for o in operators)
            lines.append(f"| {law} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _format_cell(limits: xr.Dataset, law: str) -> str:
    worst = limits["worst"].sel(law=law).item()
    normalised = limits["worst_normalised"].sel(law=law).item()
    damping = ""
    if law in DAMPED:
        damping = f" at {limits['damping_normalised'].sel(law=law).item():g}"
    references = (limits["worst"].sel(law=name).item() for name in ("standard", "damped"))
    ratios = (f"{worst / other:.3g}×" if other > 0.0 else "—" for other in references)
    return f"{worst:.3g}; **{normalised:.3g}**{damping}; {'; '.join(ratios)}"
