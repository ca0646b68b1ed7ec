"""Computation of the tables of walls, written into the documentation between their markers.

In a page a table stands between `<!-- table NAME -->` and `<!-- end of table -->`. The results are
kept as NetCDF files in a folder; those that are there already are not computed again.
"""

import argparse
import sys
from pathlib import Path

from canwall.cli.output import ProgressDisplay
from canwall.config import load
from canwall.sweep import (
    LAW_TABLES,
    compute_law_table,
    format_law_table,
    format_worst,
    read_sweep,
    write_sweep,
)

ROOT = Path(__file__).parents[1]
CONFIG = ROOT / "config" / "sim.toml"
PAGES = (ROOT / "README.md", ROOT / "docs" / "results.md")
#: Laws of the short table in README.md.
SHORT = ("standard", "damped", "half_sample", "mean_force", "push_only")
END = "<!-- end of table -->"


def filled(page: str, name: str, table: str) -> str:
    """Return the page with the table between its markers, unchanged if it has none."""
    before, marker, rest = page.partition(f"<!-- table {name} -->")
    if not marker:
        return page
    _, end, after = rest.partition(END)
    if not end:
        raise ValueError(f"table {name}: {END} is missing")
    return f"{before}{marker}\n\n{table}\n\n{end}{after}"


def main() -> None:
    """Compute the tables that are asked for and fill the pages."""
    parser = argparse.ArgumentParser(prog="scripts/tables", description=__doc__)
    parser.add_argument("tables", nargs="*", metavar="NAME", help=", ".join(LAW_TABLES))
    parser.add_argument(
        "--results", type=Path, default=ROOT / "build" / "tables", help="folder of the results"
    )
    given = parser.parse_args()
    settings = load(CONFIG)
    given.results.mkdir(parents=True, exist_ok=True)
    for name in given.tables or LAW_TABLES:
        file = given.results / f"{name}.nc"
        if file.exists():
            dataset = read_sweep(file)
        else:
            with ProgressDisplay() as display:
                dataset = compute_law_table(
                    name,
                    settings,
                    progress=lambda done, total, what=name: display.count(what, done, total),  # type: ignore[misc]
                )
            write_sweep(dataset, file)
        texts = {name: format_law_table(dataset)}
        if name == "laws":
            texts["short"] = format_worst(dataset.sel(law=list(SHORT)))
        for page in PAGES:
            text = page.read_text(encoding="utf-8")
            for which, table in texts.items():
                text = filled(text, which, table)
            page.write_text(text, encoding="utf-8")
        print(file, file=sys.stderr)


if __name__ == "__main__":
    main()
