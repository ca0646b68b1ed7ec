"""`scripts/bench [NAME ...]`: benchmarks, one function each, as one JSON object.

What is compared is measured within one run, in turns, and given as a ratio: the machine drops out
of it. Medians over repeats; the numbers of one machine say little about those of another.
"""

import json
import os
import platform
import sys
from collections.abc import Callable
from typing import Any, TypeAlias

from beside_the_panel import panel_beside
from on_the_ball import ball, law_steps, planning_steps
from on_the_bus import exchange, simulated_drive, whole_loop
from on_the_clock import several_drives, sync_jitter
from on_the_drive import endurance
from on_the_panel import panel_hour
from on_the_socket import full_cycles, round_trip, round_trip_on_vcan0, under_python
from on_the_sweep import closed_loop, safeguards, sweep_on_two_cores, unknown_hand
from ways_out import ways_out

Benchmark: TypeAlias = Callable[[], dict[str, Any]]

BENCHMARKS: dict[str, Benchmark] = {
    "whole_loop": whole_loop,
    "exchange": exchange,
    "simulated_drive": simulated_drive,
    "several_drives": several_drives,
    "sync_jitter": sync_jitter,
    "round_trip": round_trip,
    "full_cycles": full_cycles,
    "under_python": under_python,
    "law_steps": law_steps,
    "planning_steps": planning_steps,
    "ball": ball,
    "closed_loop": closed_loop,
    "safeguards": safeguards,
    "unknown_hand": unknown_hand,
    "sweep_on_two_cores": sweep_on_two_cores,
}
ON_REQUEST: dict[str, Benchmark] = {
    "endurance": endurance,
    "panel_beside": panel_beside,
    "panel_hour": panel_hour,
    "ways_out": ways_out,
    "round_trip_on_vcan0": round_trip_on_vcan0,
}
"""Long, or in need of SocketCAN or much memory, so they are run when they are named."""


def main() -> None:
    """Run the benchmarks that are named."""
    names = sys.argv[1:] or list(BENCHMARKS)
    known = BENCHMARKS | ON_REQUEST
    unknown = [name for name in names if name not in known]
    if unknown:
        print(
            f"bench: no benchmark {unknown[0]!r}; there are {', '.join(known)}",
            file=sys.stderr,
        )
        sys.exit(2)
    results: dict[str, Any] = {
        "python": platform.python_version(),
        "machine": platform.machine(),
        "processors": os.cpu_count(),
    }
    for name in names:
        print(f"bench: {name}", file=sys.stderr)
        results[name] = known[name]()
    print(json.dumps(results, indent=2))


if __name__ == "__main__":
    main()
