"""Words of shared memory with which other processes act on a run without its help.

The compiled core looks at `stop` in every cycle. The run looks at `beat_ns` if it was asked to.
"""

import mmap
import os
import time

import numpy as np

from canwall.record.shared_memory import MemoryAddress, address_of, create_memory, open_memory

CONTROLS = np.dtype([("stop", "i8"), ("beat_ns", "i8")], align=True)

_KIND = "controls"


class Controls:
    """The words of one run."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._memory = mmap.mmap(descriptor, CONTROLS.itemsize)
        #: The words, shape (1,), dtype CONTROLS.
        self.words = np.frombuffer(self._memory, CONTROLS, 1)
        self._stop, self._beat_ns = self.words["stop"], self.words["beat_ns"]

    @classmethod
    def create(cls) -> "Controls":
        """Create words that ask for nothing. Raises OSError."""
        return cls(create_memory(_KIND, CONTROLS.itemsize))

    @classmethod
    def open(cls, address: MemoryAddress) -> "Controls":
        """Open the words of another process. Raises OSError if they no longer exist."""
        return cls(open_memory(_KIND, address, CONTROLS.itemsize, writable=True))

    @property
    def address(self) -> MemoryAddress:
        """Address by which other processes on this machine open it while this process lives."""
        return address_of(self._descriptor)

    def close(self) -> None:
        """Close the words in this process; who has their memory may still use it."""
        os.close(self._descriptor)

    @property
    def stopped(self) -> bool:
        """True once somebody has asked for zero torque."""
        return bool(self._stop[0])

    def stop(self) -> None:
        """Ask for zero torque in the next RPDO, and the way out."""
        self._stop[0] = 1

    def beat(self) -> None:
        """Show a sign of life."""
        self._beat_ns[0] = time.monotonic_ns()

    def silent_s(self, since_ns: int) -> float:
        """Return the time without a sign of life, or since an instant of time.monotonic_ns [s].

        A sign of life from the future is none.
        """
        beat_ns = int(self._beat_ns[0])
        now_ns = time.monotonic_ns()
        return (now_ns - max(beat_ns if beat_ns <= now_ns else 0, since_ns)) * 1e-9
