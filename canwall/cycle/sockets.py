"""Compiled transport over a socket (SocketCAN, `unixcan`, a socket pair), without the GIL."""

from collections.abc import Callable
from typing import Any

import can
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from canwall.bus import CycleSocket, bus_error
from canwall.bus.raw_socket import (
    CLOSED,
    FAILED,
    FRAME,
    PORT,
    CFunction,
    now_ns,
    place_port,
    receive,
    send,
    sleep_until,
    wait_readable,
)
from canwall.compiled import Record, compiled
from canwall.cycle.core import CORE, Want, proceed, proceed_without, take
from canwall.cycle.step import step_address
from canwall.cycle.transport import CycleFrames
from canwall.drive import Link

#: Time after a request during which the socket is polled: for a fast drive, polling costs less
#: than a sleep.
POLL_NS = 30_000
#: Longest wait for a full transmit buffer: in simulated time [s], and as a share of the cycle in
#: real time.
_SEND_PATIENCE_S, _SEND_SHARE = 1.0, 0.2

#: Results of `_run` besides a `Want`: the idle function has to be called in Python; the other side
#: has closed; a call has failed, with `errno` in the port.
_IDLE, _GONE, _ERRNO = 100, 101, 102
_HAS_GONE = "the other side of the bus has gone"
_SEND, _FRAME, _DRAIN, _SLEEP, _SPIN = map(
    int, (Want.SEND, Want.FRAME, Want.DRAIN, Want.SLEEP, Want.SPIN)
)

SOCKET = np.dtype(
    [
        ("port", PORT, (1,)),
        ("descriptor", "i8"),
        ("stamped", "?"),
        ("send_patience_ns", "i8"),
        ("poll_ns", "i8"),
        # Drive that is served in idle time, by Python or by a C function at an address.
        ("idle", "?"),
        ("idled", "?"),  # in Python, since the socket was last read
        ("idle_function", "u8"),
        ("idle_state", "u8"),
    ],
    align=True,
)


def compile_run() -> None:
    """Compile what `SocketTransport.run` calls, the step first: it takes longest."""
    step_address()
    _run.compile(np.zeros(1, CORE), np.zeros(1, SOCKET))  # type: ignore[attr-defined]


class SocketTransport:
    """Moves the frames of a cycle over the socket of a bus, or one beside it (`CycleSocket`)."""

    name = "native"

    def __init__(self, link: Link, core: NDArray[np.void], frames: CycleFrames) -> None:
        """Open the socket.

        Raises:
            can.CanInitializationError: If the bus has no such socket.
        """
        self._link = link
        self._core = core
        while link.serve(0.0):  # what has come so far might not pass the filters of a new socket
            pass
        self._cycle_socket = CycleSocket(
            link.bus, frames.received, frames.sent, stamps=frames.real_time
        )
        self._socket = np.zeros(1, SOCKET)
        place_port(self._socket["port"][0])
        self._socket["descriptor"] = self._cycle_socket.descriptor
        self._socket["stamped"] = self._cycle_socket.stamped
        patience_s = _SEND_SHARE * frames.period_s if frames.real_time else _SEND_PATIENCE_S
        self._socket["send_patience_ns"] = round(patience_s * 1e9)
        self._socket["poll_ns"] = POLL_NS
        self._has_failed = False

    @property
    def poll_ns(self) -> int:
        """Time of polling for frames before the wait becomes a sleep [ns]."""
        return int(self._socket["poll_ns"][0])

    @poll_ns.setter
    def poll_ns(self, poll_ns: int) -> None:
        self._socket["poll_ns"] = poll_ns

    @property
    def descriptor(self) -> int:
        """Descriptor of the socket that carries the frames of the cycle."""
        return int(self._socket["descriptor"][0])

    @descriptor.setter
    def descriptor(self, descriptor: int) -> None:
        self._socket["descriptor"] = descriptor

    def run(self) -> Want:
        """Move frames until the core wants Python. Raises can.CanError if the bus fails."""
        if self._has_failed:
            self._find_again()
        link, socket = self._link, self._socket
        socket["idle"], socket["idled"] = link.idle is not None, False
        socket["idle_function"], socket["idle_state"] = link.compiled_idle or CFunction(0, 0)
        while (result := _run(self._core, socket)) == _IDLE:
            idle: Callable[[], None] | None = link.idle
            assert idle is not None
            idle()
        self._has_failed = result in (_GONE, _ERRNO)
        if result == _GONE:
            raise can.CanOperationError(_HAS_GONE)
        if result == _ERRNO:
            raise bus_error(int(socket["port"]["errno"][0, 0]), link.bus)
        return Want(result)

    def _find_again(self) -> None:
        """Use the connection that the bus has now: the number of a closed one may be a file's."""
        if not self._cycle_socket.renew():
            raise can.CanOperationError(_HAS_GONE)
        self.descriptor = self._cycle_socket.descriptor

    def finish_cycle(self) -> None:
        """Hand over frames that the bus received outside the socket of the cycle."""
        if self._cycle_socket.own:
            while self._link.serve(0.0):
                pass

    def close(self) -> None:
        """Close the socket of the cycle if it is separate from that of the bus."""
        self._cycle_socket.close()


@intrinsic  # type: ignore[untyped-decorator]
def _call_idle(typingctx: Any, address: Any, state: Any) -> Any:
    """Call the compiled idle function at `address`; it returns 0 if Python's has to be called."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = ir.IntType(64)
        function = ir.FunctionType(number, [number]).as_pointer()
        return builder.call(builder.inttoptr(arguments[0], function), [arguments[1]])

    return types.int64(types.uint64, types.uint64), codegen


@compiled
def _run(cores: NDArray[np.void], sockets: NDArray[np.void]) -> int:
    """Serve the core until it wants Python; return a `Want` or one of the results above."""
    core: Record = cores[0]
    socket: Record = sockets[0]
    port = socket.port[0]
    asked_ns = now_ns(port)
    # True once the drive has taken all that was sent: what it has answered waits in the socket.
    served = socket.idled
    want = _FRAME if socket.idled else proceed(cores, asked_ns)
    socket.idled = False
    while True:
        if want == _SEND:
            served = False
            out = core.out
            patience_ns = socket.send_patience_ns
            if send(port, socket.descriptor, out[0], out[1], out[2], patience_ns) != FRAME:
                return _ERRNO
            asked_ns = now_ns(port)
            want = proceed(cores, asked_ns)
        elif want in (_FRAME, _DRAIN):
            came = receive(port, socket.descriptor, socket.stamped)
            if came == FRAME:
                frame = port.frame[0]
                want = take(
                    cores, frame.can_id, frame.length, frame.data, now_ns(port), port.stamp_ns
                )
            elif came == CLOSED:
                return _GONE
            elif came == FAILED:
                return _ERRNO
            elif want == _DRAIN or now_ns(port) >= core.until_ns:
                want = proceed(cores, now_ns(port))
            elif served and not core.real_time and not core.external_sync:
                want = proceed_without(cores, now_ns(port))
            elif socket.idle:
                served = True
                if not (
                    socket.idle_function and _call_idle(socket.idle_function, socket.idle_state)
                ):
                    socket.idled = True
                    return _IDLE
            elif now_ns(port) - asked_ns > socket.poll_ns:
                wait_readable(port, socket.descriptor, core.until_ns - now_ns(port))
        elif want == _SLEEP:
            sleep_until(port, core.until_ns)
            want = proceed(cores, now_ns(port))
        elif want == _SPIN:
            want = proceed(cores, now_ns(port))
        else:
            return want
