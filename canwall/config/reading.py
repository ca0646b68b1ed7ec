"""Reading of a configuration: from a file to settings, or to one line about the first error."""

import math
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from canwall.config.catalogue import located
from canwall.config.settings import HANDLE_MAX_M, Settings
from canwall.errors import ConfigError, did_you_mean

# [wall] may be given in lengths and forces at a handle of radius r instead of angles and torques
# at its shaft. Each entry: metric key, angular key, and the exponent of r between them.
_METRIC_KEYS = {
    "position_m": ("position_rad", -1),
    "stiffness_n_per_m": ("stiffness_nm_per_rad", 2),
    "damping_n_s_per_m": ("damping_nm_s_per_rad", 2),
}

#: Tables and arrays in each other; the deepest key has five.
_DEEPEST = 20
_TOO_DEEP = f"tables or arrays in each other, more than {_DEEPEST} deep; write them flat"


def _convert_metric_keys(raw: dict[str, Any]) -> None:
    """Convert metric keys to angular ones; leave values of a wrong type to the validation."""
    mechanics, schedule = raw.get("mechanics"), raw.get("schedule")
    radius = mechanics.get("handle_radius_m") if isinstance(mechanics, dict) else None
    if not isinstance(radius, int | float) or not 0 < radius <= HANDLE_MAX_M:
        return
    changes = schedule if isinstance(schedule, list) else []
    sections = {"wall": raw.get("wall")} | {f"schedule.{i}": c for i, c in enumerate(changes)}
    for name, section in sections.items():
        if not isinstance(section, dict):
            continue
        for metric, (angular, exponent) in _METRIC_KEYS.items():
            if metric not in section:
                continue
            if angular in section:
                raise ConfigError(f"{name}.{metric}: {angular} is given as well; keep one of them")
            value = section.pop(metric)
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise ConfigError(
                    f"{name}.{metric}: has to be a valid number, not {_format(value)}"
                )
            section[angular] = value * float(radius) ** exponent


def _check_damping(raw: dict[str, Any]) -> None:
    """Raise ConfigError for a `[wall]` with a damping and a damping ratio, which overrules it."""
    wall = raw.get("wall")
    if isinstance(wall, dict) and wall.get("damping_ratio") and wall.get("damping_nm_s_per_rad"):
        raise ConfigError(
            "wall.damping_ratio: damping_nm_s_per_rad is given as well; keep one of them"
        )


def _damped_as_given(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return overrides in which a damping that is given takes the place of the damping ratio."""
    return (
        {"wall.damping_ratio": 0.0, **values} if "wall.damping_nm_s_per_rad" in values else values
    )


def load(path: Path, overrides: Mapping[str, Any] | None = None) -> Settings:
    """Read and validate a TOML file.

    Args:
        path: The file, or the name of a configuration of the catalogue; paths in it are relative
            to it.
        overrides: Values by dotted key, "wall.law", that replace those of the file.

    Raises:
        ConfigError: If the file cannot be read or is not valid.
    """
    path = located(path)
    try:
        text = path.read_text(encoding="utf-8-sig")  # of Notepad: with a byte-order mark
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; give the path of a configuration") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: cannot be read: is not UTF-8; save it as UTF-8") from None
    except ValueError as error:  # for a NUL
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    return parse(text, path, overrides)


def parse(text: str, path: Path, overrides: Mapping[str, Any] | None = None) -> Settings:
    """Validate TOML as that of the file `path`, which need not exist; otherwise as `load`."""
    try:
        raw = tomllib.loads(text)
    except ValueError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from None
    except RecursionError:
        raise ConfigError(f"{path}: {_TOO_DEEP}") from None
    try:
        check_values(raw)
        _convert_metric_keys(raw)
        _check_damping(raw)
        for dotted, value in _damped_as_given(overrides or {}).items():
            section, key = dotted.split(".")
            table = raw.setdefault(section, {})
            if isinstance(table, dict):
                table[key] = value
        settings = Settings.model_validate(raw)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    except ValidationError as error:
        raise ConfigError(f"{path}: {first_error(error)}") from None
    return _with_absolute_paths(settings, path.parent)


def check_values(raw: Mapping[str, Any]) -> None:
    """Raise ConfigError for what no key takes and what few functions expect.

    These are NUL characters, halves of surrogate pairs, which JSON can have, integers of more than
    64 bits, and tables deep in each other.
    """
    waiting: list[tuple[tuple[str, ...], Any]] = [((), raw)]
    while waiting:
        keys, value = waiting.pop()
        where = ".".join(keys)
        if len(keys) > _DEEPEST:
            raise ConfigError(f"{where}: {_TOO_DEEP}")
        texts = [text for text in (where, value) if isinstance(text, str)]
        if any("\0" in text for text in texts):
            raise ConfigError(f"{where}: has a NUL character; take it out")
        if any("\ud800" <= char <= "\udfff" for text in texts for char in text):
            raise ConfigError(f"{where}: has half of a surrogate pair; take it out")
        if isinstance(value, int) and not -(2**63) <= value < 2**63:
            raise ConfigError(f"{where}: an integer of more than 64 bits; give a smaller one")
        if isinstance(value, dict):
            waiting += [((*keys, key), inner) for key, inner in value.items()]
        elif isinstance(value, list):
            waiting += [((*keys, str(i)), inner) for i, inner in enumerate(value)]


def with_overrides(settings: Settings, values: Mapping[str, Any]) -> Settings:
    """Return the settings with other values by dotted key, validated again. Raises ConfigError."""
    raw = settings.model_dump()
    for dotted, value in _damped_as_given(values).items():
        *sections, key = dotted.split(".")
        table = raw
        for section in sections:
            inner = table.get(section)
            if not isinstance(inner, dict):
                raise ConfigError(f"{dotted}: there is no [{section}]")
            table = inner
        table[key] = value
    try:
        return Settings.model_validate(raw)
    except ValidationError as error:
        raise ConfigError(first_error(error)) from None


def _with_absolute_paths(settings: Settings, base: Path) -> Settings:
    """Resolve the paths in a configuration relative to the folder `base`."""
    drive = settings.drive.model_copy(update={"eds": (base / settings.drive.eds).resolve()})
    laws = {
        "law": absolute_law(settings.wall.law, base),
        "alternate": tuple(absolute_law(law, base) for law in settings.wall.alternate),
    }
    wall = settings.wall.model_copy(update=laws)
    more = tuple(absolute_law(law, base) for law in settings.run.more_laws)
    run = settings.run.model_copy(update={"more_laws": more})
    schedule = tuple(
        change.model_copy(update={"law": change.law and absolute_law(change.law, base)})
        for change in settings.schedule
    )
    simulation = settings.simulation
    if simulation is not None and simulation.store is not None:
        store = (base / simulation.store).resolve()
        simulation = simulation.model_copy(update={"store": store})
    return settings.model_copy(
        update={
            "drive": drive,
            "wall": wall,
            "run": run,
            "schedule": schedule,
            "simulation": simulation,
        }
    )


def absolute_law(law: str, base: Path) -> str:
    """Return the name of a law; the path in FILE.py:FUNCTION is resolved relative to `base`."""
    path, colon, function = law.rpartition(":")
    return f"{(base / path).resolve()}:{function}" if colon else law


def short_law(law: str) -> str:
    """Return the name of a law without the folder of its file, for tables and pictures."""
    path, colon, function = law.rpartition(":")
    return f"{Path(path).name}:{function}" if colon else law


# What a value has to be, by the pydantic errors that say it in Python's words.
_TOML_TYPES = {
    "model_type": "a table",
    "dict_type": "a table",
    "tuple_type": "an array",
    "too_long": "a pair",
    "is_instance_of": "a path in quotes",
    "string_too_long": "a shorter text",
    "string_too_short": "a text that is not empty",
    "too_short": "an array that is not empty",
}


def first_error(error: ValidationError, model: type[BaseModel] = Settings) -> str:
    """Return one line about the first error: key, what is wrong, what to do.

    If a key is missing, it tells all that are missing beside it; or one that is unknown, which may
    be the one that is missing.
    """
    errors = error.errors()
    if errors[0]["type"] == "missing":
        errors.sort(key=lambda each: each["type"] != "extra_forbidden")
    first, *others = errors
    where = [str(part) for part in first["loc"]]
    key = ".".join(where)
    given = first["input"]
    if first["type"] == "extra_forbidden":
        return f"{key}: unknown key{_suggestion(where, model)}"
    if first["type"] == "missing":
        missing = [e["loc"] for e in others if e["type"] == "missing"]
        beside = [".".join(map(str, loc)) for loc in missing if loc[:-1] == first["loc"][:-1]]
        what = "are missing; add them" if beside else "is missing; add it"
        return f"{', '.join([key, *beside])}: {what}"
    message = first["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
    begin = f"{key}: " if key else ""
    if first["type"] == "value_error":
        return f"{begin}{message}"
    hint = ""
    if first["type"] == "literal_error" and isinstance(given, str):
        hint = did_you_mean(given, re.findall(r"'([^']*)'", first["ctx"]["expected"]))
    if first["type"] == "tuple_type" and isinstance(given, dict):
        hint = f"; write [[{key}]]"
    expected = _TOML_TYPES.get(first["type"], message)
    return f"{begin}has to be {expected}, not {_format(given)}{hint}"


def _format(value: object) -> str:
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, dict | list | tuple):
        return _TOML_TYPES["dict_type" if isinstance(value, dict) else "tuple_type"]
    return repr(value) if isinstance(value, str | int | float | bool) else type(value).__name__


def _suggestion(where: list[str], model: Any) -> str:
    for part in where[:-1]:
        if part.isdigit():
            continue
        annotation = model.model_fields[part].annotation
        candidates = [annotation, *get_args(annotation)]
        model = next(c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel))
    known = [key for key in model.model_fields if key != "do"]  # names the request, not the wall
    if where[-1] in _METRIC_KEYS:
        return "; lengths and forces at the handle need mechanics.handle_radius_m"
    listed = f"; known here: {', '.join(known)}" if known else ""
    return did_you_mean(where[-1], known) or listed
