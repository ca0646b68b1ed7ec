"""Command line: parses options, makes one call, prints tables and error lines.

There is a module for each group of commands; `options`, `output`, `ending` and `program` have what
they share.
"""

from typing import NoReturn

from canwall.cli import bench, identify, run, study, sweep, workbench
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
    identify.identify,
    sweep.sweep,
    sweep.plot,
    workbench.ball,
    workbench.figures,
):
    app.command()(command)
app.add_typer(study.study, name="study")


def main() -> NoReturn:
    """Run the command `canwall` and exit with its exit code."""
    run_program(app)
