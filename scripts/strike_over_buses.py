"""Strikes of all operators on one wall over a bus, the drive in a process of its own.

Without a bus the drive is in the loop's own process, in simulated time; on a bus it is a process of
its own, in simulated or measured time. The results are kept as JSON in a folder, a file for each
bus; `--page` writes those that are there into a page of the documentation, between
`<!-- table buses -->` and `<!-- end of table -->`.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from fill_tables import filled

from canwall.config import Settings, load, with_overrides
from canwall.sweep import OPERATORS, Operator

ROOT = Path(__file__).parents[1]
CONFIG = ROOT / "config" / "sim.toml"
#: What is struck: stiffness that is asked for [N·m/rad], number of strikes, and the distance from
#: which the hand approaches [rad], within so long [s], with which torque [N·m].
STIFFNESS, STRIKES, START, APPROACH_S, PRESS_NM = 2000.0, 8, 0.08, 0.1, 0.15
#: Start of the first strike [s]; in measured time it counts from the drive's start, and the master
#: has to be there before it: nothing else would hold a handle that nobody holds.
FIRST_S, FIRST_MEASURED_S = 0.2, 6.0
#: From one strike to the next [s], no multiple of a period: each meets the wall at another phase.
INTERVAL_S = 1.10037
#: Columns of the table.
HEADER = (
    "bus; time of the drive",
    "operator",
    "chatter",
    "largest felt ripple [N]",
    "contacts of a strike, most",
    "first depth ÷ referent: median, most",
    "mass found ÷ true",
    "lost TPDOs",
    "SYNC off by, p99 [µs]",
)


def struck(operator: Operator, bus: dict[str, Any], first_s: float) -> Settings:
    """Return the configuration with which an operator strikes."""
    spring = operator.stiffness_nm_per_rad
    depth = PRESS_NM / spring if spring else 0.0
    hand = {
        "strikes": STRIKES,
        "first_strike_s": first_s,
        "interval_s": INTERVAL_S,
        "rest_rad": START,
        "press_rad": -depth,
        "press_torque_nm": 0.0 if spring else -PRESS_NM,
        "approach_s": APPROACH_S * (1.0 + depth / START),
        "press_s": 0.5,
        "withdraw_s": 0.1,
    }
    keys: dict[str, Any] = {f"simulation.hand.{key}": value for key, value in hand.items()}
    wall = {
        "wall.stiffness_nm_per_rad": STIFFNESS,
        "run.duration_s": first_s + STRIKES * INTERVAL_S,
    }
    settings = with_overrides(load(CONFIG), {**operator.keys, **keys, **wall, **bus})
    return settings.model_copy(update={"schedule": ()})


def run(settings: Settings, real_time: bool) -> dict[str, Any]:
    """Run a configuration, with its drive in a process of its own if there is a bus."""
    with tempfile.TemporaryDirectory() as place:
        config, record = Path(place) / "strike.toml", Path(place) / "run"
        config.write_text(settings.to_toml(), encoding="utf-8")
        canwall = [sys.executable, "-m", "canwall"]
        drive = None
        if settings.bus.interface != "virtual":
            ready, ready_fd = os.pipe()
            command = [*canwall, "drive", str(config), "--ready-fd", str(ready_fd)]
            command += ["--real-time"] if real_time else []
            drive = subprocess.Popen(command, pass_fds=[ready_fd])
            os.close(ready_fd)
            os.read(ready, 1)
            os.close(ready)
        try:
            command = [*canwall, "run", str(config), "--output", str(record), "--json"]
            subprocess.run(command, check=False, stdout=subprocess.DEVNULL)
        finally:
            if drive:
                drive.terminate()
                drive.wait()
        return dict(json.loads((record / "summary.json").read_text(encoding="utf-8")))


def row(operator: Operator, summary: dict[str, Any], depth: float, inertia: float) -> list[str]:
    """Return what the table says of a run; depth: that of the referent's first strikes [rad]."""
    strikes, lost = summary["strikes"], str(summary["missed_tpdo"])
    if not strikes:
        return [operator.name, "no strike", *4 * ["–"], lost, "–"]
    mass = inertia + operator.inertia_kg_m2
    depths = sorted(strike["first_depth_rad"] / depth for strike in strikes)
    masses = sorted(strike["mass_est_kg_m2"] / mass for strike in strikes)
    # Without a referent every bounce counts, those of the continuous wall as well.
    chatter = f"{sum(strike['chatter'] for strike in strikes)} of {len(strikes)}"
    off = summary["timing"].get("sync_error")
    return [
        operator.name,
        f"– of {len(strikes)}" if measured(summary) else chatter,
        f"{max(strike['felt_ripple_n'] or 0.0 for strike in strikes):.2f}",
        str(max(strike["contacts"] for strike in strikes)),
        f"{depths[len(depths) // 2]:.2f}, {depths[-1]:.2f}",
        f"{masses[0]:.2f} to {masses[-1]:.2f}",
        lost,
        f"{off['p99_us']:.0f}" if off and measured(summary) else "–",
    ]


def measured(summary: dict[str, Any]) -> bool:
    """Return True for a run in measured time."""
    return bool(summary["timing"]["scheduling"] != "simulated time")


def main() -> None:
    """Strike over one bus, or write the page."""
    parser = argparse.ArgumentParser(prog="scripts/buses", description=__doc__)
    parser.add_argument("bus", nargs="?", choices=("memory", "unixcan", "vcan0"))
    parser.add_argument("--real-time", action="store_true", help="measured time")
    parser.add_argument(
        "--results", type=Path, default=ROOT / "build" / "buses", help="folder of the results"
    )
    parser.add_argument("--page", type=Path, help="page to write the table into")
    given = parser.parse_args()
    given.results.mkdir(parents=True, exist_ok=True)
    if given.bus:
        with tempfile.TemporaryDirectory() as place:
            strike_over(given.bus, given.real_time, given.results, Path(place) / "bus.sock")
    if given.page:
        files = sorted(given.results.glob("*.json"))
        lines = [HEADER, ("---",) * len(HEADER)]
        lines += [line for file in files for line in json.loads(file.read_text(encoding="utf-8"))]
        table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
        page = given.page.read_text(encoding="utf-8")
        given.page.write_text(filled(page, "buses", table), encoding="utf-8")


def strike_over(name: str, real_time: bool, results: Path, socket: Path) -> None:
    """Let every operator strike over a bus, and keep what is found."""
    bus: dict[str, Any] = {}
    if name == "unixcan":
        bus = {"bus.interface": "unixcan", "bus.channel": str(socket)}
    elif name == "vcan0":
        bus = {"bus.interface": "socketcan", "bus.channel": "vcan0"}
    if bus:
        bus["bus.pace"] = "real_time" if real_time else "simulated"
    title = f"{name}; {'measured' if real_time else 'simulated'}"
    rows = []
    for operator in OPERATORS.values():
        settings = struck(operator, bus, FIRST_MEASURED_S if real_time else FIRST_S)
        assert settings.simulation is not None
        summary = run(settings, real_time)
        # In measured time the hand's begin is not known, and with it the referent's phase.
        alike = run(struck(operator, {}, FIRST_S), False) if real_time else summary
        depth = max(strike["referent_first_depth_rad"] for strike in alike["strikes"])
        inertia = settings.simulation.inertia_kg_m2
        rows.append([title, *row(operator, summary, depth, inertia)])
        print(" | ".join(rows[-1]), file=sys.stderr, flush=True)
    kept = results / f"{name}-{'measured' if real_time else 'simulated'}.json"
    kept.write_text(json.dumps(rows, ensure_ascii=False), encoding="utf-8")


if __name__ == "__main__":
    main()
