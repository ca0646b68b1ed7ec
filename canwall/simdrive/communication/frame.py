"""What passes between the services and the bus, and the clock of the protocol timers."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from canwall.frame import ERROR_FRAME, Frame

__all__ = ["ERROR_FRAME", "NS_PER_100_US", "NS_PER_MS", "NS_PER_US", "Clock", "Frame", "Send"]

Send: TypeAlias = Callable[[Frame], None]
"""Hands a frame to the bus."""

NS_PER_MS = 1_000_000
NS_PER_US = 1_000
NS_PER_100_US = 100_000


@dataclass(slots=True)
class Clock:
    """Protocol time in whole nanoseconds, so that sums of ticks stay exact."""

    now_ns: int = 0

    def advance(self, dt: float) -> None:
        """Let ``dt`` seconds pass."""
        self.now_ns += round(dt * 1e9)
