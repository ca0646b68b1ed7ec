"""Real-time scheduling of the thread that runs the loop, where the process may have it."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

#: Above what has no such priority, below the kernel's own interrupt threads (50).
_PRIORITY = 45


@contextmanager
def real_time_priority() -> Iterator[str]:
    """Run the calling thread under SCHED_FIFO; tells what was granted, in words.

    Threads and processes that it starts meanwhile do not inherit it. Without the permission the
    loop runs as any program does, and its SYNCs come when the scheduler lets it.
    """
    before = os.sched_getscheduler(0)
    parameters = os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(_PRIORITY))
    except PermissionError:
        yield (
            f"no real-time priority: allow it in /etc/security/limits.conf: "
            f"'@realtime - rtprio {_PRIORITY}' for a group that you are in"
        )
        return
    try:
        yield f"SCHED_FIFO, priority {_PRIORITY}"
    finally:
        os.sched_setscheduler(0, before, parameters)
