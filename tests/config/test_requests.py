"""Requests to a run: each is one of those that there are, or one line."""

from typing import Any

import pytest

from canwall.config import (
    ChangeWall,
    ConfigError,
    End,
    Mark,
    TakeTurns,
    WatchBeat,
    load,
    parse_request,
    shipped,
)


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        ({"do": "change", "stiffness_nm_per_rad": 5, "guard": {"action": "act"}}, ChangeWall),
        ({"do": "take_turns", "walls": [{"law": "standard"}, {}]}, TakeTurns),
        ({"do": "take_turns", "walls": []}, TakeTurns),
        ({"do": "mark", "text": "ü" * 200}, Mark),
        ({"do": "watch_beat", "timeout_s": 0}, WatchBeat),
        ({"do": "watch_beat", "timeout_s": 0.1}, WatchBeat),
        ({"do": "end"}, End),
    ],
)
def test_request(values: dict[str, Any], kind: type) -> None:
    request = parse_request(values)
    assert isinstance(request, kind)
    assert parse_request(request.model_dump(mode="json", exclude_none=True)) == request


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (None, "do: has to be one of change, take_turns, mark, watch_beat, end, not None"),
        ({}, "do: has to be one of"),
        ({"do": ["end"]}, "do: has to be one of"),
        ({"do": "changes"}, "did you mean change?"),
        ({"do": "change", "side": "above"}, "side: unknown key"),
        ({"do": "change", "stiffness_nm_per_rad": -1}, "stiffness_nm_per_rad: has to be greater"),
        ({"do": "change", "stiffness_nm_per_rad": float("nan")}, "stiffness_nm_per_rad: has to"),
        ({"do": "change", "guard": {"action": "ac"}}, "guard.action: has to be 'off', 'warn' or"),
        ({"do": "change", "operator": {"filters": 5}}, "operator.filters: unknown key"),
        (
            {"do": "change", "damping_ratio": 0.5, "damping_nm_s_per_rad": 0.1},
            "damping_ratio: damping_nm_s_per_rad is given as well; keep one of them",
        ),
        ({"do": "take_turns"}, "walls: is missing"),
        (
            {"do": "take_turns", "walls": [{}] * 17},
            "walls: 16 walls are the most that take turns, not 17",
        ),
        ({"do": "take_turns", "walls": [{"at_s": 1.0}]}, "walls.0.at_s: unknown key"),
        ({"do": "mark", "text": ""}, "text: has to have 1 to 200 characters, not 0"),
        ({"do": "mark", "text": "a\ud83d"}, "text: has half of a surrogate pair"),
        ({"do": "mark", "text": "x" * 201}, "text: has to have 1 to 200 characters, not 201"),
        ({"do": "mark", "text": "\0"}, "text: has a NUL character"),
        ({"do": "watch_beat", "timeout_s": 0.05}, "timeout_s: has to be 0, or 0.1 to 5 s"),
        ({"do": "watch_beat", "timeout_s": 6}, "timeout_s: has to be less than or equal to 5"),
        ({"do": "end", "now": True}, "now: unknown key"),
    ],
)
def test_request_that_there_is_not(values: Any, message: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse_request(values)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_schedule_has_the_same_keys() -> None:
    settings = load(shipped("config/sim.toml"))
    raw = settings.model_dump()
    raw["schedule"] = [
        {"at_s": 1.0, "guard": {"action": "act"}, "operator": {"adapt": False}},
        {"at_s": 2.0, "stiffness_nm_per_rad": 20.0},
    ]
    first, then, last = type(settings).model_validate(raw).stages
    assert first.operator.adapt
    assert (then.guard.action, then.operator.adapt) == ("act", False)
    assert (last.guard.action, last.operator.adapt) == ("act", False)
    assert (then.wall, last.wall.stiffness_nm_per_rad) == (first.wall, 20.0)
    raw["operator"]["adapt"] = False
    raw["schedule"][1]["operator"] = {"adapt": True}
    with pytest.raises(ValueError, match=r"schedule: operator\.adapt: \[mechanics\] is with"):
        type(settings).model_validate(raw)


def test_request_itself_is_no_key_of_the_wall() -> None:
    with pytest.raises(ConfigError, match=r"zzz: unknown key; known here: law, .*, operator$"):
        parse_request({"do": "change", "zzz": 1})
