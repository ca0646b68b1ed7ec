"""The commands, thin: options in, one call, tables and error lines out.

A module for each group of commands; what they share is in `options`, `output` and `ending`.
"""

import sys
from typing import NoReturn

import typer

from canwall.cli import bench, run, sweep, workbench
from canwall.cli.ending import INTERRUPTED, guarded

__all__ = ["INTERRUPTED", "app", "guarded", "main"]

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",  # in rich markup the units [m] would be tags
    help="A stiff virtual wall without chatter on a CANopen servo drive.",
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
    sys.exit(guarded(lambda: app(standalone_mode=False)))
