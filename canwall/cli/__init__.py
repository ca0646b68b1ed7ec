"""Command line: parses options, makes one call, prints tables and error lines.

There is a module for each group of commands; `options`, `output`, `ending` and `program` have what
they share.
"""

import os
from typing import NoReturn

# Read when numpy is loaded. For matrices as small as these threads of BLAS gain nothing, and they
# spin on the processors that the loop, its writer and the drive need.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from canwall.cli import beginning, bench, export, identify, panel, run, study, sweep, workbench
from canwall.cli.ending import guarded
from canwall.cli.program import add_version, make_program, run_program
from canwall.stopping import INTERRUPTED

__all__ = ["INTERRUPTED", "app", "guarded", "main", "make_program", "run_program"]

app = make_program(
    no_args_is_help=True, help="A stiff virtual wall without chatter on a CANopen servo drive."
)
add_version(app)
for command in (
    run.run,
    run.change,
    run.drive,
    beginning.scan,
    beginning.init,
    beginning.config,
    bench.doctor,
    bench.latency,
    bench.dbc,
    identify.identify,
    sweep.sweep,
    sweep.plot,
    export.export,
    panel.panel,
    workbench.ball,
    workbench.figures,
):
    app.command()(command)
app.add_typer(study.study, name="study")


def main() -> NoReturn:
    """Run the command `canwall` and exit with its exit code."""
    run_program(app)
