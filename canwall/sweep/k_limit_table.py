"""The table of K-limits: every law with every operator, the model matched, or the drive's alone.

`python -m canwall.sweep.k_limit_table`: Markdown to standard output, progress to standard error.
"""

import sys

import numpy as np
import xarray as xr
from rich.console import Console
from rich.progress import Progress

from canwall import config
from canwall.config import Settings
from canwall.sweep.dataset import gathered
from canwall.sweep.plan import Plan, make_plan
from canwall.sweep.strike import OPERATORS
from canwall.sweep.workers import computed
from canwall.walls import LAWS

#: Laws with a damper: they get the damping, B·T/m, at which they are best.
DAMPED = ("damped", "thresholded_damper", "unidirectional_damper", "offset_damper")
DAMPINGS = tuple(round(0.05 * n, 2) for n in range(1, 21))
MODELS = {"matched": "the model matched", "drive": "a model that knows only the drive"}


def limits(base: Settings, laws: list[str], dampings: tuple[float, ...]) -> xr.Dataset:
    """K-limits of laws with every operator and both models, the best of the dampings."""
    plan = make_plan(
        base,
        {
            "law": laws,
            "operator": list(OPERATORS),
            "model": list(MODELS),
            "damping_normalised": list(dampings),
        },
    )
    dataset = gathered(plan, _shown(plan, ", ".join(laws[:1]) + " …"))
    best = dataset["worst_normalised"].argmax("damping_normalised")
    return dataset[["worst", "worst_normalised", "energy_out", "limit"]].isel(
        damping_normalised=best
    )


def _shown(plan: Plan, what: str) -> dict[int, np.ndarray[tuple[int, ...], np.dtype[np.void]]]:
    with Progress(console=Console(stderr=True)) as progress:
        return dict(
            progress.track(computed(plan, range(plan.pieces)), total=plan.pieces, description=what)
        )


def main() -> None:
    """Compute and print; arguments: names of laws (default: all that have a stiffness)."""
    base = config.load(config.shipped("config/sim.toml"))
    names = sys.argv[1:] or [name for name in LAWS if name != "rigid"]
    plain = [n for n in dict.fromkeys(["standard", *names]) if n not in DAMPED]
    damped = [n for n in dict.fromkeys(["damped", *names]) if n in DAMPED]
    found = xr.concat(
        [limits(base, plain, (0.0,)), limits(base, damped, DAMPINGS)], "law", join="outer"
    )
    for model, described in MODELS.items():
        print(f"\nWith {described}:\n")
        print("| law | " + " | ".join(OPERATORS) + " |")
        print("|---|" + "---|" * len(OPERATORS))
        for name in names:
            cells = (_cell(found.sel(model=model, operator=o), name) for o in OPERATORS)
            print(f"| {name} | " + " | ".join(cells) + " |")


def _cell(found: xr.Dataset, law: str) -> str:
    """K; K·T²/m (B·T/m where there is a damper); ratios to standard and to damped."""
    worst = found["worst"].sel(law=law).item()
    tuned = ""
    if law in DAMPED:
        tuned = f" at {found['damping_normalised'].sel(law=law).item():g}"
    normalised = found["worst_normalised"].sel(law=law).item()
    ratios = (_ratio(worst, found["worst"].sel(law=o).item()) for o in ("standard", "damped"))
    return f"{worst:.3g}; **{normalised:.3g}**{tuned}; {'; '.join(ratios)}"


def _ratio(one: float, other: float) -> str:
    return f"{one / other:.3g}×" if other > 0.0 else "—"


if __name__ == "__main__":
    main()
