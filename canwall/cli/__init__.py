"""The commands, thin: options in, one call, tables and error lines out.

A module for each group of commands; what they share is in `options`, `output`, `ending`, `program`.
"""

from typing import NoReturn

from canwall.cli import bench, run, sweep, workbench
from canwall.cli.ending import INTERRUPTED, guarded
from canwall.cli.program import make_program, run_program

__all__ = ["INTERRUPTED", "app", "guarded", "main", "make_program", "run_program"]

app = make_program(
    no_args_is_help=True, help="A stiff virtual wall without chatter on a CANopen servo drive."
)
for command in (
    run.run,
    run.change,
    run.drive,
    bench.doctor,
    bench.latency,
    sweep.sweep,
    sweep.plot,
    workbench.ball,
    workbench.figures,
):
    app.command()(command)


def main() -> NoReturn:
    """Entry point of the command `canwall`; ends the process with the exit code."""
    run_program(app)
