"""What a run says of the guard at its end."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from canwall.cycle.guard import set_guard
from canwall.cycle.state import CYCLE
from canwall.run.result import _guard_summary, _remarks_on_guard


def axis_after(action: str, alarms: int) -> Any:
    cycle = np.zeros(1, CYCLE)
    set_guard(cycle["guard"][0], action, 1e-3, 5e-5)
    if alarms:
        cycle["guard"]["alarms"], cycle["guard"]["first_alarm"] = alarms, 280
        cycle["guard"]["lowest"] = 0.1 if action == "act" else 1.0
    settings = SimpleNamespace(bus=SimpleNamespace(cycle_s=1e-3))
    guard = SimpleNamespace(action=action)
    return SimpleNamespace(cycle=cycle, settings=settings, guard=guard)


@pytest.mark.parametrize("action", ["off", "warn", "act"])
def test_nothing_is_said_of_a_quiet_wall(action: str) -> None:
    axis = axis_after(action, 0)
    assert _remarks_on_guard(axis) == []
    assert _guard_summary(axis) == {
        "action": action,
        "alarms": 0,
        "first_alarm_s": None,
        "least_force": 1.0,
    }


def test_a_wall_that_buzzed_is_named() -> None:
    assert _remarks_on_guard(axis_after("act", 2)) == [
        "guard: the wall buzzed 2 times, first at 0.280 s; its force was lowered, to 0.1 of the "
        "law's at the least"
    ]
    turned_on_later = axis_after("warn", 1)
    turned_on_later.guard.action = "act"
    assert "would make it softer" in _remarks_on_guard(turned_on_later)[0]
    assert _remarks_on_guard(axis_after("warn", 1)) == [
        'guard: the wall buzzed once, first at 0.280 s; guard.action = "act" would make it softer'
    ]
