"""A fault with everything settled: when, how long, what it touches; in SYNC periods."""

import math
from dataclasses import dataclass

from canwall.config import AMOUNTS, ON_FRAMES, Direction, FaultName
from canwall.config import Fault as FaultSettings

POWER_ON = -1.0
"""Before SYNC 0, which is the first one on the bus."""


@dataclass(frozen=True, slots=True)
class PlannedFault:
    """What goes wrong, from one SYNC to another.

    Times are SYNC numbers, the first SYNC on the bus being 0; in real time they are SYNC periods
    since power-on, and need not be whole.
    """

    kind: FaultName
    begin: float = POWER_ON
    periods: float = math.inf
    can_id: int | None = None
    direction: Direction = "sent"
    probability: float = 1.0
    amount: int = 0

    @property
    def end(self) -> float:
        """When it is over."""
        return max(self.begin, 0.0) + self.periods

    def __str__(self) -> str:
        """Kind and what distinguishes it, e.g. ``lost (0x185 sent)``."""
        details = []
        if self.kind in ON_FRAMES:
            which = "every frame" if self.can_id is None else f"0x{self.can_id:03X}"
            touched = "sent or received" if self.direction == "both" else self.direction
            details.append(f"{which} {touched}")
            if self.probability < 1.0:
                details.append(f"probability {self.probability:g}")
        if self.kind in AMOUNTS:
            code = self.kind in ("emcy", "fault")
            shown = f"0x{self.amount:04X}" if code else str(self.amount)
            details.append(f"{shown} {AMOUNTS[self.kind].unit}")
        return f"{self.kind} ({', '.join(details)})" if details else self.kind


def planned(settings: FaultSettings, period_s: float, real_time: bool) -> PlannedFault:
    """Return what the configuration asks for, with what it leaves open settled."""

    def periods(syncs: int | None, seconds: float | None, open_end: float) -> float:
        if syncs is not None:
            return float(syncs)
        if seconds is None:
            return open_end
        exact = seconds / period_s
        return exact if real_time else float(round(exact))

    at_once = settings.kind == "reboot"
    duration = periods(settings.duration_syncs, settings.duration_s, 0.0 if at_once else math.inf)
    amount = settings.amount
    if amount is None:
        amount = AMOUNTS[settings.kind].usual if settings.kind in AMOUNTS else 0
    return PlannedFault(
        kind=settings.kind,
        begin=periods(settings.at_sync, settings.at_s, POWER_ON),
        periods=duration,
        can_id=settings.can_id,
        direction=settings.direction or "sent",
        probability=1.0 if settings.probability is None else settings.probability,
        amount=amount,
    )
