"""python-can interface ``unixcan``: a CAN bus between processes, without root or a kernel module.

A channel is the path of a Unix-domain ``SOCK_SEQPACKET`` socket, a packet one classical CAN frame
as ``struct can_frame`` of linux/can.h (16 bytes, native byte order). There is no handshake: any
program that connects and exchanges such packets takes part. The first participant is the hub and
passes every frame on to the others. When it leaves, or dies, the others find its connection
closed, and the first of them to come founds the next hub; frames in flight are lost, as on a
disturbed bus. Who holds the lock on ``<channel>.lock`` is the hub; that empty file stays behind.

There is no bit timing and no arbitration: frames pass in the order in which the hub reads them.
"""

import contextlib
import errno
import fcntl
import logging
import os
import select
import socket
import stat
import struct
import threading
import time
import weakref
from collections import deque
from pathlib import Path
from typing import BinaryIO

import can
from can.typechecking import AutoDetectedConfig, CanFilters, Channel

from canwall.bus.readable import is_readable

log = logging.getLogger(__name__)

_FRAME = struct.Struct("=IB3x8s")
_SUN_PATH_MAX = 107
_INBOX_FRAMES = 16384
# Bytes; the kernel counts about 384 of these for a frame, and caps them at wmem_max, but for root:
# a listener that gets no processor time during ten thousand periods of simulated time misses none.
_SEND_BUFFER = 16 << 20
_SO_SNDBUFFORCE = 32  # of asm-generic/socket.h; the module socket does not have it
_ROUNDS = 32  # frames that the hub takes from each participant before it lets its owner go on
_ABSENCE_S = 0.02
_RETRY_S = 0.001
_PATIENCE_S = 1.0

_REFUSALS = {
    errno.ENOENT: "its directory does not exist; create it, or choose another path",
    errno.EACCES: "no permission; choose a path in a directory that you can write to",
    errno.EAGAIN: "its hub does not answer; end the process that holds its .lock file",
    errno.ENAMETOOLONG: f"longer than the {_SUN_PATH_MAX} bytes of a socket's path; shorten it",
    errno.ELOOP: "its .lock file is a symbolic link; remove it, or choose another path",
    errno.EISDIR: "its .lock is not a regular file; remove it, or choose another path",
    errno.ENOTSOCK: "a file that is not a socket is there; move it, or choose another path",
}


def encode_frame(msg: can.Message) -> bytes:
    """Convert a message to a packet. Raises can.CanOperationError if the bus cannot carry it."""
    if msg.is_fd:
        raise can.CanOperationError("unixcan carries classical CAN frames, not CAN FD")
    # The length of the data counts: canopen changes the data of a periodic message, not its DLC.
    length = msg.dlc if msg.is_remote_frame else len(msg.data)
    if not 0 <= length <= 8:
        raise can.CanOperationError(f"a CAN frame has 0 to 8 bytes, this one {length}")
    can_id = msg.arbitration_id
    bits = 29 if msg.is_extended_id else 11
    if not 0 <= can_id < 1 << bits:
        raise can.CanOperationError(f"{can_id:#x} does not fit a CAN identifier of {bits} bits")
    can_id |= socket.CAN_EFF_FLAG if msg.is_extended_id else 0
    can_id |= socket.CAN_RTR_FLAG if msg.is_remote_frame else 0
    can_id |= socket.CAN_ERR_FLAG if msg.is_error_frame else 0
    return _FRAME.pack(can_id, length, msg.data)


def decode_frame(frame: bytes, channel: str, is_rx: bool) -> can.Message:
    """Convert a packet received now to a message."""
    can_id, length, data = _FRAME.unpack(frame)
    return can.Message(
        timestamp=time.time(),
        arbitration_id=can_id & socket.CAN_EFF_MASK,
        is_extended_id=bool(can_id & socket.CAN_EFF_FLAG),
        is_remote_frame=bool(can_id & socket.CAN_RTR_FLAG),
        is_error_frame=bool(can_id & socket.CAN_ERR_FLAG),
        channel=channel,
        dlc=length,
        data=data[:length],
        is_rx=is_rx,
    )


def prepared(sock: socket.socket) -> socket.socket:
    """Make the socket non-blocking, with room for many unread frames, and return it."""
    sock.setblocking(False)
    # What a peer has not read counts against the sender's buffer; SO_RCVBUF has no say (unix(7)).
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
    with contextlib.suppress(OSError):
        sock.setsockopt(socket.SOL_SOCKET, _SO_SNDBUFFORCE, _SEND_BUFFER)
    return sock


def receive_frame(sock: socket.socket) -> bytes | None:
    """Return the next frame, b"" if the peer has left, None if there is no (valid) frame now."""
    try:
        frame = sock.recv(_FRAME.size + 1)
    except (BlockingIOError, ConnectionResetError):
        # A peer that left frames unread resets the connection: what it sent comes after that.
        return None
    valid = len(frame) == _FRAME.size and frame[4] <= 8
    return frame if valid or not frame else None


def _refuse_other_files(path: Path) -> None:
    if os.path.lexists(path) and not path.is_socket():
        raise OSError(errno.ENOTSOCK, os.strerror(errno.ENOTSOCK))


def _remove_socket(path: Path) -> None:
    _refuse_other_files(path)
    path.unlink(missing_ok=True)


def _open_lock(path: str) -> BinaryIO:
    """Open or create the lock file: never through a symbolic link, and leave its content alone."""
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK
    lock = os.fdopen(os.open(path, flags, 0o666), "rb", buffering=0)
    if not stat.S_ISREG(os.fstat(lock.fileno()).st_mode):
        lock.close()
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    return lock


class _Inbox:
    """Frames that wait for the owner of the bus; the lock of the bus; whether the owner attends.

    ``with inbox`` holds the lock and leaves the eventfd readable if and only if frames wait.
    """

    def __init__(self, channel: str) -> None:
        self._channel = channel
        # Reentrant: a signal handler may send while the thread it interrupts is sending.
        self._lock = threading.RLock()
        self.frames: deque[can.Message] = deque()
        self.eventfd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._signalled = False
        self.overruns = 0
        # Plain flags, written without the lock: a wrong look costs the thread of the hub one turn.
        self.waiting = False
        self.attended = True

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *error: object) -> None:
        if bool(self.frames) is not self._signalled:
            self._signalled = not self._signalled
            if self._signalled:
                os.eventfd_write(self.eventfd, 1)
            else:
                os.eventfd_read(self.eventfd)
        self._lock.release()

    def put(self, frame: bytes, is_rx: bool = True) -> None:
        if len(self.frames) < _INBOX_FRAMES:
            self.frames.append(decode_frame(frame, self._channel, is_rx))
        else:
            self.overruns += 1

    def close(self) -> None:
        self.frames.clear()
        self._signalled = False
        os.close(self.eventfd)


class _Client:
    """A participant that is connected to the hub."""

    def __init__(self, channel: str, inbox: _Inbox) -> None:
        self._inbox = inbox
        self._socket = prepared(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
        try:
            self._socket.connect(channel)
        except OSError:
            self._socket.close()
            raise

    def fileno(self) -> int:
        return self._socket.fileno()

    def transmit(self, frame: bytes) -> None:
        """Send one frame; BlockingIOError: the buffer is full, another OSError: the hub is gone."""
        self._socket.send(frame, socket.MSG_NOSIGNAL)

    def pump(self) -> bool:
        """Take one frame in if the inbox is empty; return False once the hub is gone."""
        if self._inbox.frames:
            return True
        frame = receive_frame(self._socket)
        if frame:
            self._inbox.put(frame)
        return frame != b""

    def drain(self) -> None:
        """Take in what the hub had sent before it went."""
        while frame := receive_frame(self._socket):
            self._inbox.put(frame)

    def close(self) -> None:
        self._socket.close()

    release = close


class _Hub:
    """The participant that accepts the others and passes their frames on.

    Its owner's recv() and send() do that work. While the owner does not call recv(), a thread
    stands in; the thread knows the hub, not the bus, so that a forgotten bus can be collected.
    """

    def __init__(self, channel: str, inbox: _Inbox) -> None:
        """Found the hub; BlockingIOError: somebody else holds the lock, being the hub."""
        self._path = Path(channel)
        self._inbox = inbox
        # Replaced, never changed: a signal handler may send while a loop runs over it.
        self._clients: dict[int, socket.socket] = {}
        self._closed = threading.Event()
        self._sockets = select.epoll()
        _refuse_other_files(self._path)  # before a lock file lies beside it
        with contextlib.ExitStack() as undo:
            self._lock = undo.enter_context(_open_lock(f"{channel}.lock"))
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            _remove_socket(self._path)
            self._listener = undo.enter_context(
                socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            )
            self._listener.setblocking(False)
            self._listener.bind(channel)
            undo.callback(_remove_socket, self._path)
            self._listener.listen(128)
            self._sockets.register(self._listener, select.EPOLLIN)
            threading.Thread(target=self._stand_in, name="unixcan hub", daemon=True).start()
            undo.pop_all()

    def fileno(self) -> int:
        return self._sockets.fileno()

    def transmit(self, frame: bytes) -> None:
        """Send a frame of the owner to all the others, after those who came before it."""
        self.pump()
        self._forward(frame, None)

    def pump(self) -> bool:
        """Accept who has come, pass on what they have sent, for the owner too; never fails."""
        for _ in range(_ROUNDS):
            ready = self._sockets.poll(0)
            if not ready:
                break
            # Who had come before a frame was sent has a right to it.
            for fd, _event in ready:
                if fd == self._listener.fileno():
                    self._accept()
            for fd, _event in ready:
                if client := self._clients.get(fd):
                    self._relay(client)
        return True

    def _accept(self) -> None:
        # Until nobody waits (BlockingIOError), or there are no more descriptors for now.
        with contextlib.suppress(OSError):
            while True:
                client, _address = self._listener.accept()
                prepared(client)
                self._sockets.register(client, select.EPOLLIN)
                self._clients = {**self._clients, client.fileno(): client}

    def _relay(self, client: socket.socket) -> None:
        frame = receive_frame(client)
        if frame:
            self._forward(frame, client)
            self._inbox.put(frame)
        elif frame is not None:
            self._sockets.unregister(client)
            self._clients = {fd: other for fd, other in self._clients.items() if other != client}
            client.close()

    def _forward(self, frame: bytes, sender: socket.socket | None) -> None:
        for client in self._clients.values():
            if client is not sender:
                try:
                    client.send(frame, socket.MSG_NOSIGNAL)
                except BlockingIOError:
                    self._inbox.overruns += 1
                except OSError:
                    pass  # it has left: its end of file is still to be read

    def _stand_in(self) -> None:
        inbox = self._inbox
        while not self._closed.wait(_ABSENCE_S):
            while not (inbox.attended or inbox.waiting or self._closed.is_set()):
                self._sockets.poll(_ABSENCE_S)
                with inbox:
                    self.pump()
            inbox.attended = False

    def close(self) -> None:
        """Leave the bus."""
        with contextlib.suppress(OSError):
            _remove_socket(self._path)
        self._closed.set()
        self.release()

    def release(self) -> None:
        """Give the descriptors back, and nothing else: after a fork the bus is the parent's."""
        for sock in (self._listener, *self._clients.values()):
            sock.close()
        self._lock.close()


def _attach(channel: str, inbox: _Inbox, patience: float) -> _Client | _Hub:
    """Connect to the hub, or become it; while it is changing, try again for ``patience`` seconds.

    :raises can.CanInitializationError: the channel cannot be used.
    """
    deadline = time.monotonic() + patience
    while True:
        try:
            if len(os.fsencode(channel)) > _SUN_PATH_MAX:
                raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG))
            try:
                return _Client(channel, inbox)
            except (FileNotFoundError, ConnectionRefusedError):
                return _Hub(channel, inbox)
        except OSError as error:
            if isinstance(error, BlockingIOError) and time.monotonic() < deadline:
                time.sleep(_RETRY_S)
                continue
            reason = _REFUSALS.get(error.errno or 0, f"{error.strerror}; choose another path")
            raise can.CanInitializationError(f"unixcan channel {channel!r}: {reason}") from None


class UnixBus(can.BusABC):
    """A participant of the bus on a channel, its hub if it is the first.

    :param channel: path of the socket, at most 107 bytes when absolute.
    :param can_filters: see :meth:`can.BusABC.set_filters`; done in software.
    :param receive_own_messages: whether recv() gives one's own frames too, with is_rx False.
    :param fd: must be False: the bus carries classical CAN frames only.
    :raises can.CanInitializationError: no channel, one that cannot be used, or CAN FD asked for.
    """

    def __init__(
        self,
        channel: Channel | None = None,
        can_filters: CanFilters | None = None,
        receive_own_messages: bool = False,
        fd: bool = False,
        **kwargs: object,
    ) -> None:
        if channel in (None, ""):
            raise can.CanInitializationError(
                "unixcan: no channel; give the path of a socket, e.g. channel='/tmp/canwall.sock'"
            )
        if fd:
            raise can.CanInitializationError("unixcan carries classical CAN only; leave fd out")
        self.channel = str(channel)
        self.channel_info = f"unixcan channel '{self.channel}'"
        self._path = os.path.abspath(self.channel)  # the working directory may change
        self._receive_own_messages = receive_own_messages
        self._inbox = _Inbox(self.channel)
        try:
            self._link = _attach(self._path, self._inbox, _PATIENCE_S)
        except BaseException:
            self._inbox.close()
            raise
        # One descriptor for life, whatever the link: pollers hold on to fileno().
        self._epoll = select.epoll()
        self._epoll.register(self._inbox.eventfd, select.EPOLLIN)
        self._epoll.register(self._link, select.EPOLLIN)
        super().__init__(channel=channel, can_filters=can_filters, **kwargs)
        _open_buses.add(self)

    def _rejoin(self) -> bool:
        """Find or become the next hub; until that succeeds, the dead link keeps fileno() ready."""
        old = self._link
        if isinstance(old, _Client):
            old.drain()
        try:
            new = _attach(self._path, self._inbox, patience=0.0)
        except can.CanInitializationError:
            return False
        self._epoll.unregister(old)
        old.close()
        self._link = new
        self._epoll.register(new, select.EPOLLIN)
        role = "hub" if isinstance(new, _Hub) else "client"
        log.info("%s: the hub left, rejoined as %s", self.channel_info, role)
        return True

    def _require_open(self) -> None:
        if self._is_shutdown:
            raise can.CanOperationError(f"{self.channel_info} is shut down")

    @property
    def overruns(self) -> int:
        """Number of frames that this process dropped because a receiver, maybe itself, was full."""
        return self._inbox.overruns

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        self._require_open()
        inbox = self._inbox
        inbox.waiting = True
        try:
            ready = is_readable(self._epoll, timeout)
        finally:
            inbox.attended, inbox.waiting = True, False
        if not ready:
            return None, False
        with inbox:
            self._require_open()
            attached = self._link.pump() or self._rejoin()
            received = inbox.frames.popleft() if inbox.frames else None
        if not (attached or received):
            time.sleep(_RETRY_S)
        return received, False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a classical CAN frame to all the other participants.

        :param timeout: seconds to wait while the hub does not read (None: 1 s). For the next hub,
            after one has left, it waits up to 1 s in any case.
        :raises can.CanOperationError: a frame that the bus cannot carry, transmit buffer full, no
            hub any more, or the bus is shut down.
        """
        frame = encode_frame(msg)
        start = None
        while True:
            with self._inbox:
                self._require_open()
                try:
                    self._link.transmit(frame)
                    if self._receive_own_messages:
                        self._inbox.put(frame, is_rx=False)
                    return
                except BlockingIOError:
                    reason = "transmit buffer full, the hub does not read"
                    limit = _PATIENCE_S if timeout is None else timeout
                except OSError:
                    if self._rejoin():
                        continue
                    reason, limit = "the hub left and no other could be joined", _PATIENCE_S
            start = start or time.monotonic()
            if time.monotonic() - start >= limit:
                raise can.CanOperationError(f"{self.channel_info}: {reason}")
            time.sleep(_RETRY_S)

    def frame_descriptor(self) -> int | None:
        """Descriptor of the connection to the hub, a packet a frame; None: this is the hub.

        Whoever reads it takes frames away from recv(). After the hub has left, another one is
        joined first.
        """
        with self._inbox:
            self._require_open()
            if isinstance(self._link, _Client) and not self._link.pump():
                self._rejoin()
            return self._link.fileno() if isinstance(self._link, _Client) else None

    def fileno(self) -> int:
        """Descriptor that polls readable when recv() has a frame or work to do; -1 when shut."""
        return -1 if self._epoll.closed else self._epoll.fileno()

    def shutdown(self) -> None:
        """Leave the bus; again is harmless. As the hub, remove the socket."""
        if not self._is_shutdown:
            super().shutdown()
            with self._inbox:
                self._link.close()
                self._inbox.close()
                self._epoll.close()

    def _abandon(self) -> None:
        self._is_shutdown = True
        self._link.release()
        self._inbox.close()
        self._epoll.close()

    @staticmethod
    def _detect_available_configs() -> list[AutoDetectedConfig]:
        return []


_open_buses: weakref.WeakSet[UnixBus] = weakref.WeakSet()


def _leave_to_parent() -> None:
    """Close the buses in a forked child: with its copies open, nobody would see the parent die."""
    for bus in list(_open_buses):
        # The numbers of what is closed belong to others by now.
        if not bus._is_shutdown:
            bus._abandon()


os.register_at_fork(after_in_child=_leave_to_parent)
