"""The laws by name: the one list that the loop, the workbench and the messages read.

A user's law is named by file and function, `my_law.py:my_law`. The function takes one record
(`interface.WALL`) and returns the force. If the file has a dictionary OPTIONS, `[wall.options]`
may set its entries, and the function reads them by name: `wall.options.growth`.
"""

import difflib
import importlib.util
import inspect
import keyword
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FunctionType
from typing import Any

from numba import njit
from numba.core.errors import NumbaError

from canwall.walls import (
    damped,
    exponential,
    half_sample,
    hysteresis,
    mean_force,
    midpoint,
    offset_damper,
    pole_placement,
    push_only,
    rigid,
    standard,
    thresholded_damper,
    two_step,
    unidirectional_damper,
)
from canwall.walls.interface import DEADBEAT, MAX_OPTIONS, Law, UnknownLawError, wall_with

#: Every law that comes with the project, by name.
LAWS: dict[str, Law] = {
    found.name: found
    for module in (
        standard,
        damped,
        hysteresis,
        exponential,
        thresholded_damper,
        unidirectional_damper,
        offset_damper,
        half_sample,
        pole_placement,
        midpoint,
        two_step,
        mean_force,
        push_only,
        rigid,
    )
    for found in vars(module).values()
    if isinstance(found, Law)
}

_user_laws: dict[str, Law] = {}


def find_law(name: str, deadbeat: bool = False) -> Law:
    """Return the law of that name, or of that `file.py:function`. Raises UnknownLawError."""
    if deadbeat:
        name += DEADBEAT
    if name in LAWS:
        return LAWS[name]
    if deadbeat and name.removesuffix(DEADBEAT) in LAWS:
        able = ", ".join(n.removesuffix(DEADBEAT) for n in LAWS if n.endswith(DEADBEAT))
        raise UnknownLawError(
            f"law {name.removesuffix(DEADBEAT)} has no deadbeat compensation; {able} have"
        )
    path, colon, function = name.rpartition(":")
    if not colon:
        raise UnknownLawError(
            f"unknown law {name!r}; known are {', '.join(LAWS)}, or file.py:function"
        )
    if name not in _user_laws:
        _user_laws[name] = _load(Path(path), function)
    return _user_laws[name]


def _load(path: Path, function: str) -> Law:
    where = f"{path}:{function}"
    if not path.is_file():
        raise UnknownLawError(f"{where}: no such file")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise UnknownLawError(f"{where}: not a Python file")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # whatever the user's file does when it is run
        raise UnknownLawError(f"{where}: {type(error).__name__}: {_gist(error)}") from None
    written = getattr(module, function, None)
    if not isinstance(written, FunctionType):
        raise UnknownLawError(f"{where}: the file has no such function")
    arguments = len(inspect.signature(written).parameters)
    if arguments != 1:
        raise UnknownLawError(f"{where}: takes {arguments} arguments; a law takes one, the wall")
    options = _declared_options(where, getattr(module, "OPTIONS", {}))
    law = Law(where, _guarded(written), options, cached=False)
    try:
        law.compile()
    except NumbaError as error:
        raise UnknownLawError(f"{where}: does not compile: {_gist(error)}") from None
    except KeyError as error:  # numba's, for a field that a record does not have
        raise UnknownLawError(f"{where}: {_unknown_field(str(error.args[0]), options)}") from None
    except Exception as error:  # numba lets what it trips over through
        raise UnknownLawError(f"{where}: {type(error).__name__}: {_gist(error)}") from None
    return law


def _declared_options(where: str, options: object) -> Mapping[str, float]:
    if not (
        isinstance(options, dict)
        and all(isinstance(n, str) and isinstance(v, int | float) for n, v in options.items())
    ):
        raise UnknownLawError(f"{where}: OPTIONS has to be a dictionary of names and numbers")
    for name in options:
        if not name.isidentifier() or keyword.iskeyword(name):
            raise UnknownLawError(
                f"{where}: OPTIONS: {name!r} cannot be read as wall.options.{name}; rename it"
            )
    if len(options) > MAX_OPTIONS:
        raise UnknownLawError(
            f"{where}: {len(options)} options; a law may have up to {MAX_OPTIONS}"
        )
    return options


def _unknown_field(name: str, options: Mapping[str, float]) -> str:
    if name == "options":
        return "reads wall.options, but its file declares no OPTIONS"
    known = [*(wall_with(options).names or ()), *options]
    close = difflib.get_close_matches(name, known, n=1)
    hint = f"; did you mean {close[0]}?" if close else ""
    return f"reads {name}, which is neither a field of the wall nor an option{hint}"


def _guarded(written: FunctionType) -> Callable[[Any], float]:
    """Wrap a user's function so that an exception becomes a NaN force, on which the run trips.

    Code that is called by address has no caller to raise to.
    """
    compiled = njit(error_model="python", boundscheck=True)(written)

    def guarded(wall: Any) -> float:
        try:
            return compiled(wall)
        except Exception:
            return math.nan

    return guarded


def _gist(error: BaseException) -> str:
    """Return the line of a message that says most: numba's first ones only name the pipeline."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    telling = [line for line in lines if not line.startswith(("Failed in", "File ", "During"))]
    return (telling or lines or ["no reason given"])[0]
