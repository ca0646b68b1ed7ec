"""Interface of a transport: it moves the frames of the core and sleeps, and knows no rule."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from canwall.cycle.core import Want
from canwall.drive import Link


@dataclass(frozen=True)
class CycleFrames:
    """Frames of a cycle: CAN-IDs, with linux/can.h's flags, that it receives and that it sends.

    real_time: whether they keep to the clock. period_s: of the SYNC [s].
    """

    received: tuple[int, ...]
    sent: tuple[int, ...]
    real_time: bool
    period_s: float


class Transport(Protocol):
    """Moves the frames of one core."""

    name: str
    """Name in a summary."""

    def run(self) -> Want:
        """Do what the core wants until that is something of Python's (from `Want.DONE` on).

        Raises:
            can.CanError: the bus has failed.
        """
        ...

    def finish_cycle(self) -> None:
        """Dispatch the frames that came by another way than the core's."""
        ...

    def close(self) -> None:
        """Give back what the transport has opened; the link stays open."""
        ...


TransportFactory: TypeAlias = Callable[[Link, NDArray[np.void], CycleFrames], Transport]
"""Makes the transport of a core (dtype CORE, shape (1,)) on a link.

Raises can.CanInitializationError where the bus is none that it could work on.
"""
