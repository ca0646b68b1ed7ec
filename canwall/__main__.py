"""Start of the command `canwall`, as a script and as `python -m canwall`.

Nothing that takes long is imported before Ctrl-C has its words.
"""

import contextlib
import os
import signal
import sys
from typing import NoReturn

_INTERRUPTED = 130


def main() -> NoReturn:
    """Import the command line and run it."""
    # Who starts it with the signal ignored (nohup, &) has it stay so.
    attends = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if attends:
        # As no exception: an import may swallow that, or make another one of it.
        signal.signal(signal.SIGINT, lambda number, frame: _interrupted())
    from canwall import cli

    if attends:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        cli.main()
    except KeyboardInterrupt:  # before there is a command, or after it
        _interrupted()
    except SystemExit as end:
        if end.code == _INTERRUPTED:
            _end()
        raise


def _interrupted() -> NoReturn:
    with contextlib.suppress(OSError):
        os.write(2, b"canwall: interrupted\n")
    _end()


def _end() -> NoReturn:
    """End with the exit code of Ctrl-C.

    Python itself would end by the signal, without a code, if it came during the exec of a text, as
    dataclasses have them.
    """
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, OSError, ValueError):  # closed, or none
            stream.flush()
    os._exit(_INTERRUPTED)


if __name__ == "__main__":
    main()
