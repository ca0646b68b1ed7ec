"""A simulated drive at the other end of a socket pair: no Python in steady operation."""

import functools
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from canwall.bus.raw_socket import (
    CAN_FRAME,
    FRAME,
    PORT,
    CFunction,
    elements,
    now_ns,
    place_port,
    receive,
    send,
)
from canwall.bus.socket_pair import SocketPairBus
from canwall.bus.unixcan import decode_frame
from canwall.compiled import Record, compiled, compiled_for_c
from canwall.simdrive.faults import FaultyDrive
from canwall.simdrive.runner import BusRunner
from canwall.simdrive.state import DRIVE
from canwall.simdrive.steady import DECLINED, take

_TICK_NS = 10_000_000
"""Interval of the ticks that the drive's timers need."""

_SEND_PATIENCE_NS = 1_000_000_000
"""A master that does not read for this long loses a TPDO."""

#: The socket; address of the drive's record; its last tick, and when the next is due (by
#: CLOCK_MONOTONIC); a frame that `steady.take` has declined.
SERVER = np.dtype(
    [
        ("port", PORT, (1,)),
        ("descriptor", "i8"),
        ("drive", "u8"),
        ("ticked_ns", "i8"),
        ("due_ns", "i8"),
        ("declined", "?"),
        ("frame", CAN_FRAME, (1,)),
    ],
    align=True,
)


@compiled
def serve(servers: NDArray[np.void]) -> int:
    """Take all frames that wait; return 1, or 0 where Python has to go on.

    servers has dtype SERVER and shape (1,).
    """
    server: Record = servers[0]
    drives = elements(server.drive, 1, DRIVE)
    drive: Record = drives[0]
    port = server.port[0]
    now = now_ns(port)
    if not drive.steady or server.declined or now >= server.due_ns:
        return 0
    drive.now_ns = drive.ticked_ns + now - server.ticked_ns
    while receive(port, server.descriptor, False) == FRAME:
        frame = port.frame[0]
        sent = take(drives, frame.can_id, frame.length, frame.data)
        if sent == DECLINED:
            kept = server.frame[0]
            kept.can_id, kept.length, kept.data = frame.can_id, frame.length, frame.data
            server.declined = True
            return 0
        for k in range(sent):
            tpdo = drive.tpdos[drive.sync_tpdos[k]]
            send(port, server.descriptor, tpdo.can_id, tpdo.length, tpdo.data, _SEND_PATIENCE_NS)
    return 1


def _serve_at(address: int) -> int:
    """Call `serve` for the record at an address."""
    return serve(elements(address, 1, SERVER))


@functools.cache
def _serve_function() -> Any:
    """Return `_serve_at` as a C function, compiled or loaded at its first use."""
    return compiled_for_c(_serve_at, types.int64(types.uint64))


class SocketRunner(BusRunner):
    """A runner whose drive answers from compiled code while it is in steady operation."""

    def __init__(self, drive: FaultyDrive, bus: SocketPairBus) -> None:
        """Switch the drive on, as BusRunner does."""
        super().__init__(drive, bus)
        self._record = record = np.zeros(1, SERVER)
        # The address is kept as long as this runner, and so the drive.
        record["drive"] = drive.drive.state.record.ctypes.data
        record["descriptor"] = bus.fileno()
        place_port(record["port"][0])
        self.compiled = CFunction(int(_serve_function().address), record.ctypes.data)
        """The function for compiled code to call; where it returns 0, `poll` has to go on."""

    def poll(self) -> None:
        """Handle every frame that is waiting, without blocking, and the timers.

        Raises:
            can.CanError: the bus fails.
        """
        record = self._record
        if record["declined"][0]:
            record["declined"] = False
            frame = record["frame"][0].tobytes()
            self._handle(decode_frame(frame, str(self._bus.channel_info), is_rx=True))
        super().poll()
        record["ticked_ns"] = ticked_ns = round(self._last_tick_s * 1e9)
        record["due_ns"] = ticked_ns + _TICK_NS
