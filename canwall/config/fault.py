"""`[[simulation.fault]]`: a fault of the simulated drive, and when it is present."""

from typing import Annotated, Any, Self

from pydantic import Field, GetPydanticSchema, model_validator
from pydantic_core import core_schema

from canwall.config.section import NonNegative, Number, Positive, Section
from canwall.faults import KINDS, Direction


def _one_of_the_kinds(source: Any, handler: Any) -> core_schema.CoreSchema:
    return core_schema.literal_schema([*KINDS])


class Fault(Section):
    """One fault: its kind, start, duration and target.

    Without at_s and at_sync it is present from power-on; without a duration it stays (`reboot`
    ends at once). docs/faults.md lists the kinds and their amounts.
    """

    kind: Annotated[str, GetPydanticSchema(_one_of_the_kinds)]
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
        kind = KINDS[self.kind]
        for key in ("direction", "probability", "can_id", "amount"):
            if getattr(self, key) is not None and key not in kind.own_keys():
                raise ValueError(f"{key}: the kind {kind.name} has none; remove it")
        amount = kind.amount
        if amount and self.amount is not None and self.amount not in amount:
            raise ValueError(
                f"amount: has to be {amount.lowest} to {amount.highest} [{amount.unit}] for the "
                f"kind {kind.name}, not {self.amount}"
            )
        return self
