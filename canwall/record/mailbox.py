"""Changes of a wall during a run, posted by another process one at a time in shared memory.

A change is a text. The run that owns the mailbox answers it with the cycle from which on it is in
force, or with the reason why it is not; the sender waits for that.
"""

import errno
import fcntl
import mmap
import os
import secrets
import time
from typing import NamedTuple

import numpy as np

from canwall.errors import ConfigError
from canwall.record.memory_order import fence

#: Numbers of changes posted and answered, the number of the one that its sender has withdrawn, the
#: cycle of the last answer, the length of the text: a change, or the reason of a refusal.
_HEADER = np.dtype(
    [(name, "i8") for name in ("posted", "answered", "withdrawn", "at", "length")], align=True
)
_TEXT = 4096
_SIZE = _HEADER.itemsize + _TEXT
_POLL_S = 0.001
#: Cycle of a change that was refused.
_REFUSED = -1
#: Time for an answer that crosses with a withdrawal [s].
_LAST_ANSWER_S = 1.0
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
        self._posted, self._answered = self._header["posted"], self._header["answered"]
        self._withdrawn = self._header["withdrawn"]

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
        """Return True if a change waits for its answer."""
        return bool(self._posted[0] != self._answered[0])

    def withdrawn(self) -> bool:
        """Return True if the sender of the waiting change has given up."""
        return bool(self._posted[0] == self._withdrawn[0])

    def text(self) -> bytes:
        """Return the waiting change, whatever another process has written; called by the run."""
        fence()
        return self._text()

    def accept(self, cycle: int) -> None:
        """Answer the waiting change: it is in force from this cycle on; called by the run."""
        self._answer(cycle, "")

    def refuse(self, reason: str) -> None:
        """Answer the waiting change: it does not come into force; called by the run."""
        self._answer(_REFUSED, reason)

    def _answer(self, cycle: int, reason: str) -> None:
        self._write(reason.encode(errors="replace")[:_TEXT])
        self._header["at"] = cycle
        fence()
        self._answered[0] = self._posted[0]

    def post(self, text: str, timeout_s: float) -> int:
        """Post a change and wait for the answer; called by the sender.

        Returns the cycle from which on it is in force. Raises ConfigError with the reason if it is
        refused, and TimeoutError if it is not answered in time; it does not come into force then.
        """
        data = text.encode()
        if len(data) > _TEXT:
            raise ConfigError(f"a change of {len(data)} bytes; {_TEXT} is the most")
        deadline = time.monotonic() + timeout_s
        # One sender at a time; the lock is released when its holder dies.
        fcntl.flock(self._descriptor, fcntl.LOCK_EX)
        try:
            self._wait(deadline)
            self._write(data)
            fence()
            self._posted[0] += 1
            try:
                self._wait(deadline)
            except TimeoutError:
                self._withdrawn[0] = self._posted[0]
                # It may have been taken at the same moment.
                self._wait(time.monotonic() + _LAST_ANSWER_S)
            fence()
            cycle = int(self._header["at"][0])
            if cycle != _REFUSED:
                return cycle
            if self.withdrawn():
                raise TimeoutError
            raise ConfigError(self._text().decode(errors="replace"))
        finally:
            fcntl.flock(self._descriptor, fcntl.LOCK_UN)

    def _wait(self, deadline: float) -> None:
        while self.waiting():
            if time.monotonic() >= deadline:
                raise TimeoutError
            time.sleep(_POLL_S)

    def _text(self) -> bytes:
        length = min(max(int(self._header["length"][0]), 0), _TEXT)
        return self._memory[_HEADER.itemsize : _HEADER.itemsize + length]

    def _write(self, data: bytes) -> None:
        self._memory[_HEADER.itemsize : _HEADER.itemsize + len(data)] = data
        self._header["length"] = len(data)
