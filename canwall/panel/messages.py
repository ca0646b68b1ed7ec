"""Messages between a page and the server: JSON, and the requests that a page may send."""

import json
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError

from canwall.config import ConfigError, WallChange, first_error, parse_request
from canwall.config.section import Positive, Section

Name = Annotated[str, Field(min_length=1, max_length=200)]


class Start(Section):
    """Request for a run.

    Attributes:
        config: Name of a configuration that is offered; without: the first one.
        changes: Changes of its wall and limits.
        duration_s: Duration [s]; without: until it is ended.
    """

    config: Name | None = None
    changes: WallChange | None = None
    duration_s: Positive | None = None


class _Nothing(Section):
    pass


class PresetName(Section):
    """Request about a preset by its name."""

    name: Name


class _SetAB(Section):
    a: WallChange
    b: WallChange


class _UseAB(Section):
    which: Literal["a", "b"]


class _AutoAB(Section):
    on: bool


#: Requests to the server and what they bring; None: it is validated where it is used.
_REQUESTS: dict[str, type[Section] | None] = {
    "stop": _Nothing,
    "beat": _Nothing,
    "take_control": _Nothing,
    "start": Start,
    "preset_save": PresetName,
    "preset_use": PresetName,
    "preset_remove": PresetName,
    "ab_set": _SetAB,
    "ab_use": _UseAB,
    "ab_auto": _AutoAB,
    "blind_begin": None,
    "blind_show": None,
    "blind_answer": None,
    "blind_end": _Nothing,
}


def parse(text: str) -> dict[str, Any]:
    """Parse a message of a page. Raises ConfigError unless it is an object of JSON."""
    try:
        message = json.loads(text, parse_constant=_no_number)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"not JSON: {error}") from None
    if not isinstance(message, dict):
        raise ConfigError("a message has to be an object of JSON")
    return message


def _no_number(name: str) -> float:
    raise ValueError(f"{name} is no number")


def validated(message: Mapping[str, Any]) -> Any:
    """Return what a request brings, validated as a configuration is.

    For a request to the run it is a `config.Request`. Raises ConfigError.
    """
    do = message.get("do")
    values = {key: value for key, value in message.items() if key != "id"}
    if not isinstance(do, str) or do not in _REQUESTS:
        return parse_request(values)
    del values["do"]
    model = _REQUESTS[do]
    if model is None:
        return values
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ConfigError(first_error(error, model)) from None
