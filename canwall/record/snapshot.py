"""Texts and records that one process publishes and others read whole: a sequence lock.

The publisher makes the number of the snapshot odd, writes, and makes it even. A reader that finds
it odd, or another one after it has read, reads again. Neither waits for the other: the publisher
never, a reader only while something is being written.
"""

import mmap
import time

import numpy as np

from canwall.record.memory_order import fence

_HEADER = np.dtype([("number", "i8"), ("length", "i8")], align=True)
_POLL_S = 0.0002


class Snapshot:
    """Bytes in a part of shared memory, replaced as a whole."""

    def __init__(self, memory: mmap.mmap, offset: int, most: int) -> None:
        """Use the part of the memory from `offset` on, with `Snapshot.size(most)` bytes."""
        self._memory = memory
        self._header = np.frombuffer(memory, _HEADER, 1, offset)
        self._number, self._length = self._header["number"], self._header["length"]
        self._start, self._most = offset + _HEADER.itemsize, most

    @staticmethod
    def size(most: int) -> int:
        """Return the size of a part that holds up to `most` bytes, a multiple of 64."""
        return -(-(_HEADER.itemsize + most) // 64) * 64

    @property
    def number(self) -> int:
        """A number that is another one once something else has been published."""
        return int(self._number[0])

    def publish(self, content: bytes) -> None:
        """Replace the content. Raises ValueError if it is too long."""
        if len(content) > self._most:
            raise ValueError(f"{len(content)} bytes; {self._most} is the most")
        self._number[0] += 1
        fence()
        self._memory[self._start : self._start + len(content)] = content
        self._length[0] = len(content)
        fence()
        self._number[0] += 1

    def read(self, timeout_s: float = 0.1) -> bytes | None:
        """Return the content; None if it has not been whole for that time, or there is none yet.

        The publisher may have ended, or been stopped, while it wrote.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            before = self.number
            fence()
            length = min(max(int(self._length[0]), 0), self._most)
            content = self._memory[self._start : self._start + length]
            fence()
            if before == self.number and before % 2 == 0:
                return content if before else None
            if time.monotonic() >= deadline:
                return None
            time.sleep(_POLL_S)
