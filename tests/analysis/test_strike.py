"""The first strike: depth, and speed on leaving over speed of approach."""

import math

import numpy as np
import pytest

from canwall.analysis.strike import first_bounce, first_depth


def test_only_the_first_contact_counts() -> None:
    assert first_depth(np.array([1.0, -2.0, -3.0, -1.0, 0.0, -9.0])) == 3.0
    assert first_depth(np.array([0.5, -2.0, -7.0])) == 7.0
    assert math.isnan(first_depth(np.array([1.0, 0.0, 2.0])))


@pytest.mark.parametrize("restitution", [0.3, 1.0, 1.7])
def test_restitution_is_speed_out_over_speed_in(restitution: float) -> None:
    steps = np.arange(20.0)
    y = np.concatenate([(20.0 - steps) * 1e-3, [-1e-3, -1e-3], steps * restitution * 1e-3])
    speed, found = first_bounce(y, 1e-3)
    assert speed == pytest.approx(-1.0)
    assert found == pytest.approx(restitution)
