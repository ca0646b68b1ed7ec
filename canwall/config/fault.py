"""`[[simulation.fault]]`: what goes wrong in the simulated drive, and when."""

from dataclasses import dataclass
from typing import Annotated, Literal, Self, TypeAlias, get_args

from pydantic import Field, model_validator

from canwall.config.section import NonNegative, Number, Positive, Section

Direction: TypeAlias = Literal["sent", "received", "both"]
"""Frames that the drive sends, those that it receives, or both."""

FaultName: TypeAlias = Literal[
    "lost",
    "late",
    "doubled",
    "corrupted",
    "wrong_length",
    "silence",
    "reboot",
    "emcy",
    "fault",
    "encoder_jump",
    "encoder_stuck",
    "torque",
    "sto",
    "undervoltage",
    "bus_off",
    "babbling",
]
"""In the order of their numbers in 0x5F00:01, which begin with 1."""


@dataclass(frozen=True)
class Amount:
    """What the amount of a fault may be, what it is where none is given, and its unit."""

    usual: int = 0
    lowest: int = 0
    highest: int = 0
    unit: str = ""


AMOUNTS: dict[FaultName, Amount] = {
    "late": Amount(1, 1, 100_000, "SYNC periods"),
    "doubled": Amount(1, 1, 100, "copies more"),
    "corrupted": Amount(1, 0, 64, "bits"),
    "wrong_length": Amount(-1, -8, 8, "bytes more"),
    "emcy": Amount(0x1000, 1, 0xFFFF, "error code"),
    "fault": Amount(0x5000, 1, 0xFFFF, "error code"),
    "encoder_jump": Amount(1000, -(2**31), 2**31 - 1, "increments"),
    "torque": Amount(0, -1000, 1000, "per mille of the demand"),
    "babbling": Amount(10, 1, 1000, "frames per SYNC period"),
}
"""Kinds that have an amount."""

ON_FRAMES: frozenset[FaultName] = frozenset(
    ("lost", "late", "doubled", "corrupted", "wrong_length")
)
"""Kinds that touch frames: of a CAN-ID, in a direction, with a probability."""

NUMBERS: dict[FaultName, int] = {name: n for n, name in enumerate(get_args(FaultName), start=1)}
"""Of the kinds, in 0x5F00:01."""


class Fault(Section):
    """One fault: its kind, from when on, for how long, and what it touches.

    Without at_s and at_sync it is there from power-on; without a duration it stays (`reboot`
    is over at once). docs/faults.md has the kinds and their amounts.
    """

    kind: FaultName
    at_s: NonNegative | None = None
    at_sync: int | None = Field(None, ge=0)
    duration_s: Positive | None = None
    duration_syncs: int | None = Field(None, ge=1)
    can_id: int | None = Field(None, ge=0, le=0x7FF)
    direction: Direction | None = None
    probability: Annotated[Number, Field(ge=0.0, le=1.0)] | None = None
    amount: int | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for one, other in (("at_s", "at_sync"), ("duration_s", "duration_syncs")):
            if getattr(self, one) is not None and getattr(self, other) is not None:
                raise ValueError(f"{one} and {other} say the same; keep one of them")
        unwanted = [] if self.kind in ON_FRAMES else ["direction", "probability"]
        if self.kind not in ON_FRAMES and self.kind != "babbling":
            unwanted.append("can_id")
        if self.kind not in AMOUNTS:
            unwanted.append("amount")
        for key in unwanted:
            if getattr(self, key) is not None:
                raise ValueError(f"{key}: the kind {self.kind} has none; remove it")
        amount = AMOUNTS.get(self.kind)
        if amount and self.amount is not None:
            low, high = amount.lowest, amount.highest
            if not low <= self.amount <= high:
                raise ValueError(
                    f"amount: has to be {low} to {high} [{amount.unit}] for the kind "
                    f"{self.kind}, not {self.amount}"
                )
        return self
