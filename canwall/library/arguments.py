"""Arguments of the library's functions that Python would take apart, or fail to, far from here."""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from canwall.errors import ConfigError


def as_path(name: str, given: object, expected: str = "a path") -> Path:
    """Return a path. Raises ConfigError."""
    if isinstance(given, str | os.PathLike):
        return Path(given)
    raise _wrong(name, expected, given)


def as_dict(name: str, given: object) -> dict[str, Any]:
    """Return values by name, none for None. Raises ConfigError."""
    if given is None:
        return {}
    if isinstance(given, Mapping) and all(isinstance(key, str) for key in given):
        return dict(given)
    raise _wrong(name, "a dictionary with names as keys", given)


def as_list(given: object) -> list[Any]:
    """Return one or several as a list; a name or a law is one."""
    return list(given) if isinstance(given, Iterable) and not isinstance(given, str) else [given]


def _wrong(name: str, expected: str, given: object) -> ConfigError:
    return ConfigError(f"{name}: has to be {expected}, not {type(given).__name__}")
