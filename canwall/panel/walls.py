"""Walls to be compared, each as a change that does not depend on the wall in force."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from canwall.config import ConfigError, Wall, WallChange, absolute_law, first_error
from canwall.record.live import LiveLaw
from canwall.run.changes import not_of_the_run
from canwall.walls import UnknownLawError, law_name, refuse_other_options

#: Keys that one change may give instead of another.
_DAMPING = {"damping_nm_s_per_rad", "damping_ratio"}
#: Keys of which one belongs to the other.
_LAW = {"law", "options"}


def parse_change(given: object) -> WallChange:
    """Validate a change of a wall. Raises ConfigError."""
    try:
        return WallChange.model_validate(given)
    except ValidationError as error:
        raise ConfigError(first_error(error, WallChange)) from None


def check_laws(changes: Sequence[WallChange], wall: Wall, laws: Sequence[LiveLaw]) -> None:
    """Raise ConfigError for a law that is none of the run's, or lacks an option.

    Args:
        changes: Changes of `wall`.
        wall: The wall in force.
        laws: The laws of the run.
    """
    options = {law.name: [option.name for option in law.options] for law in laws}
    for change in changes:
        name = law_name(wall.law, wall.deadbeat)
        if change.law is not None:
            name = absolute_law(change.law, Path())
        if name not in options:
            raise not_of_the_run(name, options)
        try:
            refuse_other_options(name, options[name], change.options or {})
        except UnknownLawError as error:
            raise ConfigError(str(error)) from None


def completed(changes: Sequence[WallChange], wall: Wall) -> list[dict[str, Any]]:
    """Return changes that lead to the same walls in whatever order they are made.

    A key that one of them gives is in all of them, with the value of `wall` where it was not given.
    The last one, added, leads back to `wall`.

    Args:
        changes: Changes of `wall`.
        wall: The wall in force.

    Raises:
        ConfigError: For keys that are not of a wall.
    """
    given = [change.model_dump(mode="json", exclude_none=True) for change in changes]
    keys = {key for one in given for key in one}
    if outside := sorted(keys - set(Wall.model_fields)):
        raise ConfigError(f"{outside[0]}: walls that are compared cannot differ in it; change it")
    known = wall.model_dump(mode="json")
    return [_completed(one, keys, known) for one in [*given, {}]]


def _completed(
    given: Mapping[str, Any], keys: set[str], known: Mapping[str, Any]
) -> dict[str, Any]:
    plain = keys - _DAMPING - _LAW
    full = {key: known[key] for key in plain} | dict(given)
    if keys & _LAW:
        full.setdefault("law", known["law"])
        # Options that are not given belong to the law of the wall, and to no other.
        full.setdefault("options", known["options"] if "law" not in given else {})
    if keys & _DAMPING and not _DAMPING & set(given):
        key = "damping_ratio" if known["damping_ratio"] else "damping_nm_s_per_rad"
        full[key] = known[key]
    return full
