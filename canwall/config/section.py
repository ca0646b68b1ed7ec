"""The base of every section of a configuration: strict, frozen, its numbers finite."""

import math
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, create_model


class Section(BaseModel):
    """One table of the file."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


class Change(Section):
    """New values for some keys of a section; None leaves a key as it is."""

    if TYPE_CHECKING:
        # `changing` adds the keys when the program runs: a type checker does not see them.
        def __getattr__(self, key: str) -> Any: ...


_C = TypeVar("_C", bound=Change)


def changing(section: type[Section], keys: Iterable[str]) -> Callable[[type[_C]], type[_C]]:
    """Give a class of changes these keys of a section, so that each is declared once, there.

    Types and bounds are those of the section; its own validators do not come with them.
    """
    optional: dict[str, Any] = {}
    for key in keys:
        field = section.model_fields[key]
        # Annotated wants one annotation at least: an empty one stands before the bounds.
        optional[key] = (Annotated[field.annotation, Field(), *field.metadata] | None, None)

    def with_keys(change: type[_C]) -> type[_C]:
        name, module, doc = change.__name__, change.__module__, change.__doc__
        return create_model(name, __base__=change, __module__=module, __doc__=doc, **optional)

    return with_keys


# TOML writes a whole number without a point: `cycle_s = 1` is meant as 1.0.
def _number(value: object) -> object:
    if isinstance(value, bool) or not isinstance(value, int):
        return value
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _array(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


Names = Annotated[tuple[str, ...], BeforeValidator(_array)]
Number = Annotated[float, BeforeValidator(_number)]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]
