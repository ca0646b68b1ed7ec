"""The laws by name: the one list that the loop, the workbench and the messages read.

A user's law is named by file and function, `my_law.py:my_law`. The function takes one record
(`interface.WALL`) and returns the force; if the file has a dictionary OPTIONS, its entries are
what `[wall.options]` may set, in the order in which the function finds them in `wall.options`.
"""

import importlib.util
import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

from numba import njit
from numba.core.errors import NumbaError

from canwall.errors import InputError
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
from canwall.walls.interface import MAX_OPTIONS, law

#: What is added to a law's name for its variant with deadbeat compensation.
DEADBEAT = "+deadbeat"


class UnknownLawError(InputError):
    """A law that is not there, does not compile, or does not have what was asked of it."""


@dataclass(frozen=True)
class Law:
    """A law, compiled: `address` is what compiled code calls it by."""

    name: str
    function: Any
    options: Mapping[str, float] = field(default_factory=dict)

    @property
    def address(self) -> int:
        """Address of the compiled function in this process."""
        return int(self.function.address)

    def option_values(self, given: Mapping[str, float]) -> list[float]:
        """All options in the law's order, `given` ones first. Raises UnknownLawError."""
        for name in given:
            if name not in self.options:
                known = ", ".join(self.options) or "none"
                raise UnknownLawError(f"law {self.name} has no option {name!r}; it has {known}")
        return [given.get(name, default) for name, default in self.options.items()]


def _of_module(module: ModuleType) -> list[Law]:
    """A module's law, named as the module, and its variant with deadbeat, if it has one."""
    name = module.__name__.rpartition(".")[2]
    options = getattr(module, "OPTIONS", {})
    laws = [Law(name, getattr(module, name), options)]
    with_deadbeat = getattr(module, f"{name}_deadbeat", None)
    if with_deadbeat is not None:
        laws.append(Law(name + DEADBEAT, with_deadbeat, options))
    return laws


#: Every law that comes with the project, in the order of theory.md.
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
    for found in _of_module(module)
}

_user_laws: dict[str, Law] = {}


def find_law(name: str, deadbeat: bool = False) -> Law:
    """The law of that name, or of that `file.py:function`. Raises UnknownLawError."""
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
    options = getattr(module, "OPTIONS", {})
    if not (
        isinstance(options, dict)
        and all(isinstance(n, str) and isinstance(v, int | float) for n, v in options.items())
    ):
        raise UnknownLawError(f"{where}: OPTIONS has to be a dictionary of names and numbers")
    if len(options) > MAX_OPTIONS:
        raise UnknownLawError(f"{where}: {len(options)} options; a law may have {MAX_OPTIONS}")
    try:
        return Law(where, law(_guarded(written), keep=False), options)
    except NumbaError as error:
        raise UnknownLawError(f"{where}: does not compile: {_gist(error)}") from None
    except Exception as error:  # numba lets what it trips over through
        raise UnknownLawError(f"{where}: {type(error).__name__}: {_gist(error)}") from None


def _guarded(written: FunctionType) -> Callable[[Any], float]:
    """A user's function whose exceptions become a force that is not a number, which ends the wall.

    Compiled code that is called by address can raise to nobody.
    """
    compiled = njit(error_model="python", boundscheck=True)(written)

    def guarded(wall: Any) -> float:
        try:
            return compiled(wall)
        except Exception:
            return math.nan

    return guarded


def _gist(error: BaseException) -> str:
    """The line of a message that says most: numba's first ones only name the pipeline."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    telling = [line for line in lines if not line.startswith(("Failed in", "File ", "During"))]
    return (telling or lines or ["no reason given"])[0]
