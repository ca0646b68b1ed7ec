"""CAN frames through a descriptor, and the clock, in compiled code: no interpreter lock, no copy.

A frame is `struct can_frame` of linux/can.h: what a raw CAN socket carries, and `unixcan`'s packets
alike. The functions are the C library's, called by name; each is a system call or less. Linux.
"""

import errno
import socket
from typing import Any, NamedTuple

import numpy as np
from numba import carray, types
from numba.core import cgutils
from numba.core.typing import signature
from numba.extending import intrinsic
from numpy.typing import NDArray

from canwall.compiled import Record, compiled

#: One classical frame; data is a little-endian number, as `data_to_number` gives it.
CAN_FRAME = np.dtype(
    [("can_id", "u4"), ("length", "u1"), ("reserved", "u1", (3,)), ("data", "<i8")], align=True
)
#: Flags of an identifier (linux/can.h).
CAN_EFF, CAN_RTR, CAN_ERR = 1 << 31, 1 << 30, 1 << 29

#: One frame, and what the calls below need besides: `struct iovec`, `struct msghdr`, a control
#: message with a time stamp, `struct pollfd`, `struct timespec`.
PORT = np.dtype(
    [
        ("frame", CAN_FRAME, (1,)),
        ("timespec", "i8", (2,)),
        ("pollfd", [("fd", "i4"), ("events", "i2"), ("revents", "i2")], (1,)),
        ("iovec", "u8", (2,)),
        (
            "msghdr",
            [
                ("name", "u8"),
                ("name_length", "u4"),
                ("iovec", "u8"),
                ("iovec_length", "u8"),
                ("control", "u8"),
                ("control_length", "u8"),
                ("flags", "i4"),
            ],
            (1,),
        ),
        ("control", "i8", (16,)),
        ("stamp_ns", "i8"),  # of the last frame, CLOCK_REALTIME; 0: the kernel gave none
        ("errno", "i8"),
    ],
    align=True,
)
_FRAME_SIZE = CAN_FRAME.itemsize

#: Results of `receive` and `send`: a frame; none waiting; closed by the other side; error in errno.
FRAME, NOTHING, CLOSED, FAILED = 1, 0, -1, -2

#: Longest time that a network interface's transmit queue may stay full (ENOBUFS), and the interval
#: of the retries, since no poll reports room. A queue of ten frames empties in 11 ms at 125 kbit/s.
QUEUE_PATIENCE_NS, QUEUE_RETRY_NS = 50_000_000, 200_000

_CLOCK_MONOTONIC, _TIMER_ABSTIME = 1, 1
_POLLIN, _POLLOUT = 1, 4
_NS_PER_S = 1_000_000_000
_EAGAIN, _EINTR, _ECONNRESET = errno.EAGAIN, errno.EINTR, errno.ECONNRESET
_ENOBUFS = errno.ENOBUFS
_DONTWAIT = int(socket.MSG_DONTWAIT)
_SEND_FLAGS = int(socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
_SOL_SOCKET = socket.SOL_SOCKET
#: asm-generic/socket.h; the option is also the type of the control message.
SO_TIMESTAMPING, SO_TIMESTAMPNS = 37, 35
#: linux/net_tstamp.h: stamps when the driver hands a frame to the kernel, by CLOCK_REALTIME.
RX_SOFTWARE_STAMPS = 1 << 3 | 1 << 4


class CFunction(NamedTuple):
    """A function i8(u8) in memory, and what it is called with: the address of its state."""

    address: int
    state: int


def _c_function(name: str, result: Any, *arguments: Any) -> Any:
    """Return a function of the C library, for compiled code."""
    return types.ExternalFunction(name, signature(result, *arguments))


_recv = _c_function("recv", types.intp, types.int32, types.uintp, types.uintp, types.int32)
_send = _c_function("send", types.intp, types.int32, types.uintp, types.uintp, types.int32)
_recvmsg = _c_function("recvmsg", types.intp, types.int32, types.uintp, types.int32)
_ppoll = _c_function("ppoll", types.int32, types.uintp, types.uintp, types.uintp, types.uintp)
_clock_gettime = _c_function("clock_gettime", types.int32, types.int32, types.uintp)
_clock_nanosleep = _c_function(
    "clock_nanosleep", types.int32, types.int32, types.int32, types.uintp, types.uintp
)
_errno_location = _c_function("__errno_location", types.CPointer(types.int32))


@intrinsic  # type: ignore[untyped-decorator]
def _pointer(typingctx: Any, address: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return types.voidptr(address), codegen


@compiled
def elements(address: int, count: int, dtype: Any) -> Any:
    """Return the array of `count` records at an address; for calls from compiled code only.

    Whoever stores the address keeps the array alive.
    """
    return carray(_pointer(address), count, dtype)


def place_port(port: NDArray[np.void]) -> None:
    """Make a port ready, shape (1,), dtype PORT, whose memory must stay where it is."""
    base = port.ctypes.data
    fields = PORT.fields
    assert fields is not None
    port["iovec"][0] = base + fields["frame"][1], _FRAME_SIZE
    message = port["msghdr"][0]
    message["iovec"], message["iovec_length"] = base + fields["iovec"][1], 1
    message["control"] = base + fields["control"][1]


@compiled
def _errno() -> int:
    return carray(_errno_location(), 1)[0]


@compiled
def now_ns(port: Record) -> int:
    """CLOCK_MONOTONIC [ns], which is also time.perf_counter_ns."""
    _clock_gettime(_CLOCK_MONOTONIC, port.timespec.ctypes.data)
    return port.timespec[0] * _NS_PER_S + port.timespec[1]


@compiled
def sleep_until(port: Record, deadline_ns: int) -> None:
    """Sleep to an absolute instant of CLOCK_MONOTONIC; a signal may end it before."""
    port.timespec[0] = deadline_ns // _NS_PER_S
    port.timespec[1] = deadline_ns % _NS_PER_S
    _clock_nanosleep(_CLOCK_MONOTONIC, _TIMER_ABSTIME, port.timespec.ctypes.data, 0)


@compiled
def _poll(port: Record, descriptor: int, events: int, timeout_ns: int) -> bool:
    """Wait until the descriptor is ready, no longer than this."""
    poll = port.pollfd[0]
    poll.fd = descriptor
    poll.events = events
    poll.revents = 0
    left = max(timeout_ns, 0)
    port.timespec[0] = left // _NS_PER_S
    port.timespec[1] = left % _NS_PER_S
    return _ppoll(port.pollfd.ctypes.data, 1, port.timespec.ctypes.data, 0) > 0


@compiled
def wait_readable(port: Record, descriptor: int, timeout_ns: int) -> bool:
    """Wait for a frame, no longer than this; whether there is one. A signal may end it before."""
    return _poll(port, descriptor, _POLLIN, timeout_ns)


@compiled
def _stamp(port: Record) -> int:
    """Return the kernel's time stamp in the control message [ns], 0 if there is none."""
    control = port.control
    # struct cmsghdr: length, then level and type; then one stamp, or three, the first the kernel's.
    if port.msghdr[0].control_length < 32:
        return 0
    kind, level = control[1] >> 32, control[1] & 0xFFFFFFFF
    if level != _SOL_SOCKET or (kind != SO_TIMESTAMPING and kind != SO_TIMESTAMPNS):
        return 0
    return control[2] * _NS_PER_S + control[3]


@compiled
def receive(port: Record, descriptor: int, stamped: bool) -> int:
    """Take a frame that is there into `port.frame`: FRAME, NOTHING, CLOSED or FAILED.

    With `stamped`, of a socket with SO_TIMESTAMPING or SO_TIMESTAMPNS, `port.stamp_ns` is when it
    came.
    """
    port.stamp_ns = 0
    if stamped:
        port.msghdr[0].control_length = 8 * len(port.control)
        size = _recvmsg(descriptor, port.msghdr.ctypes.data, _DONTWAIT)
        if size == _FRAME_SIZE:
            port.stamp_ns = _stamp(port)
    else:
        size = _recv(descriptor, port.frame.ctypes.data, _FRAME_SIZE, _DONTWAIT)
    if size == _FRAME_SIZE:
        # What is no valid frame is as good as none.
        return FRAME if port.frame[0].length <= 8 else NOTHING
    if size == 0:
        return CLOSED
    if size > 0:
        return NOTHING
    port.errno = _errno()
    if port.errno == _EAGAIN or port.errno == _EINTR:
        return NOTHING
    # A peer that left frames unread resets the connection: what it sent comes after that.
    return NOTHING if port.errno == _ECONNRESET else FAILED


@compiled
def send(
    port: Record, descriptor: int, can_id: int, length: int, data: int, patience_ns: int
) -> int:
    """Send a frame: FRAME, or FAILED with `port.errno`.

    While the socket's transmit buffer is full (EAGAIN) it is waited for, no longer than
    `patience_ns`; while the interface's queue is (ENOBUFS), no longer than QUEUE_PATIENCE_NS.
    """
    queue_until = room_until = 0
    frame = port.frame[0]
    frame.can_id = can_id
    frame.length = length
    frame.data = data if length == 8 else data & ((1 << 8 * length) - 1)
    while True:
        if _send(descriptor, port.frame.ctypes.data, _FRAME_SIZE, _SEND_FLAGS) == _FRAME_SIZE:
            return FRAME
        port.errno = _errno()
        if port.errno == _EINTR:
            continue
        if port.errno == _ENOBUFS:
            now = now_ns(port)
            queue_until = queue_until or now + QUEUE_PATIENCE_NS
            if now >= queue_until:
                return FAILED
            sleep_until(port, now + QUEUE_RETRY_NS)
            continue
        now = now_ns(port)
        room_until = room_until or now + patience_ns
        if port.errno != _EAGAIN or now >= room_until:
            return FAILED
        _poll(port, descriptor, _POLLOUT, room_until - now)  # a signal may end it before
