"""Interface of a transport, which moves the frames of the core and sleeps, without rules."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from canwall.cycle.core import Want
from canwall.drive import Link


@dataclass(frozen=True)
class CycleFrames:
    """CAN-IDs, with the flags of linux/can.h, of the frames that a cycle receives and sends.

    real_time: True if the cycle follows the clock. period_s: period of the SYNC [s].
    """

    received: tuple[int, ...]
    sent: tuple[int, ...]
    real_time: bool
    period_s: float


class Transport(Protocol):
    """Moves the frames of one core."""

    name: str
    """Name in the summary of a run."""

    def run(self) -> Want:
        """Serve the core until it wants Python (`Want.DONE` and above); return that `Want`.

        Raises:
            can.CanError: If the bus fails.
        """
        ...

    def finish_cycle(self) -> None:
        """Dispatch frames that were not received by the core."""
        ...

    def close(self) -> None:
        """Release the resources of the transport; the link stays open."""
        ...


TransportFactory: TypeAlias = Callable[[Link, NDArray[np.void], CycleFrames], Transport]
"""Makes the transport of a core (dtype CORE, shape (1,)) on a link.

Raises can.CanInitializationError if it cannot work on the bus.
"""
