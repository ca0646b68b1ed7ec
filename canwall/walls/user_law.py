"""A user's law: a function in a file, `my_law.py:my_law`, or one declared in a running program.

The function takes one record (`interface.WALL`) and returns the force. Options, which
`[wall.options]` may set, are the dictionary OPTIONS of the file, or given with the declaration;
the function reads them by name: `wall.options.growth`.
"""

import dis
import importlib.machinery
import importlib.util
import inspect
import keyword
import math
import os
import re
import sys
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import numpy as np
from numba import from_dtype, njit, types
from numba.core import cgutils, ir
from numba.core.dispatcher import Dispatcher
from numba.core.errors import NumbaError
from numba.extending import intrinsic
from numpy.typing import NDArray

from canwall.errors import did_you_mean
from canwall.walls.interface import MAX_OPTIONS, WALL, Law, UnknownLawError, wall_with


class _Source(importlib.machinery.SourceFileLoader):
    """Loader of a file as it is now.

    Bytecode that Python kept beside it may be that of a file that was changed within a second.
    """

    def get_code(self, fullname: str) -> CodeType:
        return self.source_to_code(self.get_data(self.path), self.path)


def load_law(path: Path, function: str) -> Law:
    """Return the law of a function in a file, compiled. Raises UnknownLawError."""
    where = f"{path}:{function}"
    if not os.path.isfile(path):  # Path.is_file raises for names that are too long
        raise UnknownLawError(f"{where}: no such file")
    loader = _Source(path.stem, str(path)) if path.suffix == ".py" else None
    spec = importlib.util.spec_from_file_location(path.stem, path, loader=loader)
    if spec is None or spec.loader is None:
        raise UnknownLawError(f"{where}: not a Python file")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # whatever the user's file does when it is run
        lines = [
            f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == spec.origin
        ]
        line = f"line {lines[-1]}: " if lines else ""  # a SyntaxError's is in its text
        beside = isinstance(error, ModuleNotFoundError) and _is_beside(path, error.name)
        remedy = "; a law is one file: write into it what it needs" if beside else ""
        raise UnknownLawError(
            f"{where}: {line}{type(error).__name__}: {_gist(error)}{remedy}"
        ) from None
    written = getattr(module, function, None)
    if isinstance(written, Law):
        raise UnknownLawError(
            f"{where}: in a file the function stands without @canwall.law; options are the "
            "dictionary OPTIONS beside it"
        )
    if isinstance(written, Dispatcher):
        raise UnknownLawError(f"{where}: stands without numba's decorator; canwall compiles it")
    if not isinstance(written, FunctionType):
        raise UnknownLawError(f"{where}: the file has no such function")
    return make_law(where, written, getattr(module, "OPTIONS", {}))


def _is_beside(path: Path, module: str | None) -> bool:
    """Return True for a module that stands in the folder of a law's file."""
    beside = path.parent / (module or "").partition(".")[0]
    return bool(module) and (beside.is_dir() or beside.with_suffix(".py").is_file())


def make_law(name: str, written: FunctionType, options: object) -> Law:
    """Return a function as a law, compiled and checked.

    Args:
        name: Name of the law, which the messages begin with.
        written: The function; it may stand anywhere, in a notebook as well.
        options: Names and defaults of its options.

    Raises:
        UnknownLawError: If the function is no law, or does not compile.
    """
    arguments = len(inspect.signature(written).parameters)
    if arguments != 1:
        raise UnknownLawError(f"{name}: takes {arguments} arguments; a law takes one, the wall")
    declared = _declared_options(name, options)
    guarded = _Guarded(written, declared)
    law = Law(name, guarded.function, declared, cached=False, failure=guarded.failure)
    try:
        _check_types(guarded.compile())
        law.compile()
    except UnsuitableLawError as error:
        raise UnknownLawError(f"{name}: {error}") from None
    except NumbaError as error:
        line = _line_in(Path(written.__code__.co_filename), str(error))
        raise UnknownLawError(f"{name}: {line}does not compile: {_gist(error)}") from None
    except KeyError as error:  # numba's, for a field that a record does not have
        field = str(error.args[0])
        line = _line_of_field(written, field)
        raise UnknownLawError(f"{name}: {line}{_unknown_field(field, declared)}") from None
    except Exception as error:  # numba lets what it trips over through
        raise UnknownLawError(f"{name}: {type(error).__name__}: {_gist(error)}") from None
    return law


class UnsuitableLawError(Exception):
    """A function that compiles, but is no law."""


def _declared_options(law: str, options: object) -> Mapping[str, float]:
    if not isinstance(options, dict) or not all(isinstance(name, str) for name in options):
        raise UnknownLawError(f"{law}: OPTIONS has to be a dictionary of names and numbers")
    for name, value in options.items():
        number = value.item() if isinstance(value, np.generic) else value
        if not isinstance(number, int | float) or not abs(number) <= sys.float_info.max:
            raise UnknownLawError(f"{law}: OPTIONS: {name} has to be a finite number")
    for name in options:
        if not name.isidentifier() or keyword.iskeyword(name):
            raise UnknownLawError(
                f"{law}: OPTIONS: {name!r} cannot be read as wall.options.{name}; rename it"
            )
    if len(options) > MAX_OPTIONS:
        raise UnknownLawError(f"{law}: {len(options)} options; a law may have up to {MAX_OPTIONS}")
    return {name: float(value) for name, value in options.items()}


def _unknown_field(name: str, options: Mapping[str, float]) -> str:
    if name == "options":
        return "uses wall.options, but declares no OPTIONS"
    fields = [f for f in wall_with(options).names or () if f not in ("option_values", "options")]
    hint = did_you_mean(name, [*fields, *options])
    declared = f"; options: {', '.join(options)}" if options else ""
    return (
        f"uses {name}, which is neither a field of the wall nor an option{hint} "
        f"(fields: {', '.join(fields)}{declared})"
    )


def _line_of_field(law: FunctionType, name: str) -> str:
    """Return where a law, or a function beside it, uses an attribute first, to begin a message."""
    beside = [f for f in law.__globals__.values() if isinstance(f, FunctionType | Dispatcher)]
    written = [inspect.unwrap(function) for function in (law, *beside)]
    codes = [f.__code__ for f in written if isinstance(f, FunctionType)]
    lines = [
        instruction.positions.lineno
        for code in codes
        if code.co_filename == law.__code__.co_filename
        for instruction in dis.get_instructions(code)
        if instruction.argval == name and instruction.positions is not None
    ]
    known = [line for line in lines if line is not None]
    return f"line {min(known)}: " if known else ""


def _line_in(path: Path, message: str) -> str:
    """Return the line of a file that a message of numba's names, as the beginning of a message."""
    named = re.findall(rf'File ".*?{re.escape(path.name)}", line (\d+)', message)
    # A message about several returns names all of them; what is no number is wrong.
    returned = re.findall(r"type '([^']*)', location:[^,]*?, line (\d+)", message)
    wrong = [line for kind, line in returned if not kind.startswith(("float", "int", "uint"))]
    line = (wrong or named[-1:])[:1]
    return f"line {line[0]}: " if line else ""


def _check_types(compiled: Any) -> None:
    """Raise UnsuitableLawError for a value that is no force, or an option read by its position."""
    annotation = compiled.type_annotation
    blocks = annotation.blocks.values()
    returning = [block for block in blocks if isinstance(block.terminator, ir.Return)]
    if not returning:
        raise UnsuitableLawError("returns on no way through it; a law returns a number")
    for block in returning:
        kind = _returned_type(block, block.terminator, annotation.typemap)
        if not isinstance(kind, types.Number | types.Boolean) or kind in types.complex_domain:
            raise UnsuitableLawError(
                f"line {block.terminator.loc.line}: returns {_shown_type(kind)}; a law returns a "
                f"number, on every way through it"
            )
    functions = _with_callees(annotation)
    for function in functions:
        _refuse_positions(function)
    for function in functions:
        _refuse_changes(function)


def _returned_type(block: Any, returned: Any, typemap: Mapping[str, Any]) -> Any:
    """Return the type of a returned value before its cast to the common type of all returns."""
    for assignment in block.find_insts(ir.Assign):
        value = assignment.value
        if (
            assignment.target.name == returned.value.name
            and isinstance(value, ir.Expr)
            and value.op == "cast"
        ):
            return types.unliteral(typemap[value.value.name])
    return types.unliteral(typemap[returned.value.name])


def _shown_type(kind: Any) -> str:
    if kind == types.none:
        return "None"
    return "a string" if kind == types.unicode_type else str(kind)


def _with_callees(annotation: Any) -> list[Any]:
    """Return a function and the functions that it calls, as far as they were compiled here."""
    found = [annotation]
    for function in found:  # which grows meanwhile
        for kind in function.typemap.values():
            if isinstance(kind, types.Dispatcher):
                called = [c.type_annotation for c in kind.dispatcher.overloads.values()]
                # What was loaded from disk has no blocks.
                found += [c for c in called if hasattr(c, "blocks") and c not in found]
    return found


def _refuse_positions(annotation: Any) -> None:
    """Refuse `wall.options[0]`.

    The order of the options is that of their declaration, which nothing else depends on.
    """
    typemap = annotation.typemap
    for block in annotation.blocks.values():
        accesses = [
            *block.find_exprs("static_getitem"),
            *block.find_exprs("getitem"),
            *block.find_insts(ir.StaticSetItem | ir.SetItem),
        ]
        for access in accesses:
            owner = access.target if isinstance(access, ir.Stmt) else access.value
            named = isinstance(getattr(access, "index", None), str)
            if isinstance(typemap[owner.name], types.Record) and not named:
                raise UnsuitableLawError(
                    f"line {access.loc.line}: uses a field by its position; use its name, "
                    f"wall.options.NAME"
                )


def _refuse_changes(annotation: Any) -> None:
    """Refuse `wall.period = 1.0`, which would stay, and hold for the laws after it as well."""
    for block in annotation.blocks.values():
        changes = [
            *block.find_insts(ir.SetAttr | ir.StaticSetItem | ir.SetItem),
            *block.find_exprs("inplace_binop"),
        ]
        for change in changes:
            if field := _changed_field(annotation, change):
                raise UnsuitableLawError(
                    f"line {change.loc.line}: changes {field}; a law reads the wall, and "
                    f"keeps numbers of its own in wall.memory"
                )


#: Arrays of the wall that a law only reads, by type: `memory` and `plan` have others.
_READ_ONLY = {from_dtype(WALL).fields[name].type: name for name in ("phi", "gamma", "referent")}
#: Expressions whose value is a part of another one, or the same.
_PARTS = ("getattr", "getitem", "static_getitem", "getiter", "iternext", "pair_first", "cast")


def _changed_field(annotation: Any, change: Any) -> str:
    """Return the field of the wall that an instruction changes and must not; empty if none.

    What is changed may be a part of the field, as in `wall.phi[0][1] = 5.0`.
    """
    typemap = annotation.typemap
    target = change.lhs if isinstance(change, ir.Expr) else change.target
    if isinstance(typemap[target.name], types.Record):
        return str(change.attr if isinstance(change, ir.SetAttr) else change.index)
    if not isinstance(typemap[target.name], types.Array):
        return ""  # a number that was read, as in `y += 1.0`
    values = {
        assignment.target.name: assignment.value
        for block in annotation.blocks.values()
        for assignment in block.find_insts(ir.Assign)
    }
    while isinstance(target, ir.Var):
        if field := _READ_ONLY.get(typemap[target.name]):
            return field
        value = values.pop(target.name, None)
        is_part = isinstance(value, ir.Expr) and value.op in _PARTS
        target = value.value if is_part else value
    return ""


class _Guarded:
    """A user's function whose exceptions become a NaN force, on which the run trips.

    Code that is called by address has no caller to raise to. The wall of each call is kept, so that
    the one that raised can be repeated from Python.
    """

    def __init__(self, written: FunctionType, options: Mapping[str, float]) -> None:
        self._written = written
        self._compiled = njit(error_model="python", boundscheck=True)(written)
        self._kept = np.zeros(1, wall_with(options))

    def compile(self) -> Any:
        """Compile the function itself; return numba's result."""
        signature = (from_dtype(self._kept.dtype),)
        self._compiled.compile(signature)
        return self._compiled.overloads[signature]

    @property
    def function(self) -> Callable[[Any], float]:
        """The function to be called in its place, not yet compiled."""
        compiled, kept = self._compiled, self._kept.ctypes.data

        def guarded(wall: Any) -> float:
            _keep(wall, kept)
            try:
                return compiled(wall)
            except Exception:
                return math.nan

        return guarded

    def failure(self, wall: NDArray[np.void] | None = None) -> str:
        """Return type, message and line of what a call raises, see `Law`; empty if it does not."""
        kept = self._kept if wall is None else np.ascontiguousarray(wall).view(self._kept.dtype)
        try:
            self._compiled(kept.copy()[0])
        except Exception as error:
            return f"{type(error).__name__}: {_gist(error)}{self._place(error, kept)}"
        return ""

    def _place(self, error: Exception, kept: NDArray[np.void]) -> str:
        """Return file and line of an exception, as the end of a message.

        Compiled code knows them for a `raise`; for the others the function is interpreted.
        """
        interpreted: Exception | None = None
        try:
            with np.errstate(all="raise"):
                self._written(kept.copy().view(np.recarray)[0])
        except Exception as repeated:
            interpreted = repeated
        for candidate in (error, interpreted):
            frames = traceback.extract_tb(candidate.__traceback__) if candidate else []
            places = [f for f in frames if f.filename == self._written.__code__.co_filename]
            if places:
                file, line = Path(places[-1].filename), places[-1].lineno
                # The file of a notebook's cell has a name that nobody has given it.
                return f" ({file.name}, line {line})" if file.exists() else f" (line {line})"
        return ""


@intrinsic
def _keep(typingctx: Any, wall: Any, address: Any) -> Any:
    """Copy a record to an address."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = builder.inttoptr(args[1], args[0].type)
        size = context.get_constant(types.intp, wall.size)
        cgutils.raw_memcpy(builder, place, args[0], size, 1)
        return context.get_dummy_value()

    return types.void(wall, types.uint64), codegen


def _gist(error: BaseException) -> str:
    """Return the line of a message that says most: numba's first ones only name the pipeline."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    telling = [line for line in lines if not line.startswith(("Failed in", "File ", "During"))]
    return (telling or lines or ["no reason given"])[0]
