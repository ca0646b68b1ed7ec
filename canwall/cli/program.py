"""A program of commands, `canwall` or a script's: how it shows its help, and how it is run."""

import gc
import sys
from typing import Any, NoReturn

import typer

from canwall.cli.ending import guarded


def make_program(**settings: Any) -> typer.Typer:
    """A program without commands yet; settings are `typer.Typer`'s."""
    return typer.Typer(
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode="markdown",  # in rich markup the units [m] would be tags
        **settings,
    )


def run_program(program: typer.Typer) -> NoReturn:
    """By the command line; ends the process with the exit code."""
    code = guarded(lambda: program(standalone_mode=False))
    # At its end Python looks for garbage among all that was ever imported, for longer than a
    # command may take; all of it goes with the process.
    gc.freeze()
    sys.exit(code)
