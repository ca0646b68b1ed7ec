"""One drive with its wall; several may share a SYNC."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from canwall.config import Limits, Settings, Wall
from canwall.cycle.core import DRIVE_FRAMES
from canwall.cycle.state import SYNCHRONOUS_DELAY, make_cycle
from canwall.cycle.timing import HISTOGRAM
from canwall.cycle.trips import Trip
from canwall.drive import DriveNode, DriveSetup
from canwall.record import ROW, Mailbox, Phase, Ring
from canwall.walls import Law


@dataclass(frozen=True)
class WallStage:
    """From cycle j on, this is the wall, and these are its limits."""

    j: int
    wall: Wall
    limits: Limits


@dataclass
class WallAxis:
    """A drive that is set up, its wall, and the ring that takes its rows."""

    node: DriveNode
    setup: DriveSetup
    settings: Settings
    laws: Sequence[Law]
    ring: Ring
    changes: list[WallStage] = field(default_factory=list)
    #: Changes of the wall that other processes ask for.
    mailbox: Mailbox | None = None
    #: Reason to give up the wall that came from outside the cycle; empty: there is none.
    reported: str = ""
    #: Number of the next wall of those that take turns.
    next_turn: int = 1

    def __post_init__(self) -> None:
        self.cycle: NDArray[np.void] = make_cycle(self.settings, self.setup, self.laws)
        self.row = np.zeros(1, ROW)
        #: Its frames and their lateness, dtype DRIVE_FRAMES, a view of the exchange's array.
        self.frames = np.zeros(1, DRIVE_FRAMES)
        #: From a TPDO to its RPDO, and from the instant at which the SYNC was due to the RPDO.
        self.latency, self.sync_to_rpdo = np.zeros(1, HISTOGRAM), np.zeros(1, HISTOGRAM)
        given = self.settings.estimator.delay_cycles
        self.delay = SYNCHRONOUS_DELAY if given is None else given
        self.wall, self.limits = self.settings.wall, self.settings.limits
        self.turns = self.settings.laws_in_turn(self.settings.wall)

    @property
    def name(self) -> str:
        """Name of the drive in messages."""
        return f"node {self.node.node_id}"

    @property
    def active(self) -> bool:
        """True while there may be a torque: the wall is rendered, or the delay measured."""
        return int(self.cycle["phase"][0]) in (Phase.RENDERING, Phase.MEASURING)

    @property
    def late_rpdo(self) -> int:
        """RPDOs that were sent after the next SYNC was due."""
        return int(self.frames["late_rpdo"][0])

    @property
    def late_in_a_row(self) -> int:
        """Late RPDOs since the last one in time."""
        return int(self.frames["late_in_a_row"][0])

    @property
    def wrong_length(self) -> int | None:
        """Length of the last TPDO that did not carry what was mapped [bytes], None without one."""
        length = int(self.frames["wrong_length"][0])
        return length if length >= 0 else None

    def give_up(self, text: str) -> None:
        """End the wall because of something outside the cycle; the first reason counts.

        Ignored before there may be a torque, and while the wall is being left.
        """
        if self.active and not self.cycle["trip"][0]:
            self.reported = text
            self.cycle["trip"] = np.int64(Trip.REPORTED)

    @property
    def measures_delay(self) -> bool:
        """True if the delay has to be measured before the wall is rendered."""
        estimator = self.settings.estimator
        known = estimator.delay_cycles is not None or self.setup.synchronous
        return estimator.measure_delay or not known
