"""The laws by name: the one list that the loop, the workbench and the messages read."""

from collections.abc import Mapping
from pathlib import Path
from types import FunctionType

from canwall.errors import did_you_mean
from canwall.walls import (
    damped,
    energy_bounding,
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
    virtual_coupling,
)
from canwall.walls.interface import DEADBEAT, Law, UnknownLawError
from canwall.walls.user_law import load_law, make_law

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
        energy_bounding,
        virtual_coupling,
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

#: Laws of the user, by `file.py:function`, or by the name of a function declared as a law.
_user_laws: dict[str, Law] = {}


def declare_law(function: FunctionType, options: Mapping[str, float]) -> Law:
    """Declare a function of the running program as a law; it is known by the function's name.

    One declared before by the same name is replaced, as when a cell of a notebook is executed
    again.

    Raises:
        UnknownLawError: If the function is no law, or a law of the project has its name.
    """
    name = function.__name__
    if name in LAWS:
        raise UnknownLawError(f"{name}: a law of the project has this name; choose another")
    _user_laws[name] = make_law(name, function, dict(options))
    return _user_laws[name]


def is_declared(name: str) -> bool:
    """Return True for a law that exists in this process alone."""
    return name in _user_laws and ":" not in name


def law_name(law: str, deadbeat: bool) -> str:
    """Return the name of a law, with `+deadbeat` for the compensation."""
    return law + DEADBEAT if deadbeat and not law.endswith(DEADBEAT) else law


def find_law(name: str, deadbeat: bool = False) -> Law:
    """Return the law of that name, declared or of that `file.py:function`.

    Raises UnknownLawError.
    """
    name = law_name(name, deadbeat)
    if name in LAWS:
        return LAWS[name]
    bare = name.removesuffix(DEADBEAT)
    if deadbeat and (bare in LAWS or bare in _user_laws or ":" in bare):
        able = ", ".join(n.removesuffix(DEADBEAT) for n in LAWS if n.endswith(DEADBEAT))
        raise UnknownLawError(f"law {bare} has no deadbeat compensation; {able} have")
    if name in _user_laws:
        return _user_laws[name]
    path, colon, function = name.rpartition(":")
    if not colon:
        raise UnknownLawError(
            f"unknown law {name!r}"
            + (_meant(name) or f"; known are {', '.join(LAWS)}, or file.py:function")
        )
    _user_laws[name] = load_law(Path(path), function)
    return _user_laws[name]


def _meant(name: str) -> str:
    """Return the hint at the closest law; the compensation makes all names alike."""
    bare = (law for law in LAWS if not law.endswith(DEADBEAT))
    return did_you_mean(name.removesuffix(DEADBEAT), bare)
