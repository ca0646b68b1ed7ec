"""A run from configuration to folder.

`buses` opens the bus, `assembly` builds axes and exchange, `running` executes the run, `result`
summarises it, `recorded` reads one back, `changes` accepts changes of the wall.
`closed_loop` simulates a run in memory, `referent` the continuous wall that it is compared with.
"""

from canwall.run.assembly import (
    drive_dictionary,
    make_axis,
    make_exchange,
    make_monitor,
    render,
    restoring_drives,
)
from canwall.run.buses import make_simulated_drive, on_the_bus, open_bus
from canwall.run.recorded import RunRecord, read_run
from canwall.run.result import RunResult
from canwall.run.running import check_together, run, run_together
from canwall.stopping import StopRequest, stop_on_signals

__all__ = [
    "RunRecord",
    "RunResult",
    "StopRequest",
    "check_together",
    "drive_dictionary",
    "make_axis",
    "make_exchange",
    "make_monitor",
    "make_simulated_drive",
    "on_the_bus",
    "open_bus",
    "read_run",
    "render",
    "restoring_drives",
    "run",
    "run_together",
    "stop_on_signals",
]
