"""End of every command: exit codes, and errors as one line."""

import sys
from collections.abc import Callable

import typer

from canwall.cli.output import say
from canwall.errors import InputError, RunFailedError, one_line

#: Exit codes: a run that failed or tripped, bad input, Ctrl-C with the drive disabled.
FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130


class StoppedError(Exception):
    """Ctrl-C in a command that has a message about it."""


def guarded(command: Callable[[], object]) -> int:
    """Run a command and return its exit code; errors become one line each, a traceback is a bug."""
    try:
        result = command()
    except StoppedError as interrupted:
        say(str(interrupted))
        return INTERRUPTED
    except (KeyboardInterrupt, typer.Abort):
        return INTERRUPTED
    except typer.TyperException as error:
        if text := error.format_message():  # empty if the help was shown instead
            say(one_line(text))
        return BAD_INPUT
    except InputError as error:
        say(str(error))
        return BAD_INPUT
    except Exception as error:
        if not isinstance(error, RunFailedError) and not _is_bus_error(error):
            raise
        say(str(error))
        return FAILED
    return result if isinstance(result, int) else 0


def _is_bus_error(error: Exception) -> bool:
    """Return True for an error of python-can, without importing it: that takes long."""
    can = sys.modules.get("can")
    return can is not None and isinstance(error, can.CanError)
