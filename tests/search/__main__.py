"""`scripts/search [NAME ...] [--seed N] [--share X]`: the search for what breaks a promise.

The tests of this folder do a bounded part of the same. The figures of the last search go into
docs/promises.json, from which the page about the promises is made.
"""

import argparse
import datetime
import json
import platform
import random
import sys
import time
from pathlib import Path
from typing import Any

import other_tests  # noqa: F401
from fuzzing import FoundError
from parts import PARTS

from canwall.cli.output import ProgressDisplay

FIGURES = Path(__file__).parents[2] / "docs" / "promises.json"


def main() -> int:
    """Search; return 1 if anything was found."""
    parser = argparse.ArgumentParser(prog="search", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(PARTS))
    parser.add_argument("--seed", type=int, default=random.SystemRandom().getrandbits(31))
    parser.add_argument("--share", type=float, default=1.0, help="part of the full effort")
    parser.add_argument("--figures", type=Path, default=FIGURES, help="file that keeps them")
    given = parser.parse_args()
    if unknown := [name for name in given.names if name not in PARTS]:
        parser.error(f"no part {unknown[0]!r}; there are {', '.join(PARTS)}")
    print(f"search: seed {given.seed}", file=sys.stderr)
    results: dict[str, Any] = {}
    found = False
    for name in given.names or PARTS:
        part = PARTS[name]
        effort = max(1, round(part.effort * given.share))
        begin = time.monotonic()
        with ProgressDisplay() as display:

            def tell(done: int, name: str = name, effort: int = effort) -> None:
                display.count(name, done, effort)

            tell(0)
            try:
                figures = part.search(given.seed, effort, tell)
            except AssertionError as error:
                found = True
                text = str(error) if isinstance(error, FoundError) else repr(error)
                results[name] = {"seed": given.seed, "found": text}
                print(f"search: {name}: found: {text}", file=sys.stderr)
                continue
        results[name] = {
            "promise": part.promise,
            "seed": given.seed,
            "effort": effort,
            "took_s": round(time.monotonic() - begin),
            "date": datetime.date.today().isoformat(),
            "machine": platform.machine(),
            "python": platform.python_version(),
            "figures": figures,
        }
        _keep(given.figures, name, results[name])
    print(json.dumps(results, indent=2))
    return int(found)


def _keep(file: Path, name: str, result: dict[str, Any]) -> None:
    """Write the figures of a part to the file that has the last ones."""
    known = json.loads(file.read_text()) if file.exists() else {}
    known[name] = result
    file.write_text(json.dumps({n: known[n] for n in PARTS if n in known}, indent=2) + "\n")


if __name__ == "__main__":
    sys.exit(main())
