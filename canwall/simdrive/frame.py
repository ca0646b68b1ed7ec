"""What passes between the services and the bus, and the clock of the protocol timers."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

Frame: TypeAlias = tuple[int, bytes]
"""A CAN data frame: 11-bit identifier and 0 to 8 bytes."""

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
