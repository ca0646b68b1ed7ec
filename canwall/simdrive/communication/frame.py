"""Frames between services and bus, and the clock of the protocol timers."""

from collections.abc import Callable
from typing import TypeAlias

from canwall.frame import ERROR_FRAME, Frame
from canwall.simdrive.state import DriveRecord

__all__ = ["ERROR_FRAME", "NS_PER_100_US", "NS_PER_MS", "NS_PER_US", "Clock", "Frame", "Send"]

Send: TypeAlias = Callable[[Frame], None]
"""Hands a frame to the bus."""

NS_PER_MS = 1_000_000
NS_PER_US = 1_000
NS_PER_100_US = 100_000


class Clock:
    """Protocol time in whole nanoseconds, so that sums of ticks stay exact."""

    def __init__(self, state: DriveRecord) -> None:
        """Begin at zero."""
        self._state = state.fields
        self._state.now_ns = self._state.ticked_ns = 0

    @property
    def now_ns(self) -> int:
        """Present time."""
        now_ns: int = self._state.now_ns
        return now_ns

    def advance(self, dt: float) -> None:
        """Let ``dt`` seconds have passed since the last call."""
        state = self._state
        state.ticked_ns += round(dt * 1e9)
        state.now_ns = state.ticked_ns
