"""Wait for a descriptor that can be read: its number may be any."""

import select
from typing import Protocol

#: Descriptors that select() can be asked about, which is FD_SETSIZE of POSIX.
_SELECTABLE = 1024


class _Described(Protocol):
    def fileno(self) -> int: ...


def is_readable(source: _Described, timeout_s: float | None) -> bool:
    """Wait until there is something to read, no longer than this (None: for ever)."""
    if source.fileno() < _SELECTABLE:
        # Not poll(), nor the wait of epoll: Python rounds their times up to whole milliseconds.
        return bool(select.select((source,), (), (), timeout_s)[0])
    poll = select.poll()
    poll.register(source, select.POLLIN)
    return bool(poll.poll(None if timeout_s is None else timeout_s * 1e3))
