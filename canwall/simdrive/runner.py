"""Attaches a simulated drive to a python-can bus."""

import errno
import time
from collections.abc import Callable, Iterable
from typing import Protocol

import can

from canwall.bus import DataFrame
from canwall.simdrive.communication.frame import ERROR_FRAME, Frame

_TICK_S = 0.001
"""Least time between ticks, and longest wait for a frame."""

_DISTURBED = (errno.ENETDOWN, errno.ENOBUFS)
"""Error codes of an interface that is down, or whose transmit queue is full."""


class Device(Protocol):
    """A device on a bus: frames in, frames out, and time."""

    @property
    def real_time(self) -> bool:
        """True if time has to be up to date whenever a frame comes."""
        ...

    def boot(self) -> list[Frame]:
        """Switch the device on."""
        ...

    def process(self, can_id: int, data: bytes) -> list[Frame]:
        """Take a data frame (11-bit identifier) and return the answers."""
        ...

    def request(self, can_id: int) -> list[Frame]:
        """Take a remote frame and return the answers."""
        ...

    def tick(self, dt: float) -> list[Frame]:
        """Let ``dt`` seconds pass and return the frames that are due."""
        ...


class BusRunner:
    """Carries frames between a bus and a drive, in their order, and measures its time.

    Call ``poll`` from another program's loop, or let ``run`` have the thread.
    """

    def __init__(
        self,
        drive: Device,
        bus: can.BusABC,
        clock: Callable[[], float] = time.monotonic,
        error_frames: bool = True,
        report: Callable[[str], None] = lambda line: None,
    ) -> None:
        """Switch the drive on: its boot-up message goes onto the bus.

        Args:
            drive: not yet switched on.
            bus: the bus of the drive; the caller shuts it down.
            clock: returns the time in seconds.
            error_frames: True if the bus takes error frames. A real controller makes its own, and
                sends as data what it is given.
            report: called with a line when ``run`` finds the bus gone, and when it is back.

        Raises:
            can.CanError: the bus does not take the message.
        """
        self._drive = drive
        self._bus = bus
        self._clock = clock
        self._error_frames = error_frames
        self._report = report
        self._gone = ""
        self._last_tick_s = clock()
        self._send(drive.boot())

    def poll(self) -> None:
        """Handle every frame that is waiting, without blocking, and the timers.

        Raises:
            can.CanError: the bus fails.
        """
        while (message := self._bus.recv(0)) is not None:
            self._handle(message)
        self._tick(_TICK_S)

    def run(self, stop: Callable[[], bool]) -> None:
        """Serve the bus until ``stop``, asked every millisecond or more often, returns True.

        A drive outlives its bus: while the interface is down, or takes no frames, what it sends is
        lost, and its time goes on.

        Raises:
            can.CanError: the bus fails for good.
        """
        while not stop():
            try:
                message = self._bus.recv(_TICK_S)
                if message is not None:
                    self._handle(message)
                self._tick(_TICK_S)
            except can.CanOperationError as error:
                if error.error_code not in _DISTURBED:
                    raise
                self._disturbed(str(error))
            else:
                if message is not None:
                    self._disturbed("")

    def _disturbed(self, why: str) -> None:
        if why and not self._gone:
            self._report(f"the bus is gone: {why}; the drive goes on without")
        elif self._gone and not why:
            self._report("the bus is back")
        self._gone = why

    def _handle(self, message: can.Message) -> None:
        if message.is_error_frame or message.is_extended_id or message.is_fd:
            return
        if self._drive.real_time:
            # A change that a frame brings holds from its arrival on.
            self._tick(0.0)
        if message.is_remote_frame:
            self._send(self._drive.request(message.arbitration_id))
        else:
            self._send(self._drive.process(message.arbitration_id, bytes(message.data)))

    def _tick(self, least_s: float) -> None:
        now_s = self._clock()
        passed_s = now_s - self._last_tick_s
        if passed_s >= least_s:
            self._last_tick_s = now_s
            self._send(self._drive.tick(passed_s))

    def _send(self, frames: Iterable[Frame]) -> None:
        for can_id, data in frames:
            if not can_id & ERROR_FRAME:
                self._bus.send(DataFrame(can_id, data))
            elif self._error_frames:
                self._bus.send(
                    can.Message(
                        arbitration_id=can_id & ~ERROR_FRAME,
                        is_error_frame=True,
                        is_extended_id=False,
                        data=data,
                    )
                )
