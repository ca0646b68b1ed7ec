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


def data_to_number(data: bytes | bytearray) -> int:
    """Data of a CAN frame as the 64-bit number that compiled code works on.

    Little-endian, missing bytes zero; signed, because that is what a Python int becomes there.
    """
    return int.from_bytes(data.ljust(8, b"\0"), "little", signed=True)


def number_to_data(number: int, length: int) -> bytes:
    """The first `length` bytes that such a number stands for."""
    return number.to_bytes(8, "little", signed=True)[:length]
