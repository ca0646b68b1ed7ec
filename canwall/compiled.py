"""How this project compiles: one decorator, and one name for a record in compiled code."""

from collections.abc import Callable
from typing import Any, ParamSpec, TypeAlias, TypeVar

from numba import njit

_P = ParamSpec("_P")
_R = TypeVar("_R")

#: One element of a structured array, e.g. `walls[0]`. In compiled code its fields are attributes
#: and can be written; Python's type checkers know of no such thing, so it is Any to them.
Record: TypeAlias = Any


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile with numba: kept on disk, free of the interpreter lock, division as in IEEE 754."""
    result: Callable[_P, _R] = njit(cache=True, nogil=True, error_model="numpy")(function)
    return result
