"""A bus with two ends in one process: a socket pair, its packets those of `unixcan`.

What is sent at one end is received at the other. There is no hub: compiled code at either end
exchanges its frames with the other without anybody in between.
"""

import socket
import time

import can

from canwall.bus.readable import is_readable
from canwall.bus.unixcan import decode_frame, encode_frame, prepared, receive_frame

_RETRY_S = 0.001


class SocketPairBus(can.BusABC):
    """One end of the pair."""

    def __init__(self, sock: socket.socket, channel: str) -> None:
        self._socket = prepared(sock)
        self.channel = channel
        self.channel_info = f"socket pair '{channel}'"
        super().__init__(channel=channel)

    def frame_descriptor(self) -> int | None:
        """Descriptor of the socket."""
        return self._socket.fileno()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if timeout != 0.0 and not is_readable(self._socket, timeout):
            return None, False
        frame = receive_frame(self._socket)
        if frame == b"":
            raise can.CanOperationError(f"{self.channel_info}: the other end is closed")
        return (decode_frame(frame, self.channel, is_rx=True) if frame else None), False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a classical CAN frame to the other end.

        :param timeout: seconds to wait while the other end does not read (None: 1 s).
        :raises can.CanOperationError: a frame that the bus cannot carry, transmit buffer full, or
            the other end is closed.
        """
        frame = encode_frame(msg)
        deadline = time.monotonic() + (1.0 if timeout is None else timeout)
        while True:
            try:
                self._socket.send(frame, socket.MSG_NOSIGNAL)
                return
            except BlockingIOError:
                if time.monotonic() >= deadline:
                    raise can.CanOperationError(
                        f"{self.channel_info}: transmit buffer full, the other end does not read"
                    ) from None
                time.sleep(_RETRY_S)
            except OSError as error:
                raise can.CanOperationError(f"{self.channel_info}: {error.strerror}") from None

    def fileno(self) -> int:
        """Descriptor that polls readable when recv() has a frame; -1 when shut."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        """Close this end; again is harmless."""
        if not self._is_shutdown:
            super().shutdown()
            self._socket.close()


def socket_pair(channel: str = "pair") -> tuple[SocketPairBus, SocketPairBus]:
    """Make a bus with two ends."""
    one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    return SocketPairBus(one, channel), SocketPairBus(other, channel)
