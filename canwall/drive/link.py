"""Link of the master to its bus: cycle, SDO, NMT and EMCY in one thread.

canopen's Network receives in a thread of its own, which disturbs the timing of the cycle. Here,
code that waits for a frame reads the bus itself and passes other frames to the network, so SDO
transfers and the cycle need neither a lock nor a second thread.
"""

import contextlib
import errno
import logging
import struct
import time
from collections import deque
from collections.abc import Callable, Container

import can
import canopen
from canopen.sdo import SdoClient
from canopen.sdo.exceptions import SdoCommunicationError

from canwall.bus.can_ids import ERROR_CONTROL, NMT
from canwall.bus.errors import explained
from canwall.bus.raw_socket import QUEUE_PATIENCE_NS, QUEUE_RETRY_NS, CFunction

# Failures are raised; without a handler, canopen would also log them to standard error.
logging.getLogger("canopen").addHandler(logging.NullHandler())

#: Command specifier of an SDO answer by that of the request: download segment, initiate download,
#: initiate upload, upload segment (CiA 301, 7.2.4.3); and that of an abort.
_ANSWERS = {0: 1, 1: 3, 2: 2, 3: 0}
_ABORT = 4
#: Requests whose answer repeats index and subindex.
_INITIATE = (1, 2)
#: Latest requests among which a second answer is looked for.
_REMEMBERED = 16

#: Logs a frame: time [s], message, True if it was received, False if it was sent.
FrameLog = Callable[[float, can.Message, bool], None]


class Link:
    """A python-can bus with canopen's network on it.

    Attributes:
        bus: The bus.
        idle: Called instead of blocking while no frame is waiting; an embedded simulated drive
            runs in it.
        compiled_idle: A C function that does the same for compiled code, and returns 0 if idle has
            to be called after all.
        log: Called with every frame.
        on_error_frame: Called with every error frame.
        turns: Number of calls of the bus so far.
        abandoned: True once a call that may still use the bus was given up; then it stays open.
        network: canopen's network.
    """

    def __init__(
        self,
        bus: can.BusABC,
        idle: Callable[[], None] | None = None,
        compiled_idle: CFunction | None = None,
        reopen: Callable[[], can.BusABC] | None = None,
    ) -> None:
        """Make a link.

        Args:
            bus: The bus.
            idle: Called instead of blocking while no frame is waiting.
            compiled_idle: The same for compiled code.
            reopen: Opens the bus once more, None if that is not possible.
        """
        self.bus = bus
        self.idle = idle
        self.compiled_idle = compiled_idle
        self.log: FrameLog | None = None
        self.on_error_frame: Callable[[can.Message], None] | None = None
        self.turns = 0
        self.abandoned = False
        self._reopen = reopen
        self.network = _Network(self)

    def beside(self) -> "Link":
        """Return a link to the same bus beside this one, from which a call does not come back.

        It has a bus of its own if that can be opened once more.
        """
        self.abandoned = True
        bus = self.bus
        if self._reopen is not None:
            with contextlib.suppress(Exception):
                bus = self._reopen()
        link = Link(bus, self.idle, reopen=self._reopen)
        link.log = self.log
        return link

    def send(self, message: can.Message) -> None:
        """Send and log a frame. Raises can.CanError."""
        self.send_unlogged(message)
        if self.log is not None:
            self.log(time.time(), message, False)

    def send_unlogged(self, message: can.Message) -> None:
        """Send a frame. Raises can.CanError."""
        self.turns += 1
        try:
            self.bus.send(message)
        except can.CanOperationError as error:
            if error.error_code != errno.ENOBUFS:
                raise explained(error, self.bus) from None
            self._send_when_there_is_room(message)

    def _send_when_there_is_room(self, message: can.Message) -> None:
        # python-can gives up at once, because the socket always polls as writable.
        deadline_ns = time.monotonic_ns() + QUEUE_PATIENCE_NS
        while True:
            time.sleep(QUEUE_RETRY_NS * 1e-9)
            try:
                self.bus.send(message)
                return
            except can.CanOperationError as error:
                if error.error_code != errno.ENOBUFS or time.monotonic_ns() >= deadline_ns:
                    raise explained(error, self.bus) from None

    def receive(self, timeout_s: float) -> can.Message | None:
        """Return and log the next frame; None if there is none in time. Raises can.CanError."""
        message = self.receive_unlogged(timeout_s)
        if message is not None and self.log is not None:
            self.log(message.timestamp, message, True)
        return message

    def receive_unlogged(self, timeout_s: float) -> can.Message | None:
        """Return the next frame; None if there is none in time. Raises can.CanError."""
        self.turns += 1
        try:
            if self.idle is None:
                return self.bus.recv(timeout_s)
            return self._receive_idling(timeout_s)
        except can.CanOperationError as error:
            raise explained(error, self.bus) from None

    def _receive_idling(self, timeout_s: float) -> can.Message | None:
        assert self.idle is not None
        deadline = time.monotonic() + timeout_s
        while True:
            message = self.bus.recv(0)
            self.turns += 1
            if message is not None or time.monotonic() >= deadline:
                return message
            self.idle()

    def wait_for(self, can_ids: Container[int], timeout_s: float) -> can.Message | None:
        """Return the next data frame with one of these identifiers, None if there is none.

        Other frames go to the network. Raises can.CanError.
        """
        deadline = time.monotonic() + timeout_s
        remaining = timeout_s
        while True:
            message = self.receive(remaining)
            if message is None:
                return None
            if message.arbitration_id in can_ids and _carries_data(message):
                return message
            self.dispatch(message)
            remaining = max(0.0, deadline - time.monotonic())

    def dispatch(self, message: can.Message) -> None:
        """Pass a frame to canopen (SDO answers, heartbeats, EMCY); ignore a malformed one."""
        if message.is_error_frame:
            if self.on_error_frame is not None:
                self.on_error_frame(message)
            return
        if not _carries_data(message):
            return
        # An empty heartbeat or a short EMCY of another node must not end the cycle.
        with contextlib.suppress(struct.error):
            self.network.notify(message.arbitration_id, message.data, message.timestamp)

    def serve(self, timeout_s: float) -> bool:
        """Receive one frame for the network; return False if there was none within the time."""
        message = self.receive(timeout_s)
        if message is not None:
            self.dispatch(message)
        return message is not None

    def find_nodes(self, patience_s: float) -> list[int]:
        """Ask all nodes for their device type; return the node-IDs under which frames come.

        A failure of the bus counts as silence. patience_s: time to listen after the questions [s].
        """
        scanner = self.network.scanner
        scanner.reset()
        with contextlib.suppress(can.CanError):
            scanner.search()
            deadline = time.monotonic() + patience_s
            while (remaining := deadline - time.monotonic()) > 0.0:
                self.serve(remaining)
        return sorted(scanner.nodes)

    def add_node(self, node_id: int, dictionary: canopen.ObjectDictionary) -> canopen.RemoteNode:
        """Add a remote node whose SDO transfers read this link."""
        return self.network.add_node(_Node(node_id, dictionary, self))

    def close(self) -> None:
        """Close the bus."""
        self.bus.shutdown()


def _carries_data(message: can.Message) -> bool:
    """Return True for a data frame, except for one with a small identifier of 29 bits.

    Such an identifier would be mistaken for the 11-bit identifier of the same number.
    """
    return not (
        message.is_remote_frame
        or message.is_error_frame
        or (message.is_extended_id and message.arbitration_id <= 0x7FF)
    )


class _Network(canopen.Network):  # type: ignore[misc]
    """canopen's network without its receive thread; it sends through the link."""

    def __init__(self, link: Link) -> None:
        super().__init__()
        self._link = link

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._link.send(
            can.Message(
                arbitration_id=can_id,
                data=data,
                is_remote_frame=remote,
                is_extended_id=can_id > 0x7FF,
            )
        )


class _Node(canopen.RemoteNode):  # type: ignore[misc]
    """A remote node with SDO clients that read the link."""

    def __init__(self, node_id: int, dictionary: canopen.ObjectDictionary, link: Link) -> None:
        self._link = link
        super().__init__(node_id, dictionary)

    def associate_network(self, network: canopen.Network) -> None:
        """Subscribe to SDO answers and EMCY, not to NMT.

        canopen keeps a state of the node by what it hears, and raises KeyError where somebody has
        sent one that CiA 301 does not have.
        """
        super().associate_network(network)
        network.unsubscribe(ERROR_CONTROL + self.id, self.nmt.on_heartbeat)
        network.unsubscribe(NMT, self.nmt.on_command)

    def remove_network(self) -> None:
        """Unsubscribe from everything; canopen expects its own subscriptions to be there."""
        if self.has_network():
            self.network.subscribe(ERROR_CONTROL + self.id, self.nmt.on_heartbeat)
            self.network.subscribe(NMT, self.nmt.on_command)
        super().remove_network()

    def add_sdo(self, rx_cobid: int, tx_cobid: int) -> SdoClient:
        client = _Sdo(rx_cobid, tx_cobid, self.object_dictionary, self._link)
        self.sdo_channels.append(client)
        if self.has_network():
            self.network.subscribe(client.tx_cobid, client.on_response)
        return client


class _Sdo(SdoClient):  # type: ignore[misc]
    """canopen's SDO client, which reads the bus itself while it waits.

    Attributes:
        doubled: Number of second answers to requests that were answered in time.
    """

    def __init__(self, rx: int, tx: int, dictionary: canopen.ObjectDictionary, link: Link) -> None:
        super().__init__(rx, tx, dictionary)
        self._link = link
        self._request = bytes(8)
        self._awaiting = False
        self._answered: deque[bytes] = deque(maxlen=_REMEMBERED)
        self.doubled = 0

    def send_request(self, request: bytearray) -> None:
        self._request = bytes(request)
        self._awaiting = True
        super().send_request(request)

    def on_response(self, can_id: int, data: bytearray, timestamp: float) -> None:
        # Ignore an answer that is late for an earlier request, or meant for another master.
        if len(data) != 8:
            return
        if self._awaiting and self._answers(data):
            self._awaiting = False
            self._answered.append(_head(data))
            super().on_response(can_id, data, timestamp)
        elif _head(data) in self._answered:
            self._answered.remove(_head(data))
            self.doubled += 1

    def _answers(self, data: bytearray) -> bool:
        specifier, asked = data[0] >> 5, self._request[0] >> 5
        same = asked not in _INITIATE or data[1:4] == self._request[1:4]
        if specifier == _ABORT:
            # Some drives leave index and subindex out of their aborts.
            return same or not any(data[1:4])
        return specifier == _ANSWERS.get(asked) and same

    def read_response(self) -> bytes:
        deadline = time.monotonic() + self.RESPONSE_TIMEOUT
        while self.responses.empty():
            remaining = deadline - time.monotonic()
            if remaining <= 0.0:
                # Both this answer and that to a repetition may still come.
                self._answered.clear()
                raise SdoCommunicationError(
                    f"no answer within {self.RESPONSE_TIMEOUT:g} s (drive.sdo_timeout_s)"
                )
            self._link.serve(remaining)
        response: bytes = super().read_response()
        return response


def _head(data: bytearray) -> bytes:
    """Return the command specifier of an answer, with index and subindex."""
    return bytes([data[0] >> 5]) + bytes(data[1:4])
