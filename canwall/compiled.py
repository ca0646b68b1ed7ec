"""Compilation with numba: one decorator, and one type for records in compiled code."""

import contextlib
import functools
import hashlib
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

_P = ParamSpec("_P")
_R = TypeVar("_R")

#: One element of a structured array, e.g. `walls[0]`. In compiled code its fields are attributes
#: and can be written; Python's type checkers know of no such thing, so it is Any to them.
Record: TypeAlias = Any


#: Rooms without anything that compiled code elsewhere calls, lays out or has as a constant.
_WITHOUT_COMPILED_CODE = ("bench", "cli", "config", "study", "sweep", "workbench")


def _drop_stale_code() -> bool:
    """Remove compiled code that was kept on disk before a source that it may depend on changed.

    Returns True if there is none of today's sources: this is a first start.

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
            return False
        for kept in (*package.rglob("*.nbi"), *package.rglob("*.nbc")):
            kept.unlink(missing_ok=True)
        note.parent.mkdir(exist_ok=True)
        note.write_text(digest)
        return True
    return False


_first_start = _drop_stale_code()


class _Compiling:
    """The work of compiling in this process, and whom to tell when it gets long."""

    #: Seconds of compiling that go without a word.
    SILENT_S = 1.0

    def __init__(self) -> None:
        self.tell: Callable[[], None] | None = None
        self._last_s = -math.inf
        self._spent_s = 0.0

    def note_miss(self) -> None:
        """Note that a function is compiled now; a long first start has one after the other."""
        now_s = time.monotonic()
        self._spent_s += min(now_s - self._last_s, 0.3)
        self._last_s = now_s
        if self.tell is not None and self._spent_s > self.SILENT_S:
            tell, self.tell = self.tell, None
            tell()


_compiling = _Compiling()


def announce_compiling(tell: Callable[[], None]) -> None:
    """Have `tell` called, once, when what this process compiles takes more than a moment."""
    _compiling.tell = tell


_beside: list[subprocess.Popen[bytes]] = []


def compile_beside(module: str, function: str) -> None:
    """Let another process compile, at a first start, by calling the function of that module.

    Nobody waits for it: what it has on disk in time is loaded, the rest is compiled here too.
    """
    if _first_start and not _beside and (os.cpu_count() or 1) > 1:
        nowhere = subprocess.DEVNULL
        program = f"from {module} import {function}; {function}()"
        arguments = [sys.executable, "-P", "-c", program]
        _beside.append(subprocess.Popen(arguments, stdin=nowhere, stdout=nowhere, stderr=nowhere))


@functools.cache
def _code_on_disk() -> Any:
    """Numba's cache of machine code, which loads it without getting ready to compile.

    numba fills its registries (and imports scipy.linalg for them) before it looks into the cache.
    Loading needs none of that but the symbols of its runtime, and numba does it by itself before
    it compiles: it is half of what a program with everything in the cache would wait for.
    """
    from numba.core.caching import FunctionCache
    from numba.core.runtime import rtsys

    class CodeOnDisk(FunctionCache):  # type: ignore[misc]
        def __init__(self, function: Callable[..., Any], use: str) -> None:
            super().__init__(function)
            self._use = use

        def load_overload(self, sig: Any, target_context: Any) -> Any:
            rtsys.initialize(target_context)
            with self._guard_against_spurious_io_errors():
                code = self._load_overload(sig, target_context)
            if code is None:
                _compiling.note_miss()
            return code

        def _index_key(self, sig: Any, codegen: Any) -> Any:
            return (*super()._index_key(sig, codegen), self._use)

    return CodeOnDisk


class _Compiled:
    """A function that is compiled when it is first called, by Python or by compiled code.

    numba takes long to import; whoever merely imports a module with such a function in it does
    not wait for that. For compiled code it is compiled apart, without what Python calls it by,
    and once for all constants that it is called with: either saves a fifth of a first start.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        functools.update_wrapper(self, function)
        self._function = function

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._for_python(*args, **kwargs)

    def compile(self, *examples: Any) -> None:
        """Compile for a call with arguments of the types of these, without calling."""
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
        dispatcher._cache = _code_on_disk()(self._function, caller)
        return dispatcher


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile with numba: kept on disk, free of the interpreter lock, division as in IEEE 754."""
    result: Any = _Compiled(function)
    return result


def compiled_for_c(function: Callable[..., Any], signature: Any, kept: bool = True) -> Any:
    """Compile a function that others call by its address, e.g. compiled code from a record.

    `signature` is numba's. `kept` keeps the code on disk, for functions of this package only: of
    others nobody sees when what they call changes. Returns numba's CFunc, with `address`, which
    the code lives as long as. Raises numba's NumbaError where it does not compile.
    """
    from numba.core.ccallback import CFunc
    from numba.core.sigutils import normalize_signature

    result: Any = CFunc(function, normalize_signature(signature), {}, {"error_model": "numpy"})
    if kept:
        result._cache = _code_on_disk()(function, "C")
    result.compile()
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
