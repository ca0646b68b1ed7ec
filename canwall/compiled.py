"""Compilation with numba: one decorator, and one type for records in compiled code."""

import functools
import inspect
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any, ParamSpec, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from canwall.code_on_disk import cache_class, is_first_start, is_ours

_P = ParamSpec("_P")
_R = TypeVar("_R")

#: One element of a structured array, e.g. `walls[0]`. In compiled code its fields are writable
#: attributes, which Python's type system cannot express; hence Any.
Record: TypeAlias = Any


class _Compiling:
    """Compilation in this process, and the announcement of a long one."""

    #: Processor time of compiling that is not announced [s].
    SILENT_S = 3.0

    def __init__(self) -> None:
        self.tell: Callable[[], None] | None = None
        self._last_s = -math.inf
        self._spent_s = 0.0

    def note_miss(self) -> None:
        """Note that a function is being compiled; a long first start compiles many in a row."""
        now_s = time.process_time()
        self._spent_s += min(now_s - self._last_s, 0.3)
        self._last_s = now_s
        if self.tell is not None and self._spent_s > self.SILENT_S:
            tell, self.tell = self.tell, None
            tell()


_compiling = _Compiling()


def announce_compiling(tell: Callable[[], None]) -> None:
    """Have `tell` called once if compilation in this process takes more than a moment."""
    _compiling.tell = tell


_beside: list[subprocess.Popen[bytes]] = []


def compile_beside(module: str, function: str) -> None:
    """At a first start, compile in another process by calling this function of this module there.

    Nothing waits for that process: code that it has cached in time is loaded, and the rest is
    compiled here as well.
    """
    if is_first_start() and not _beside and (os.cpu_count() or 1) > 1:
        nowhere = subprocess.DEVNULL
        program = f"from {module} import {function}; {function}()"
        arguments = [sys.executable, "-P", "-c", program]
        _beside.append(subprocess.Popen(arguments, stdin=nowhere, stdout=nowhere, stderr=nowhere))


class _Compiled:
    """A function that is compiled at its first call, from Python or from compiled code.

    numba takes long to import; merely importing a module with such a function does not wait for
    it. For compiled callers the function is compiled separately, without the wrapper for Python,
    and once for all constant arguments: each saves a fifth of a first start.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        functools.update_wrapper(self, function)
        self._function = function

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._for_python(*args, **kwargs)

    def compile(self, *examples: Any) -> None:
        """Compile for arguments of the types of `examples`, without a call."""
        from numba import typeof

        self._for_python.compile(tuple(typeof(example) for example in examples))

    @property
    def _numba_type_(self) -> Any:
        """Numba's type of the function, where compiled code calls it."""
        return self._for_compiled_code._numba_type_

    @functools.cached_property
    def _for_python(self) -> Any:
        return self._dispatcher("Python")

    @functools.cached_property
    def _for_compiled_code(self) -> Any:
        from numba.types import unliteral

        dispatcher = self._dispatcher(
            "compiled code", no_cpython_wrapper=True, no_cfunc_wrapper=True
        )
        template = dispatcher.get_call_template

        def template_of_any_value(args: Any, kws: Any) -> Any:
            return template(
                tuple(unliteral(a) for a in args), {name: unliteral(a) for name, a in kws.items()}
            )

        dispatcher.get_call_template = template_of_any_value
        return dispatcher

    def _dispatcher(self, caller: str, **options: bool) -> Any:
        from numba import njit

        dispatcher = njit(nogil=True, error_model="numpy", **options)(self._function)
        if is_ours(self._function):
            dispatcher._cache = cache_class()(self._function, caller, _compiling.note_miss)
        return dispatcher


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile with numba: without the interpreter lock, with IEEE 754 division.

    The code of this package's functions is cached on disk. Nothing tracks changes of what other
    functions call.
    """
    result: Any = _Compiled(function)
    return result


def compiled_for_c(function: Callable[..., Any], signature: Any, kept: bool = True) -> Any:
    """Compile a function to be called by its address, e.g. from a record by compiled code.

    Args:
        function: The function; it may be one that is `compiled` for other callers as well.
        signature: Its signature, as numba's.
        kept: Cache the code on disk, for functions that call nothing but this package.

    Returns:
        numba's CFunc, with `address`; the code lives as long as this object.

    Raises:
        NumbaError: If the function does not compile.
    """
    from numba.core.ccallback import CFunc
    from numba.core.sigutils import normalize_signature

    function = inspect.unwrap(function)
    result: Any = CFunc(function, normalize_signature(signature), {}, {"error_model": "numpy"})
    if kept and is_ours(function):
        result._cache = cache_class()(function, "C", _compiling.note_miss)
    result.compile()
    return result


def copied(record: NDArray[np.void]) -> NDArray[np.void]:
    """Return a copy of a contiguous record, copied as bytes.

    NumPy would copy field by field and hold the interpreter lock.
    """
    return record.view(np.uint8).copy().view(record.dtype)


def fields(record: NDArray[np.void]) -> Record:
    """Return the element of a record of shape (1,), with its fields as attributes in Python too.

    The attributes access the record's own memory, in a tenth of the time that NumPy takes.
    """
    structure: Any = np.ctypeslib.as_ctypes_type(record.dtype)  # type: ignore[arg-type]
    return structure.from_buffer(record)


def data_to_number(data: bytes | bytearray) -> int:
    """Return the data of a CAN frame as the 64-bit number that compiled code works on.

    The number is little-endian with missing bytes zero, and signed, as a Python int is in compiled
    code.
    """
    return int.from_bytes(data.ljust(8, b"\0"), "little", signed=True)


def number_to_data(number: int, length: int) -> bytes:
    """Return the first `length` bytes of the data that such a number stands for."""
    return number.to_bytes(8, "little", signed=True)[:length]
