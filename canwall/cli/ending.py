"""End of every command: exit codes, and errors as one line."""

import sys
from collections.abc import Callable, Iterable, Sequence

import typer

from canwall.cli.output import console, say
from canwall.errors import InputError, RunFailedError, did_you_mean, one_line
from canwall.stopping import INTERRUPTED

#: Exit codes beside INTERRUPTED: a run that failed or tripped, bad input.
FAILED, BAD_INPUT = 1, 2


class StoppedError(Exception):
    """Ctrl-C in a command that has a message about it."""


def guarded(command: Callable[[], object]) -> int:
    """Run a command and return its exit code; errors become one line each, a traceback is a bug."""
    try:
        result = command()
    except (Exception, KeyboardInterrupt) as error:
        code = _tell(error)
        # Notes say what could not be put in order after it.
        return failed_if(getattr(error, "__notes__", ())) or code
    return (result if isinstance(result, int) else 0) or (FAILED if console.has_lost else 0)


def failed_if(troubles: Iterable[str]) -> int:
    """Print a line for each trouble; return the exit code that they make, 0 without any."""
    code = 0
    for trouble in troubles:
        say(trouble)
        code = FAILED
    return code


def _tell(error: BaseException) -> int:
    """Print an error as a line; return its exit code. Raises it again if it is a bug."""
    if isinstance(error, (KeyboardInterrupt, typer.Abort)):
        say("interrupted")
        return INTERRUPTED
    if isinstance(error, StoppedError):
        say(str(error))
        return INTERRUPTED
    if isinstance(error, typer.TyperException):
        if text := _usage_text(error):  # empty if the help was shown instead
            say(one_line(text))
        return BAD_INPUT
    if isinstance(error, InputError):
        say(str(error))
        return BAD_INPUT
    if isinstance(error, RunFailedError) or _is_bus_error(error):
        say(str(error))
        return FAILED
    raise error


def _usage_text(error: typer.TyperException) -> str:
    """Return what is wrong with the words of a command line."""
    # An option that does not exist; typer's list of possible ones is replaced.
    given: str | None = getattr(error, "option_name", None)
    possible: Sequence[str] | None = getattr(error, "possibilities", None)
    if given and possible:
        return error.message + did_you_mean(given, possible)
    return error.format_message()


def _is_bus_error(error: BaseException) -> bool:
    """Return True for an error of python-can, without importing it: that takes long."""
    can = sys.modules.get("can")
    return can is not None and isinstance(error, can.CanError)
