"""One run from configuration to folder: the rooms put together, and nothing else.

`buses` opens what a run is on, `assembly` builds axes and exchange, `running` is the run, `result`
what it came to, `stopping` the signals that end it.
"""

from canwall.run.assembly import (
    drive_dictionary,
    make_axis,
    make_exchange,
    make_monitor,
    render,
    restored,
    scheduled,
)
from canwall.run.buses import make_simulated_drive, on_the_bus, open_bus, serve_drive
from canwall.run.result import RunResult
from canwall.run.running import run, run_together
from canwall.run.stopping import StopRequest, stop_on_signals

__all__ = [
    "RunResult",
    "StopRequest",
    "drive_dictionary",
    "make_axis",
    "make_exchange",
    "make_monitor",
    "make_simulated_drive",
    "on_the_bus",
    "open_bus",
    "render",
    "restored",
    "run",
    "run_together",
    "scheduled",
    "serve_drive",
    "stop_on_signals",
]
