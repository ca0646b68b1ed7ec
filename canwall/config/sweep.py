"""`[sweep]`: the axes of a sweep."""

from canwall.config.section import Array

#: One value on an axis.
Value = str | int | float | bool
#: Values of an axis: an array, a single value, or a range as text, "LO:HI:N".
AxisValues = Array[tuple[Value, ...] | Value]
