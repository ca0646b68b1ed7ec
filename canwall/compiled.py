"""How this project compiles: one decorator, and one name for a record in compiled code."""

import contextlib
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeAlias, TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

_P = ParamSpec("_P")
_R = TypeVar("_R")

#: One element of a structured array, e.g. `walls[0]`. In compiled code its fields are attributes
#: and can be written; Python's type checkers know of no such thing, so it is Any to them.
Record: TypeAlias = Any


#: Rooms without anything that compiled code elsewhere calls, lays out or has as a constant.
_WITHOUT_COMPILED_CODE = ("bench", "cli", "config", "study", "sweep", "workbench")


def _drop_stale_code() -> None:
    """Remove compiled code that was kept on disk before a source that it may depend on changed.

    numba sees a change of the file that a function stands in, not of those that it calls into: a
    law would go on using the estimator of the day on which it was compiled.
    """
    package = Path(__file__).resolve().parent
    sources = sorted(
        path
        for path in package.rglob("*.py")
        if path.relative_to(package).parts[0] not in _WITHOUT_COMPILED_CODE
    )
    states = [(str(s.relative_to(package)), s.stat().st_mtime_ns) for s in sources]
    digest = hashlib.sha256(repr(states).encode()).hexdigest()
    note = package / "__pycache__" / "sources.sha256"
    with contextlib.suppress(OSError):  # an installation that may not be written keeps no code
        if note.exists() and note.read_text() == digest:
            return
        for kept in (*package.rglob("*.nbi"), *package.rglob("*.nbc")):
            kept.unlink(missing_ok=True)
        note.parent.mkdir(exist_ok=True)
        note.write_text(digest)


_drop_stale_code()


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile with numba: kept on disk, free of the interpreter lock, division as in IEEE 754."""
    result: Callable[_P, _R] = njit(cache=True, nogil=True, error_model="numpy")(function)
    return result


def copied(record: NDArray[np.void]) -> NDArray[np.void]:
    """A copy of a contiguous record, as bytes: numpy goes field by field, and keeps the lock."""
    return record.view(np.uint8).copy().view(record.dtype)


def fields(record: NDArray[np.void]) -> Record:
    """Return the element of a record of shape (1,), its fields as attributes in Python as well.

    They are the record's own memory, read and written at a tenth of what numpy takes.
    """
    structure: Any = np.ctypeslib.as_ctypes_type(record.dtype)  # type: ignore[arg-type]
    return structure.from_buffer(record)


def data_to_number(data: bytes | bytearray) -> int:
    """Data of a CAN frame as the 64-bit number that compiled code works on.

    Little-endian, missing bytes zero; signed, because that is what a Python int becomes there.
    """
    return int.from_bytes(data.ljust(8, b"\0"), "little", signed=True)


def number_to_data(number: int, length: int) -> bytes:
    """The first `length` bytes that such a number stands for."""
    return number.to_bytes(8, "little", signed=True)[:length]
