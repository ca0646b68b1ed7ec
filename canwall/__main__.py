"""Start of the command `canwall`, as a script and as `python -m canwall`.

Nothing that takes long is imported before Ctrl-C has its words.
"""

import contextlib
import os
import signal
from typing import NoReturn

from canwall.stopping import INTERRUPTED, end_at_once


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
        if end.code == INTERRUPTED:
            # Python itself would end by the signal, without a code, if it came during the exec of a
            # text, as dataclasses have them.
            end_at_once(INTERRUPTED)
        raise


def _interrupted() -> NoReturn:
    with contextlib.suppress(OSError):
        os.write(2, b"canwall: interrupted\n")
    end_at_once(INTERRUPTED)


if __name__ == "__main__":
    main()
