"""Base of every section of a configuration, and the types that TOML writes in its own way."""

import math
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field


class Section(BaseModel):
    """One table of the file: immutable, without unknown keys, its numbers finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


# A number may be written without a decimal point: `cycle_s = 1` means 1.0.
def _float(value: object) -> object:
    if isinstance(value, bool) or not isinstance(value, int):
        return value
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _tuple(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


def _path(value: object) -> object:
    return Path(value) if isinstance(value, str) else value


def _ordered(value: tuple[float, float]) -> tuple[float, float]:
    if not value[0] < value[1]:
        raise ValueError("the lower value has to come first and lie below the upper one")
    return value


_T = TypeVar("_T")

#: An array, which TOML reads as a list, as an immutable tuple.
Array = Annotated[_T, BeforeValidator(_tuple)]
Names = Array[tuple[str, ...]]
FilePath = Annotated[Path, BeforeValidator(_path)]
Number = Annotated[float, BeforeValidator(_float)]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]
#: Two numbers, the lower one first.
Interval = Annotated[Array[tuple[Number, Number]], AfterValidator(_ordered)]
