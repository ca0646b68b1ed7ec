"""Attaches a simulated drive to a python-can bus."""

import time
from collections.abc import Callable, Iterable

import can

from canwall.simdrive.drive import SimulatedDrive
from canwall.simdrive.frame import Frame

_TICK_S = 0.001
"""Least time between ticks, and longest wait for a frame."""


class BusRunner:
    """Carries frames between a bus and a drive, in their order, and measures time for it.

    Use ``poll`` within another program's loop, or ``run`` to have the thread to oneself.
    """

    def __init__(self, drive: SimulatedDrive, bus: can.BusABC) -> None:
        """Switch the drive on: its boot-up message goes onto the bus.

        Raises:
            can.CanError: the bus does not take the message.
        """
        self._drive = drive
        self._bus = bus
        self._last_tick_s = time.monotonic()
        self._send(drive.boot())

    def poll(self) -> None:
        """Handle every frame that is waiting, without blocking, and the timers.

        Raises:
            can.CanError: the bus fails.
        """
        while (message := self._bus.recv(0)) is not None:
            self._handle(message)
        self._tick()

    def run(self, stop: Callable[[], bool]) -> None:
        """Serve the bus until ``stop`` says so; it is asked every millisecond or more often.

        Raises:
            can.CanError: the bus fails.
        """
        while not stop():
            message = self._bus.recv(_TICK_S)
            if message is not None:
                self._handle(message)
            self._tick()

    def _handle(self, message: can.Message) -> None:
        if message.is_error_frame or message.is_extended_id:
            return
        if message.is_remote_frame:
            self._send(self._drive.request(message.arbitration_id))
            return
        self._send(self._drive.process(message.arbitration_id, bytes(message.data)))

    def _tick(self) -> None:
        now_s = time.monotonic()
        if now_s - self._last_tick_s >= _TICK_S:
            self._send(self._drive.tick(now_s - self._last_tick_s))
            self._last_tick_s = now_s

    def _send(self, frames: Iterable[Frame]) -> None:
        for can_id, data in frames:
            self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
