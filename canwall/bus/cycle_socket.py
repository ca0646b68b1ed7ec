"""The descriptor over which compiled code exchanges the frames of the cycle.

On SocketCAN it is a socket of its own, to which the kernel gives the cyclic frames and what may
end the wall, while the python-can bus keeps all others: SDO, NMT, heartbeats of other nodes. A bus
between two ends or processes that carries the same packets lends its own descriptor.
"""

import contextlib
import os
import socket
import struct
from collections.abc import Iterable
from typing import Any, Protocol, runtime_checkable

import can

from canwall.bus.errors import reason
from canwall.bus.raw_socket import RX_SOFTWARE_STAMPS, SO_TIMESTAMPING, SO_TIMESTAMPNS

_STANDARD = 0x7FF
_EFF, _RTR, _INVERTED = 1 << 31, 1 << 30, 1 << 29
_ALL_ERRORS = (1 << 29) - 1
#: linux/can/raw.h.
_ERR_FILTER, _JOIN_FILTERS = 2, 6


@runtime_checkable
class FrameSocket(Protocol):
    """A python-can bus that is one connected socket, a packet one `struct can_frame`."""

    def frame_descriptor(self) -> int | None:
        """Descriptor of the socket; None where there is no such one now."""
        ...


class CycleSocket:
    """Socket that compiled code sends to and receives from."""

    def __init__(
        self,
        bus: can.BusABC,
        received: Iterable[int],
        sent: Iterable[int],
        stamps: bool = False,
    ) -> None:
        """Open it, or borrow that of the bus.

        received, sent: CAN-IDs of what the cycle takes and gives; on SocketCAN the bus does not
        hear them any more. stamps: whether a borrowed one is to give the kernel's time stamps,
        which a socket of its own always does. Raises can.CanInitializationError where the bus has
        nothing to offer.
        """
        self._bus = bus
        self._own: socket.socket | None = None
        #: True if received frames carry the kernel's time stamps.
        self.stamped = False
        if isinstance(bus, FrameSocket):
            self._stamps = stamps
            self._borrow()
        elif type(bus).__module__.startswith("can.interfaces.socketcan"):
            self._own = _open(str(bus.channel), received)  # type: ignore[attr-defined]
            self.descriptor = self._own.fileno()
            self.stamped = True
            _leave_out(bus, {*received, *(can_id & _STANDARD for can_id in sent)})
        else:
            raise can.CanInitializationError(
                "the native exchange needs SocketCAN or unixcan; use bus.exchange = 'python-can'"
            )

    @property
    def own(self) -> bool:
        """True if it is a socket beside that of the bus."""
        return self._own is not None

    def _borrow(self) -> None:
        assert isinstance(self._bus, FrameSocket)
        descriptor = self._bus.frame_descriptor()
        if descriptor is None:
            raise can.CanInitializationError(
                f"{self._bus.channel_info}: this process passes the frames of the others on, "
                "which compiled code does not; start the drive first, or use "
                "bus.exchange = 'python-can'"
            )
        self._take(descriptor)

    def _take(self, descriptor: int) -> None:
        """Use a descriptor of the bus; its packets are stamped as their sender hands them over."""
        self.descriptor = descriptor
        if self._stamps:
            with contextlib.suppress(OSError), socket.socket(fileno=os.dup(descriptor)) as sock:
                sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
                self.stamped = True

    def renew(self) -> bool:
        """Look for the socket again after a failure; return whether there is one."""
        if self._own is not None:
            return True
        assert isinstance(self._bus, FrameSocket)
        descriptor = self._bus.frame_descriptor()
        if descriptor is None:
            return False
        self._take(descriptor)
        return True

    def close(self) -> None:
        """Close a socket beside that of the bus, and give the bus its frames back."""
        if self._own is not None:
            self._own.close()
            self._own = None
            _take_back(self._bus)


def _open(channel: str, received: Iterable[int]) -> socket.socket:
    filters = b"".join(
        struct.pack("=II", can_id, _STANDARD | _EFF | _RTR) for can_id in sorted(set(received))
    )
    sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    try:
        sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)
        sock.setsockopt(socket.SOL_CAN_RAW, _ERR_FILTER, struct.pack("=I", _ALL_ERRORS))
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPING, RX_SOFTWARE_STAMPS)
        sock.setblocking(False)
        sock.bind((channel,))
    except OSError as error:
        sock.close()
        raise can.CanInitializationError(reason(error.errno or 0, channel)) from None
    return sock


def _leave_out(bus: Any, can_ids: Iterable[int]) -> None:
    """Filter these frames, and error frames, out of a SocketCAN bus."""
    filters = b"".join(
        struct.pack("=II", can_id | _INVERTED, _STANDARD | _EFF | _RTR)
        for can_id in sorted(can_ids)
    )
    bus.socket.setsockopt(socket.SOL_CAN_RAW, _JOIN_FILTERS, 1)
    bus.socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)
    bus.socket.setsockopt(socket.SOL_CAN_RAW, _ERR_FILTER, struct.pack("=I", 0))


def _take_back(bus: Any) -> None:
    bus.socket.setsockopt(socket.SOL_CAN_RAW, _JOIN_FILTERS, 0)
    bus.socket.setsockopt(socket.SOL_CAN_RAW, _ERR_FILTER, struct.pack("=I", _ALL_ERRORS))
    bus.set_filters(bus.filters)
