"""The table of K-limits: every law with every operator, through the bus.

`python -m canwall.sweep.table`, or `scripts/k-limits`: Markdown to standard output, progress to
standard error.
"""

import os
import sys
from concurrent.futures import ProcessPoolExecutor, as_completed

from rich.console import Console
from rich.progress import Progress

from canwall import config
from canwall.config import Settings, Wall
from canwall.sweep.limit import Limit, k_limit, worst_strike
from canwall.sweep.strike import OPERATORS, Operator
from canwall.walls import DEADBEAT, LAWS

#: B·T/m of the laws with a damper: the best that any spring-damper wall can have with one period
#: of delay and no damping but its own (theory, section 6).
DAMPING = 0.43
_DAMPED = ("damped", "thresholded_damper", "unidirectional_damper", "offset_damper")
#: The stiffness at which energies of all laws are compared: K·T²/m.
COMPARED_AT = 0.6


def wall_of(base: Settings, name: str, operator: Operator) -> Wall:
    """The wall of a law by its registered name, its damper scaled to what moves."""
    assert base.simulation is not None
    mass = base.simulation.inertia_kg_m2 + operator.inertia_kg_m2
    damping = DAMPING * mass / base.bus.cycle_s if name in _DAMPED else 0.0
    return base.wall.model_copy(
        update={
            "law": name.removesuffix(DEADBEAT),
            "deadbeat": name.endswith(DEADBEAT),
            "damping_nm_s_per_rad": damping,
        }
    )


def limit_of(base: Settings, name: str, operator: Operator) -> tuple[Limit, float, bool]:
    """K-limit of a law; and at COMPARED_AT: energy out in tolerances, and whether it chatters."""
    wall = wall_of(base, name, operator)
    limit = k_limit(base, operator, wall)
    assert base.simulation is not None
    mass = base.simulation.inertia_kg_m2 + operator.inertia_kg_m2
    stiffness = COMPARED_AT * mass / base.bus.cycle_s**2
    verdicts = worst_strike(
        base, operator, wall.model_copy(update={"stiffness_nm_per_rad": stiffness})
    )
    energy = max(v.energy_out_max / v.energy_tolerance for v in verdicts)
    return limit, energy, verdicts[-1].chatters


def main() -> None:
    """Compute and print; arguments: names of laws (default: all that have a stiffness)."""
    base = config.load(config.shipped("config/sim.toml"))
    names = sys.argv[1:] or [name for name in LAWS if name != "rigid"]
    found: dict[tuple[str, str], tuple[Limit, float, bool]] = {}
    with (
        Progress(console=Console(stderr=True)) as progress,
        ProcessPoolExecutor(os.cpu_count()) as pool,
    ):
        task = progress.add_task("K-limits", total=len(names) * len(OPERATORS))
        jobs = {
            pool.submit(limit_of, base, name, operator): (name, operator.name)
            for name in names
            for operator in OPERATORS.values()
        }
        for job in as_completed(jobs):
            found[jobs[job]] = job.result()
            progress.advance(task)
    print("| law | " + " | ".join(OPERATORS) + " |")
    print("|---|" + "---|" * len(OPERATORS))
    for name in names:
        cells = (_cell(*found[name, operator]) for operator in OPERATORS)
        print(f"| {name} | " + " | ".join(cells) + " |")
    print()
    for name in names:
        for operator in OPERATORS:
            limit = found[name, operator][0]
            print(f"{name}, {operator}: {limit.beyond}", file=sys.stderr)


def _cell(limit: Limit, energy: float, chatters: bool) -> str:
    """K; K·T²/m; energy out at the limit; energy out at COMPARED_AT, unless it chatters there."""
    there = "chatters" if chatters else f"{energy:.1f}"
    return (
        f"{limit.stiffness:.3g}; **{limit.normalised:.3g}**; "
        f"{limit.energy_out_max * 1e6:.3g} µJ ({limit.energy_in_tolerances:.1f}); {there}"
    )


if __name__ == "__main__":
    main()
