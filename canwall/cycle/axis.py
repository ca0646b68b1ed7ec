"""One drive with its wall, as the loop sees it; several may share a SYNC."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from canwall.config import Limits, Settings, Wall
from canwall.cycle.step import SYNCHRONOUS_DELAY, make_cycle
from canwall.cycle.timing import HISTOGRAM
from canwall.drive import DriveNode, DriveSetup
from canwall.record import ROW, Mailbox, Ring
from canwall.walls import Law


@dataclass(frozen=True)
class Change:
    """From cycle j on, this is the wall, and these are its limits."""

    j: int
    wall: Wall
    limits: Limits


@dataclass
class Axis:
    """A drive that is set up, its wall, and where its rows go."""

    node: DriveNode
    setup: DriveSetup
    settings: Settings
    laws: Sequence[Law]
    ring: Ring
    changes: list[Change] = field(default_factory=list)
    #: What other processes want changed while the wall is rendered.
    mailbox: Mailbox | None = None
    #: Why the wall was given up, where it is something that came beside the cycle.
    reported: str = ""
    late_rpdo: int = 0
    #: The next of the walls that take turns, counted from the first on.
    next_turn: int = 1

    def __post_init__(self) -> None:
        self.cycle: NDArray[np.void] = make_cycle(self.settings, self.setup, self.laws)
        self.row = np.zeros(1, ROW)
        self.latency = np.zeros(1, HISTOGRAM)
        given = self.settings.estimator.delay_cycles
        self.delay = SYNCHRONOUS_DELAY if given is None else given
        self.wall, self.limits = self.settings.wall, self.settings.limits
        self.turns = self.settings.laws_in_turn(self.settings.wall)

    @property
    def name(self) -> str:
        """How messages call it."""
        return f"node {self.node.node_id}"

    @property
    def measures_delay(self) -> bool:
        """Whether the delay is to be measured before the wall is rendered."""
        estimator = self.settings.estimator
        known = estimator.delay_cycles is not None or self.setup.synchronous
        return estimator.measure_delay or not known
