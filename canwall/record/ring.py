"""Ring buffers in shared memory that carry the rows and frames of a run to the writer.

Each of the two rings (cycles and frames) has one producer and one consumer, and each side owns one
counter: the head counts the items put in (`append`), the tail the items taken out. Neither is ever
reset.
"""

import mmap
import os

import can
import numpy as np
from numpy.typing import NDArray

from canwall.compiled import data_to_number, number_to_data
from canwall.record.columns import ROW
from canwall.record.memory_order import fence
from canwall.record.shared_memory import MemoryAddress, address_of, create_memory, open_memory

#: Bits of a FRAME's flags.
RECEIVED, REMOTE, ERROR, EXTENDED = 1, 2, 4, 8

#: One frame on the bus, as the master received or sent it.
FRAME = np.dtype(
    [
        ("time_s", "f8"),
        ("can_id", "u4"),
        ("flags", "u1"),
        ("length", "u1"),
        ("data", "i8"),  # as data_to_number gives it
    ],
    align=True,
)

#: Heads and tails of both rings, and the numbers of lost items.
HEADER = np.dtype(
    [
        ("row_head", "i8"),
        ("row_tail", "i8"),
        ("rows_lost", "i8"),
        ("frame_head", "i8"),
        ("frame_tail", "i8"),
        ("frames_lost", "i8"),
    ],
    align=True,
)

#: Capacity in cycles and frames: 16 s at 1 kHz, longer than disks usually stall.
ROWS = 1 << 14
FRAMES = 1 << 16

_KIND = "record"


class Ring:
    """Both rings in one block of shared memory, shared with another process by descriptor."""

    def __init__(self, descriptor: int, access: int = mmap.ACCESS_WRITE) -> None:
        self.descriptor = descriptor
        self._memory = mmap.mmap(descriptor, self.size(), access=access)
        self.header = np.frombuffer(self._memory, HEADER, 1)
        offset = self._offsets()
        self.rows = np.frombuffer(self._memory, ROW, ROWS, offset[0])
        self.frames = np.frombuffer(self._memory, FRAME, FRAMES, offset[1])

    @classmethod
    def create(cls) -> "Ring":
        """Create an empty ring. Raises OSError."""
        return cls(create_memory(_KIND, cls.size()))

    @classmethod
    def open(cls, address: MemoryAddress) -> "Ring":
        """Open the ring of another process to read in it. Raises OSError if it no longer exists."""
        return cls(open_memory(_KIND, address, cls.size()), mmap.ACCESS_READ)

    @property
    def address(self) -> MemoryAddress:
        """Address by which other processes on this machine open it while this process lives."""
        return address_of(self.descriptor)

    @staticmethod
    def _offsets() -> tuple[int, int, int]:
        rows = 64
        frames = rows + ROWS * ROW.itemsize
        return rows, frames, frames + FRAMES * FRAME.itemsize

    @classmethod
    def size(cls) -> int:
        """Return the size of the shared memory [bytes]."""
        return cls._offsets()[2]

    def close(self) -> None:
        """Close the descriptor; the memory is freed with its last user."""
        os.close(self.descriptor)

    def log_frame(self, time_s: float, message: can.Message, received: bool) -> None:
        """Put in a frame (a `drive.FrameLog`)."""
        from canwall.record.append import put_frame  # the writer spares itself numba

        flags = (
            RECEIVED * received
            | REMOTE * message.is_remote_frame
            | ERROR * message.is_error_frame
            | EXTENDED * message.is_extended_id
        )
        put_frame(
            self.header,
            self.frames,
            time_s,
            message.arbitration_id,
            flags,
            message.dlc,
            data_to_number(message.data),
        )

    def backlog(self) -> float:
        """Fill level of the fuller of the two rings, from 0 to 1."""
        header = self.header[0]
        rows = (header["row_head"] - header["row_tail"]) / ROWS
        frames = (header["frame_head"] - header["frame_tail"]) / FRAMES
        return float(max(rows, frames))

    def take_rows(self) -> NDArray[np.void]:
        """Take out all rows: a copy of shape (n,), dtype ROW; called by the consumer."""
        return self._take(self.rows, "row_head", "row_tail")

    def take_frames(self) -> NDArray[np.void]:
        """Take out all frames: a copy of shape (n,), dtype FRAME; called by the consumer."""
        return self._take(self.frames, "frame_head", "frame_tail")

    def rows_since(self, start: int) -> tuple[int, NDArray[np.void]]:
        """Copy the rows from a number on, for a reader besides the consumer; take none out.

        Args:
            start: Number of the first row that is wanted, from 0.

        Returns:
            Number of the row after the last, and the rows, shape (n,), dtype ROW. Those that the
            producer has overwritten by then are left out.
        """
        stop = int(self.header["row_head"][0])
        first = max(start, stop - ROWS)
        fence()
        rows = self.rows[np.arange(first, stop) % ROWS]
        fence()
        # The row after the head may be in the making, in the place of the one ROWS before it.
        whole_from = int(self.header["row_head"][0]) - ROWS + 1
        return stop, rows[max(0, whole_from - first) :]

    def _take(self, ring: NDArray[np.void], head: str, tail: str) -> NDArray[np.void]:
        start, stop = int(self.header[tail][0]), int(self.header[head][0])
        fence()
        taken = ring[np.arange(start, stop) % len(ring)]
        fence()
        self.header[tail] = stop
        return taken


def to_message(frame: NDArray[np.void], channel: str) -> can.Message:
    """Convert a FRAME to python-can's message."""
    flags, length = int(frame["flags"]), int(frame["length"])
    remote = bool(flags & REMOTE)
    return can.Message(
        timestamp=float(frame["time_s"]),
        arbitration_id=int(frame["can_id"]),
        is_extended_id=bool(flags & EXTENDED),
        is_remote_frame=remote,
        is_error_frame=bool(flags & ERROR),
        is_rx=bool(flags & RECEIVED),
        dlc=length,
        data=None if remote else number_to_data(int(frame["data"]), length),
        channel=channel,
    )
