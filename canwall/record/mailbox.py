"""Requests to a run in progress, posted by other processes one at a time in shared memory.

A request is a text. The run that owns the mailbox answers it with the cycle from which on it is in
force, or with the reason why it is not; the sender waits for that.
"""

import contextlib
import fcntl
import mmap
import os
import time
from collections.abc import Iterator

import numpy as np

from canwall.errors import ConfigError
from canwall.record.memory_order import fence
from canwall.record.shared_memory import MemoryAddress, address_of, create_memory, open_memory

#: Numbers of requests posted and answered, the number of the one that its sender has withdrawn, the
#: cycle of the last answer, the length of the text: a request, or the reason of a refusal.
_HEADER = np.dtype(
    [(name, "i8") for name in ("posted", "answered", "withdrawn", "at", "length")], align=True
)
_TEXT = 4096
_SIZE = _HEADER.itemsize + _TEXT
_POLL_S = 0.001
#: Cycle of a request that was refused.
_REFUSED = -1
#: Time for an answer that crosses with a withdrawal [s].
_LAST_ANSWER_S = 1.0
_KIND = "mailbox"


class Mailbox:
    """A block of shared memory with room for one request."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._memory = mmap.mmap(descriptor, _SIZE)
        self._header = np.frombuffer(self._memory, _HEADER, 1)
        self._posted, self._answered = self._header["posted"], self._header["answered"]
        self._withdrawn = self._header["withdrawn"]

    @classmethod
    def create(cls) -> "Mailbox":
        """Create an empty mailbox. Raises OSError."""
        return cls(create_memory(_KIND, _SIZE))

    @classmethod
    def open(cls, address: MemoryAddress) -> "Mailbox":
        """Open the mailbox of another process. Raises OSError if it no longer exists."""
        return cls(open_memory(_KIND, address, _SIZE, writable=True))

    @property
    def address(self) -> MemoryAddress:
        """Address by which other processes on this machine open it while this process lives."""
        return address_of(self._descriptor)

    def close(self) -> None:
        """Close the mailbox in this process."""
        os.close(self._descriptor)

    def waiting(self) -> bool:
        """Return True if a request waits for its answer."""
        return bool(self._posted[0] != self._answered[0])

    def withdrawn(self) -> bool:
        """Return True if the sender of the waiting request has given up."""
        return bool(self._posted[0] == self._withdrawn[0])

    def text(self) -> bytes:
        """Return the waiting request, whatever another process has written; called by the run."""
        fence()
        return self._text()

    def accept(self, cycle: int) -> None:
        """Answer the waiting request: it is in force from this cycle on; called by the run."""
        self._answer(cycle, "")

    def refuse(self, reason: str) -> None:
        """Answer the waiting request: it does not come into force; called by the run."""
        self._answer(_REFUSED, reason)

    def _answer(self, cycle: int, reason: str) -> None:
        self._write(reason.encode(errors="replace")[:_TEXT])
        self._header["at"] = cycle
        fence()
        self._answered[0] = self._posted[0]

    def post(self, text: str, timeout_s: float) -> int:
        """Post a request and wait for the answer; called by the sender.

        Returns the cycle from which on it is in force. Raises ConfigError with the reason if it is
        refused, TimeoutError if it is not answered in time, and OSError if the mailbox is closed;
        it does not come into force then.
        """
        data = text.encode()
        if len(data) > _TEXT:
            raise ConfigError(f"a request of {len(data)} bytes; {_TEXT} is the most")
        deadline = time.monotonic() + timeout_s
        with self._turn(deadline):
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

    @contextlib.contextmanager
    def _turn(self, deadline: float) -> Iterator[None]:
        """Keep other senders waiting; the lock of one that dies is released, one may stand still.

        Raises TimeoutError, and OSError if the mailbox is closed.
        """
        descriptor = os.dup(self._descriptor)  # another thread may close the mailbox meanwhile
        try:
            while True:
                try:
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    if time.monotonic() >= deadline:
                        raise TimeoutError from None
                    time.sleep(_POLL_S)
            try:
                yield
            finally:
                fcntl.flock(descriptor, fcntl.LOCK_UN)
        finally:
            os.close(descriptor)

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
