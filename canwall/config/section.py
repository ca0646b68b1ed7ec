"""Base class of all sections of a configuration, and types that TOML represents differently."""

import math
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    create_model,
)

#: Longest name of a file or a folder on Linux [bytes].
_LONGEST_NAME = 255


class Section(BaseModel):
    """One table of the file: immutable, without unknown keys, and with finite numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


class Change(Section):
    """New values for some keys of a section; None leaves a key as it is."""

    if TYPE_CHECKING:
        # `changing` adds the keys at run time, so a type checker does not see them.
        def __getattr__(self, key: str) -> Any: ...


_C = TypeVar("_C", bound=Change)
_S = TypeVar("_S", bound=Section)


def changed(section: _S, change: Change | None) -> _S:
    """Return the section with the new values of a change of it, if there is one."""
    return section.model_copy(update=change.model_dump(exclude_none=True) if change else {})


def changing(section: type[Section], keys: Iterable[str]) -> Callable[[type[_C]], type[_C]]:
    """Add these keys of a section to a class of changes, so that each key is declared only once.

    Types and bounds are those of the section; its validators are not inherited.
    """
    optional: dict[str, Any] = {}
    for key in keys:
        field = section.model_fields[key]
        # Annotated needs at least one annotation, so an empty one precedes the bounds.
        optional[key] = (Annotated[field.annotation, Field(), *field.metadata] | None, None)

    def with_keys(change: type[_C]) -> type[_C]:
        name, module, doc = change.__name__, change.__module__, change.__doc__
        return create_model(name, __base__=change, __module__=module, __doc__=doc, **optional)

    return with_keys


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


def _possible(value: Path) -> Path:
    if any(len(os.fsencode(name)) > _LONGEST_NAME for name in value.parts):
        raise ValueError(f"no file has a name of more than {_LONGEST_NAME} bytes")
    return value


def _ordered(value: tuple[float, float]) -> tuple[float, float]:
    if not value[0] < value[1]:
        raise ValueError("the lower value has to come first and lie below the upper one")
    return value


_T = TypeVar("_T")

#: An array, which TOML reads as a list, as an immutable tuple.
Array = Annotated[_T, BeforeValidator(_tuple)]
Names = Array[tuple[str, ...]]
FilePath = Annotated[Path, BeforeValidator(_path), AfterValidator(_possible)]
Number = Annotated[float, BeforeValidator(_float)]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]
#: Inertia, damping, spring [SI units], torque [N·m], duration [s]: more than any servo has, and few
#: enough digits for the arithmetic.
Inertia = Annotated[Positive, Field(ge=1e-9, le=1e6)]
Damping = Annotated[NonNegative, Field(le=1e3)]
Stiffness = Annotated[NonNegative, Field(le=1e6)]
Torque = Annotated[Positive, Field(ge=1e-6, le=1e6)]
Duration = Annotated[NonNegative, Field(le=3600.0)]
#: Two numbers, the lower one first.
Interval = Annotated[Array[tuple[Number, Number]], AfterValidator(_ordered)]
