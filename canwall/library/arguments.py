"""Arguments of the library's functions that Python would take apart, or fail to, far from here."""

import os
from collections.abc import Iterable, Mapping
from operator import index
from pathlib import Path
from typing import Any, SupportsIndex

from canwall.errors import ConfigError


def as_path(name: str, given: object, expected: str = "a path") -> Path:
    """Return a path. Raises ConfigError."""
    if isinstance(given, str | os.PathLike):
        return Path(given)
    raise wrong(name, expected, given)


def as_dict(name: str, given: object) -> dict[str, Any]:
    """Return values by name, none for None. Raises ConfigError."""
    if given is None:
        return {}
    if isinstance(given, Mapping) and all(isinstance(key, str) for key in given):
        return dict(given)
    raise wrong(name, "a dictionary with names as keys", given)


def as_count(name: str, given: object, expected: str) -> int | None:
    """Return a whole number, None for None. Raises ConfigError."""
    if given is None:
        return None
    if isinstance(given, bool) or not isinstance(given, SupportsIndex):
        raise wrong(name, expected, given)
    return index(given)


def as_text(name: str, given: object, expected: str) -> str | None:
    """Return a text, None for None. Raises ConfigError."""
    if given is None or isinstance(given, str):
        return given
    raise wrong(name, expected, given)


def as_list(given: object) -> list[Any]:
    """Return one or several as a list; a name or a law is one."""
    return list(given) if isinstance(given, Iterable) and not isinstance(given, str) else [given]


def wrong(name: str, expected: str, given: object) -> ConfigError:
    """Return the error of an argument that is of another type than expected."""
    return ConfigError(f"{name}: has to be {expected}, not {type(given).__name__}")
