"""Construction and execution of a program of commands: `canwall`, or one of its groups."""

import gc
import os
import sys
import threading
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperGroup

from canwall.cli.ending import StoppedError, guarded
from canwall.cli.output import say
from canwall.code_on_disk import is_first_start
from canwall.stopping import end_at_once
from canwall.supervised import given_up


class _Commands(TyperGroup):
    """Commands in which Ctrl-C has words; typer would only make an exit code of it."""

    def make_context(self, *arguments: Any, **options: Any) -> Any:
        """Read the words of the command line."""
        try:
            return super().make_context(*arguments, **options)
        except KeyboardInterrupt as error:
            raise _stopped(error) from error

    def invoke(self, context: Any) -> Any:
        """Call the command."""
        try:
            return super().invoke(context)
        except KeyboardInterrupt as error:
            raise _stopped(error) from error


def _stopped(error: KeyboardInterrupt) -> StoppedError:
    stopped = StoppedError("interrupted")
    for note in getattr(error, "__notes__", ()):
        stopped.add_note(note)
    return stopped


def make_program(**settings: Any) -> typer.Typer:
    """Make a program without commands; settings are those of `typer.Typer`."""
    return typer.Typer(
        cls=_Commands,
        context_settings={"help_option_names": ["-h", "--help"]},
        pretty_exceptions_enable=False,
        rich_markup_mode="markdown",  # in rich markup the units [m] would be tags
        **settings,
    )


def add_version(program: typer.Typer) -> None:
    """Give a program the option --version."""

    @program.callback()
    def _options(
        version: Annotated[
            bool,
            typer.Option(
                "--version",
                callback=_tell_version,
                is_eager=True,
                help="Show the version and exit.",
            ),
        ] = False,
    ) -> None:
        pass


def _tell_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"canwall {version('canwall')}")
        raise typer.Exit


def run_program(program: typer.Typer) -> NoReturn:
    """Run the program with the arguments of the process and exit with its exit code."""
    _occupy_standard_streams()
    if is_first_start():
        from canwall.compiled import announce_compiling

        announce_compiling(
            lambda: say(
                "compiling for this machine, about half a minute; later starts have it on disk"
            )
        )
    code = guarded(lambda: program(standalone_mode=False))
    # At its end Python looks for garbage among all that was ever imported, for longer than a
    # command may take; all of it goes with the process.
    gc.freeze()
    if any(map(threading.Thread.is_alive, given_up)):
        # A thread still computes with memory that Python would free.
        end_at_once(code)
    sys.exit(code)


def _occupy_standard_streams() -> None:
    """Put /dev/null in place of the standard streams with which the process was not started.

    A socket or a file that took such a number would get what is printed, and a process that is
    started with pipes in these places would lose it.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
