"""Requests to a run in progress: a JSON object each, whose key `do` says which one it is."""

from typing import Annotated, Any, Literal, TypeAlias

from pydantic import Field, ValidationError, field_validator

from canwall.config.reading import check_values, first_error
from canwall.config.section import Array, NonNegative, Section
from canwall.config.settings import WallChange
from canwall.errors import ConfigError, did_you_mean

#: Most walls that take turns.
_TURNS = 16
#: Longest text of a mark [characters].
_MARK = 200
#: Shortest time without a beat that a busy machine may have [s].
_LEAST_BEAT_S = 0.1


class ChangeWall(WallChange):
    """`change`: new values of the wall, of its limits, of guard and operator."""

    do: Literal["change"] = "change"


class TakeTurns(Section):
    """`take_turns`: walls that alternate from strike to strike; none ends it.

    Each is a change of the wall in force. The first is in force at once.
    """

    do: Literal["take_turns"] = "take_turns"
    walls: Array[tuple[WallChange, ...]]

    @field_validator("walls")
    @classmethod
    def _few(cls, value: tuple[WallChange, ...]) -> tuple[WallChange, ...]:
        if len(value) > _TURNS:
            raise ValueError(f"{_TURNS} walls are the most that take turns, not {len(value)}")
        return value


class Mark(Section):
    """`mark`: a line in the events of the run."""

    do: Literal["mark"] = "mark"
    text: str

    @field_validator("text")
    @classmethod
    def _short(cls, value: str) -> str:
        if not 0 < len(value) <= _MARK:
            raise ValueError(f"has to have 1 to {_MARK} characters, not {len(value)}")
        return value


class WatchBeat(Section):
    """`watch_beat`: ramp the wall down without a sign of life for this time [s]; 0: never."""

    do: Literal["watch_beat"] = "watch_beat"
    timeout_s: Annotated[NonNegative, Field(le=5.0)]

    @field_validator("timeout_s")
    @classmethod
    def _long_enough(cls, value: float) -> float:
        if 0.0 < value < _LEAST_BEAT_S:
            raise ValueError(f"has to be 0, or {_LEAST_BEAT_S:g} to 5 s, not {value:g}")
        return value


class End(Section):
    """`end`: end the run as Ctrl-C does."""

    do: Literal["end"] = "end"


Request: TypeAlias = ChangeWall | TakeTurns | Mark | WatchBeat | End

_REQUESTS: dict[str, type[Request]] = {
    "change": ChangeWall,
    "take_turns": TakeTurns,
    "mark": Mark,
    "watch_beat": WatchBeat,
    "end": End,
}


def parse_request(values: Any) -> Request:
    """Validate a request. Raises ConfigError."""
    name = values.get("do") if isinstance(values, dict) else None
    if not isinstance(name, str) or name not in _REQUESTS:
        known = ", ".join(_REQUESTS)
        hint = did_you_mean(name, _REQUESTS) if isinstance(name, str) else ""
        raise ConfigError(f"do: has to be one of {known}, not {name!r}{hint}")
    check_values(values)
    model = _REQUESTS[name]
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ConfigError(first_error(error, model)) from None
