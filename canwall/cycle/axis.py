"""One drive with its wall; several may share a SYNC."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from canwall.config import Limits, Settings, Wall
from canwall.cycle.core import DRIVE_FRAMES
from canwall.cycle.state import make_cycle, modelled_delay
from canwall.cycle.timing import HISTOGRAM
from canwall.cycle.trips import Trip
from canwall.drive import DriveNode, DriveSetup
from canwall.record import ROW, Phase, Ring
from canwall.walls import Law


@dataclass(frozen=True)
class WallStage:
    """Wall and limits in force from cycle j on."""

    j: int
    wall: Wall
    limits: Limits


@dataclass
class Offer:
    """A change of the wall that has been judged, ready for the loop to put into force.

    Attributes:
        revision: Revision of the wall in force against which it was judged.
        wall: Wall after the change.
        limits: Limits after it.
        turns: Walls that alternate after it.
        since: Cycle from which on it is in force.
        outdated: True if another change came first.
    """

    revision: int
    wall: Wall
    limits: Limits
    turns: list[Wall]
    since: int | None = None
    outdated: bool = False


@dataclass
class WallAxis:
    """A drive that is set up, its wall, and the ring for its rows."""

    node: DriveNode
    setup: DriveSetup
    settings: Settings
    laws: Sequence[Law]
    ring: Ring
    changes: list[WallStage] = field(default_factory=list)
    #: A change that another process has requested; whoever takes it out decides on it.
    offers: list[Offer] = field(default_factory=list)
    #: Number of changes of the wall in force so far.
    revision: int = 0
    #: Reason from outside the cycle to give up the wall; empty if there is none.
    reported: str = ""
    #: Number of the next of the alternating walls.
    next_turn: int = 1

    def __post_init__(self) -> None:
        self.cycle: NDArray[np.void] = make_cycle(self.settings, self.setup, self.laws)
        self.row = np.zeros(1, ROW)
        #: Frames and their lateness, dtype DRIVE_FRAMES; a view of the exchange's array.
        self.frames = np.zeros(1, DRIVE_FRAMES)
        #: Times from a TPDO to its RPDO, and from the instant at which SYNC was due to the RPDO.
        self.latency, self.sync_to_rpdo = np.zeros(1, HISTOGRAM), np.zeros(1, HISTOGRAM)
        self.delay = modelled_delay(self.settings)
        self.wall, self.limits = self.settings.wall, self.settings.limits
        self.turns = self.settings.laws_in_turn(self.settings.wall)

    @property
    def name(self) -> str:
        """Name of the drive in messages."""
        return f"node {self.node.node_id}"

    @property
    def active(self) -> bool:
        """True while the wall is rendered or the delay measured, so that there may be a torque."""
        return int(self.cycle["phase"][0]) in (Phase.RENDERING, Phase.MEASURING)

    @property
    def late_rpdo(self) -> int:
        """Number of RPDOs that were sent after the next SYNC was due."""
        return int(self.frames["late_rpdo"][0])

    @property
    def late_in_a_row(self) -> int:
        """Number of late RPDOs since the last one in time."""
        return int(self.frames["late_in_a_row"][0])

    @property
    def wrong_length(self) -> int | None:
        """Length of the last TPDO that was too short [bytes], None if there was none."""
        length = int(self.frames["wrong_length"][0])
        return length if length >= 0 else None

    def give_up(self, text: str) -> None:
        """End the wall for a reason from outside the cycle; the first reason counts.

        Has no effect unless the axis is active.
        """
        if self.active and not self.cycle["trip"][0]:
            self.reported = text
            self.cycle["trip"] = np.int64(Trip.REPORTED)

    def take_offer(self) -> Offer | None:
        """Take the requested change out, if there is one and nobody else has taken it."""
        try:
            return self.offers.pop()
        except IndexError:
            return None

    @property
    def measures_delay(self) -> bool:
        """True if the delay has to be measured before the wall is rendered."""
        estimator = self.settings.estimator
        known = estimator.delay_cycles is not None or self.setup.synchronous
        return estimator.measure_delay or not known
