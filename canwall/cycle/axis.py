"""One drive with its wall; several may share a SYNC."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from canwall.config import Guard, Limits, Operator, Settings, Wall
from canwall.cycle.core import DRIVE_FRAMES
from canwall.cycle.state import make_cycle, modelled_delay, withdraw_wall
from canwall.cycle.trips import Trip
from canwall.drive import DriveNode, DriveSetup
from canwall.record import ROW, Phase, Ring
from canwall.record.controls import Controls
from canwall.record.histogram import HISTOGRAM
from canwall.walls import Law


@dataclass(frozen=True)
class WallStage:
    """Wall, limits and so on in force from cycle j on; None: as before."""

    j: int
    wall: Wall
    limits: Limits
    guard: Guard | None = None
    operator: Operator | None = None


@dataclass
class Offer:
    """A change of the wall that has been judged, ready for the loop to put into force.

    Attributes:
        revision: Revision of the wall in force against which it was judged.
        wall: Wall after the change.
        limits: Limits after it.
        guard: Guard after it.
        operator: Identification of the operator after it.
        turns: Walls that alternate after it.
        begins_turns: True if they begin to alternate with it.
        since: Cycle from which on it is in force.
        outdated: True if another change came first.
    """

    revision: int
    wall: Wall
    limits: Limits
    guard: Guard
    operator: Operator
    turns: list[Wall]
    begins_turns: bool = False
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
    #: The first such reason while the drive was being enabled, which alone ends nothing.
    suspected: str = ""
    #: Strikes after which the next of the alternating walls comes, and before the first of them.
    next_turn: int = 1
    turns_since: int = 0
    #: Words with which other processes act on the run.
    controls: Controls | None = None
    #: Time without a beat after which the wall is withdrawn [s], 0: none; since when it is watched.
    beat_timeout_s: float = 0.0
    beat_since_ns: int = 0

    def __post_init__(self) -> None:
        self.cycle: NDArray[np.void] = make_cycle(self.settings, self.setup, self.laws)
        self.row = np.zeros(1, ROW)
        #: Frames and their lateness, dtype DRIVE_FRAMES; a view of the exchange's array.
        self.frames = np.zeros(1, DRIVE_FRAMES)
        #: Times from a TPDO to its RPDO, and from the instant at which SYNC was due to the RPDO.
        self.latency, self.sync_to_rpdo = np.zeros(1, HISTOGRAM), np.zeros(1, HISTOGRAM)
        self.delay = modelled_delay(self.settings)
        self.wall, self.limits = self.settings.wall, self.settings.limits
        self.guard, self.operator = self.settings.guard, self.settings.operator
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

        While the drive is being enabled it is only noted, and has no effect while it is disabled.
        """
        if self.active and not self.cycle["trip"][0]:
            self.reported = text
            self.cycle["trip"] = np.int64(Trip.REPORTED)
        elif self.cycle["phase"][0] == Phase.ENABLING:
            self.suspected = self.suspected or text

    def open_controls(self, controls: Controls) -> None:
        """Have the compiled core look at words of control in every cycle from now on."""
        self.controls = controls  # whose memory lives as long as this
        self.frames["controls"] = controls.words.ctypes.data

    def watch_beat(self, timeout_s: float) -> None:
        """Withdraw the wall once other processes give no sign of life for that time; 0: never."""
        self.beat_since_ns = time.monotonic_ns()
        self.beat_timeout_s = timeout_s

    def look_at_beat(self) -> None:
        """Withdraw the wall if a sign of life is overdue; any thread may call this."""
        if not self.beat_timeout_s or self.controls is None or self.withdrawn:
            return
        silent_s = self.controls.silent_s(self.beat_since_ns)
        if silent_s > self.beat_timeout_s:
            self.reported = self.reported or (
                f"no beat from panel or script for {silent_s:.2g} s, {self.beat_timeout_s:g} s is "
                f"the most: the wall was ramped down"
            )
            withdraw_wall(self.cycle, round(self.settings.run.blend_s / self.settings.bus.cycle_s))

    @property
    def withdrawn(self) -> bool:
        """True once the wall is being ramped down."""
        return bool(self.cycle["share_falls"][0])

    def take_offer(self) -> Offer | None:
        """Take the requested change out, if there is one and nobody else has taken it."""
        try:
            return self.offers.pop()
        except IndexError:
            return None

    @property
    def measures_delay(self) -> bool:
        """True if the delay has to be measured before the wall is rendered."""
        estimator, drive = self.settings.estimator, self.settings.drive
        if estimator.measure_delay is True:
            return True
        if estimator.delay_cycles is not None:
            return False
        # Laws without a model need no more than that it is about a period.
        lags = drive.current_bandwidth_hz == 0.0 and not all(law.sampled for law in self.laws)
        return not self.setup.synchronous or (estimator.measure_delay == "auto" and lags)
