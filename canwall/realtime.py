"""Real-time scheduling of the loop's thread, if the process has permission."""

import contextlib
import getpass
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

#: Priority above all normal threads and below the kernel's interrupt threads (50).
_PRIORITY = 45
#: What limits.conf has to allow: the thread that looks at the loop is a step above it.
_ALLOWED = _PRIORITY + 1


class Grant(NamedTuple):
    """One granted resource in words, and how to get more (empty if nothing is missing)."""

    found: str
    advice: str = ""


def limits_line(item: str, value: object) -> str:
    """Return the line of limits.conf that grants a limit to this user from the next login on."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a user without a name
        user = f":{os.getuid()}"
    return f"in /etc/security/limits.conf, then log in again: {user} - {item} {value}"


@contextmanager
def real_time_priority(above_loop: bool = False) -> Iterator[Grant]:
    """Run the calling thread under SCHED_FIFO; yield what was granted.

    above_loop: a step above the loop's thread, whose law may not return.

    Threads and processes that it starts do not inherit the priority. If RLIMIT_RTPRIO allows only
    a lower priority, that one is used; without permission the scheduling stays unchanged.
    """
    before, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    wanted = _PRIORITY + above_loop
    granted = _raise_priority(wanted)
    if not granted:
        yield Grant("no real-time priority", limits_line("rtprio", _ALLOWED))
        return
    try:
        low = granted < wanted
        advice = limits_line("rtprio", _ALLOWED) if low else ""
        yield Grant(f"SCHED_FIFO, priority {granted}", advice)
    finally:
        try:
            os.sched_setscheduler(0, before, parameters)
        except PermissionError:
            # An unprivileged process cannot clear SCHED_RESET_ON_FORK again.
            os.sched_setscheduler(0, before | os.SCHED_RESET_ON_FORK, parameters)


def _raise_priority(wanted: int) -> int:
    """Set the highest priority that is allowed and return it, 0 if none is."""
    soft, hard = resource.getrlimit(resource.RLIMIT_RTPRIO)
    if soft != hard:
        resource.setrlimit(resource.RLIMIT_RTPRIO, (hard, hard))
    for priority in (wanted, hard):
        if 0 < priority <= wanted:
            policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            with contextlib.suppress(PermissionError):
                os.sched_setscheduler(0, policy, os.sched_param(priority))
                return priority
    return 0
