"""The base class of the kinds: what a kind declares, and what it may do."""

import math
from dataclasses import dataclass
from random import Random
from typing import ClassVar, Literal, TypeAlias

from canwall.faults.target import TargetDrive, TargetEncoder
from canwall.frame import Frame

Way: TypeAlias = Literal["sent", "received"]
"""A frame's way, as the drive sees it."""

Direction: TypeAlias = Literal["sent", "received", "both"]
"""Ways of the frames that a fault meets."""

INDEX = 0x5F00
"""Object by which a master asks for a fault."""

POWER_ON = -1.0
"""SYNC number before SYNC 0, the first one on the bus."""

FRAME_KEYS = ("can_id", "direction", "probability")
"""Keys of the configuration that say which frames a fault meets."""


@dataclass(frozen=True)
class Amount:
    """The whole number that faults of a kind take.

    Attributes:
        usual: value unless one is given.
        lowest: least value.
        highest: greatest value.
        unit: of the value, in words.
        form: format of the value where it is shown.
    """

    usual: int
    lowest: int
    highest: int
    unit: str
    form: str = "{}"

    def __contains__(self, value: int) -> bool:
        return self.lowest <= value <= self.highest

    def shown(self, value: int) -> str:
        """Return a value as text, without its unit."""
        return self.form.format(value)


class FaultKind:
    """A kind of fault, as a class; an instance is one fault, from its begin to its end.

    A subclass declares what distinguishes the kind and overrides what it does. Its docstring is
    its entry in docs/faults.md.

    Attributes:
        name: in the configuration and in reports.
        number: in 0x5F00:01.
        amount: amount that its faults take; None: they take none.
        frame_keys: those of FRAME_KEYS that its faults take.
        direction: ways of the frames that it meets, unless the fault says.
        stops: True if the frames that it meets vanish, remote frames included.
        momentary: True if a fault without a duration ends as it begins; otherwise it stays.
        independent: True if overlapping faults of the kind end one by one; otherwise the last to
            end ends them all.
        plan: times and settings of this fault.
        random: random numbers of this fault alone.
        drive: drive that it acts on.
        encoder: encoder of that drive.
    """

    name: ClassVar[str]
    number: ClassVar[int]
    amount: ClassVar[Amount | None] = None
    frame_keys: ClassVar[tuple[str, ...]] = ()
    direction: ClassVar[Direction] = "sent"
    stops: ClassVar[bool] = False
    momentary: ClassVar[bool] = False
    independent: ClassVar[bool] = False

    def __init__(
        self, plan: "PlannedFault", random: Random, drive: TargetDrive, encoder: TargetEncoder
    ) -> None:
        """Plan a fault; it does nothing before `begin`."""
        self.plan = plan
        self.random = random
        self.drive = drive
        self.encoder = encoder

    @classmethod
    def own_keys(cls) -> tuple[str, ...]:
        """Return the keys of `[[simulation.fault]]` that it takes besides kind and times."""
        return (*cls.frame_keys, "amount") if cls.amount else cls.frame_keys

    @property
    def effect(self) -> object:
        """Effect that overlapping faults share: the last of them to end ends it."""
        return self if self.independent else type(self)

    @property
    def delay(self) -> int:
        """SYNC periods by which it delays the frames that it meets."""
        return 0

    def begin(self) -> list[Frame] | None:
        """Act on the drive as the fault begins; return frames to send before those of the drive."""

    def end(self) -> list[Frame] | None:
        """Undo what the fault did; return frames to send before those of the drive."""

    def advance(self, periods: float) -> list[Frame] | None:
        """Go on for so many SYNC periods; return frames to send, which no other fault changes."""

    def meets(self, way: Way, can_id: int) -> bool:
        """Return True if it acts on a frame; draw a random number for each that it might."""
        plan = self.plan
        return (
            plan.direction in (way, "both")
            and plan.can_id in (None, can_id)
            and (plan.probability >= 1.0 or self.random.random() < plan.probability)
        )

    def change(self, frame: Frame) -> list[Frame]:
        """Return what becomes of a data frame that it meets."""
        return [] if self.stops else [frame]


@dataclass(frozen=True, slots=True)
class PlannedFault:
    """A fault with every setting resolved, from one SYNC to another.

    Times are SYNC numbers, the first SYNC on the bus being 0; in real time they are SYNC periods
    since power-on, and need not be whole.
    """

    kind: type[FaultKind]
    begin: float = POWER_ON
    periods: float = math.inf
    can_id: int | None = None
    direction: Direction = "sent"
    probability: float = 1.0
    amount: int = 0

    @property
    def end(self) -> float:
        """Time of its end."""
        return max(self.begin, 0.0) + self.periods

    def __str__(self) -> str:
        """Return kind and settings, e.g. ``lost (0x185 sent)``."""
        kind, details = self.kind, []
        if "direction" in kind.frame_keys:
            which = "every frame" if self.can_id is None else f"0x{self.can_id:03X}"
            ways = "sent or received" if self.direction == "both" else self.direction
            details.append(f"{which} {ways}")
            if self.probability < 1.0:
                details.append(f"probability {self.probability:g}")
        if kind.amount:
            details.append(f"{kind.amount.shown(self.amount)} {kind.amount.unit}")
        return f"{kind.name} ({', '.join(details)})" if details else kind.name
