"""Kinds of faults of a simulated drive: each a class with its settings, effects and documentation.

The configuration validates by these classes, the simulated drive serves 0x5F00 by them and lets
them act. A kind is a subclass of `FaultKind` in `in_drive` or `on_frames`; nothing else lists it.
"""

from canwall.faults import in_drive, on_frames
from canwall.faults.kind import (
    INDEX,
    POWER_ON,
    Amount,
    Direction,
    FaultKind,
    PlannedFault,
    Way,
)
from canwall.faults.target import TargetDrive, TargetEncoder

KINDS: dict[str, type[FaultKind]] = {
    kind.name: kind for kind in sorted(FaultKind.__subclasses__(), key=lambda kind: kind.number)
}
"""Every kind by its name, in the order of the numbers."""

__all__ = [
    "INDEX",
    "KINDS",
    "POWER_ON",
    "Amount",
    "Direction",
    "FaultKind",
    "PlannedFault",
    "TargetDrive",
    "TargetEncoder",
    "Way",
    "in_drive",
    "on_frames",
]
