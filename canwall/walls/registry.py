"""The laws by name: the one list that the loop, the workbench and the messages read."""

from pathlib import Path

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
from canwall.walls.user_law import load_law

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
        _user_laws[name] = load_law(Path(path), function)
    return _user_laws[name]
