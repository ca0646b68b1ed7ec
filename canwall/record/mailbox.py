"""Changes of a wall during a run, posted by another process one at a time in shared memory.

A change is a text that the sender has checked. The loop looks for one between two cycles, takes it
as a whole, and notes the cycle. The loop never waits; the sender waits for that note.
"""

import errno
import fcntl
import mmap
import os
import secrets
import time
from typing import NamedTuple

import numpy as np

#: Changes posted by senders, changes taken by the loop, the cycle of the last one, its length.
_HEADER = np.dtype([("posted", "i8"), ("taken", "i8"), ("at", "i8"), ("length", "i8")], align=True)
_TEXT = 4096
_SIZE = _HEADER.itemsize + _TEXT
_POLL_S = 0.001
_NAME = "canwall-mailbox-"


class MailboxAddress(NamedTuple):
    """Address of a mailbox: a descriptor of a process, and the file that it has to be."""

    pid: int
    descriptor: int
    file: str


class Mailbox:
    """A block of shared memory with room for one change."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._memory = mmap.mmap(descriptor, _SIZE)
        self._header = np.frombuffer(self._memory, _HEADER, 1)
        self._posted, self._taken = self._header["posted"], self._header["taken"]

    @classmethod
    def create(cls) -> "Mailbox":
        """Create an empty mailbox, with a name that no other has."""
        descriptor = os.memfd_create(f"{_NAME}{secrets.token_hex(16)}")
        os.ftruncate(descriptor, _SIZE)
        return cls(descriptor)

    @classmethod
    def open(cls, address: "MailboxAddress") -> "Mailbox":
        """Open the mailbox of another process. Raises OSError if it no longer exists."""
        path = f"/proc/{address.pid}/fd/{address.descriptor}"
        # The process may have ended, and its number be that of another one, with other files.
        if os.readlink(path) == address.file and address.file.startswith(f"/memfd:{_NAME}"):
            descriptor = os.open(path, os.O_RDWR | os.O_NONBLOCK)
            if os.readlink(f"/proc/self/fd/{descriptor}") == address.file:
                return cls(descriptor)
            os.close(descriptor)
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), path)

    @property
    def address(self) -> "MailboxAddress":
        """Address by which other processes on this machine open it while this process lives."""
        file = os.readlink(f"/proc/self/fd/{self._descriptor}")
        return MailboxAddress(os.getpid(), self._descriptor, file)

    def close(self) -> None:
        """Close the mailbox in this process."""
        os.close(self._descriptor)

    def waiting(self) -> bool:
        """Return True if a change is waiting; called by the loop."""
        return bool(self._posted[0] != self._taken[0])

    def take(self, cycle: int) -> str:
        """Return the waiting change, in force from this cycle on; called by the loop."""
        length = int(self._header["length"][0])
        text = self._memory[_HEADER.itemsize : _HEADER.itemsize + length].decode()
        self._header["at"] = cycle
        self._taken[0] = self._posted[0]
        return text

    def post(self, text: str, timeout_s: float) -> int:
        """Post a change and wait until it is taken; called by the sender.

        Returns the cycle from which on it is in force. Raises ValueError for a text that is too
        long, TimeoutError if the loop does not take it in time.
        """
        data = text.encode()
        if len(data) > _TEXT:
            raise ValueError(f"a change of {len(data)} bytes; {_TEXT} is the most")
        deadline = time.monotonic() + timeout_s
        # One sender at a time; the lock is released when its holder dies.
        fcntl.flock(self._descriptor, fcntl.LOCK_EX)
        try:
            while self.waiting():
                _wait(deadline)
            self._memory[_HEADER.itemsize : _HEADER.itemsize + len(data)] = data
            self._header["length"] = len(data)
            self._posted[0] += 1
            while self.waiting():
                _wait(deadline)
            return int(self._header["at"][0])
        finally:
            fcntl.flock(self._descriptor, fcntl.LOCK_UN)


def _wait(deadline: float) -> None:
    if time.monotonic() >= deadline:
        raise TimeoutError
    time.sleep(_POLL_S)
