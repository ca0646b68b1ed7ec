"""The scan for a K-limit, on strikes whose verdicts are known."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from canwall.analysis.k_limit import FACTOR, FINE_FACTOR, SCANNED, k_limits
from canwall.analysis.strike import MEASURES


@dataclass
class Known:
    """A strike of unit mass and period, so that K is K·T²/m."""

    chatters: Callable[[float], bool]
    softest: float = 0.0
    trips: Callable[[float], bool] = lambda k: False
    mass: float = 1.0
    period: float = 1.0

    def on(self, stiffness: float, damping: float) -> np.void:
        measures = np.zeros(1, MEASURES)[0]
        measures["chatters"] = self.chatters(stiffness)
        measures["trip"] = self.trips(stiffness)
        measures["penetration"] = stiffness
        return measures


@pytest.mark.parametrize("limit", [0.00017, 0.0123, 0.5, 1.99])
def test_the_limit_is_found_to_a_fine_step(limit: float) -> None:
    (found,) = k_limits([Known(lambda k: k > limit)], 0.0)
    assert limit / FINE_FACTOR < found["limit"] <= limit
    assert found["worst"] == found["limit"] == found["penetration"]
    assert not found["open_ended"]


def test_an_island_of_chatter_ends_the_scan() -> None:
    low = 0.2
    (found,) = k_limits([Known(lambda k: low < k < low * FACTOR * 1.001 or k > 3.0)], 0.0)
    assert low / FINE_FACTOR < found["limit"] <= low


def test_the_worst_is_free_for_all() -> None:
    # The second strike chatters in an island between two coarse steps, where the first ends.
    first = Known(lambda k: k > 0.3)
    (end,) = k_limits([first], 0.0)["limit"]
    second = Known(lambda k: abs(k / end - 1.0) < 0.01)
    found = k_limits([first, second], 0.0)
    assert found["worst"][0] == found["worst"][1] == pytest.approx(end / FINE_FACTOR)


def test_the_ends_of_the_scan() -> None:
    (found,) = k_limits([Known(lambda k: False)], 0.0)
    assert found["open_ended"]
    assert found["limit"] == SCANNED[-1] > 4.0
    (found,) = k_limits([Known(lambda k: True)], 0.0)
    assert found["limit"] == found["worst"] == 0.0
    assert np.isnan(found["penetration"])


def test_a_wall_too_soft_to_hold_the_hand_is_passed_over() -> None:
    thrown = Known(lambda k: k < 0.01 or k > 0.3, softest=0.02, trips=lambda k: k < 0.01)
    assert k_limits([thrown], 0.0)["limit"][0] > 0.28
    stiff = Known(lambda k: k < 0.01 or k > 0.3, softest=0.001, trips=lambda k: k < 0.01)
    assert k_limits([stiff], 0.0)["limit"][0] < 0.001


def test_a_strike_that_a_wall_is_too_soft_for_is_no_chatter_at_the_worst_limit_either() -> None:
    thrown = Known(lambda k: k < 0.01 or k > 0.3, softest=0.02, trips=lambda k: k < 0.01)
    found = k_limits([thrown, Known(lambda k: k > 0.003)], 0.0)
    assert found["worst"][0] == found["limit"].min() > 0.0
