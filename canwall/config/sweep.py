"""`[sweep]`: the axes of a sweep."""

from typing import Annotated

from pydantic import BeforeValidator

#: One value on an axis.
Value = str | int | float | bool


def _values(given: object) -> object:
    return tuple(given) if isinstance(given, list) else given


#: The values of an axis: an array, one value, or a range as text, "LO:HI:N".
AxisValues = Annotated[tuple[Value, ...] | Value, BeforeValidator(_values)]
