"""The first strike: depth, and speed on leaving over speed of approach."""

import math

import numpy as np
import pytest

from canwall.analysis.strike import first_bounce, first_depth, pressed_cycle


def test_only_the_first_contact_counts() -> None:
    assert first_depth(np.array([1.0, -2.0, -3.0, -1.0, 0.0, -9.0])) == 3.0
    assert first_depth(np.array([0.5, -2.0, -7.0])) == 7.0
    assert math.isnan(first_depth(np.array([1.0, 0.0, 2.0])))


@pytest.mark.parametrize("restitution", [0.3, 1.0, 1.7])
def test_restitution_is_speed_out_over_speed_in(restitution: float) -> None:
    steps = np.arange(20.0)
    y = np.concatenate([(20.0 - steps) * 1e-3, [-1e-3, -1e-3], steps * restitution * 1e-3])
    speed, found = first_bounce(y, 1e-3, 1e-4)
    assert speed == pytest.approx(-1.0)
    assert found == pytest.approx(restitution)


def test_speed_of_approach_is_that_before_a_wall_acts_ahead_of_its_surface() -> None:
    y = np.array([9.0, 8.0, 7.0, 6.0, 5.0, 4.0, 3.0, 2.4, 2.1, 2.0]) * 1e-3
    y = np.concatenate([y, [-1e-3, -1e-3], np.arange(20.0) * 0.5e-3])
    speed, found = first_bounce(y, 1e-3, 1e-4)
    assert speed == pytest.approx(-1.0)
    assert found == pytest.approx(0.5)


def test_speed_of_a_handle_that_creeps_in_is_a_count_a_sample() -> None:
    y = np.array([9.0, 4.0, *np.ones(12), 0.0, -1.0, -1.0])
    for out in (0.4, 2.0):
        speed, found = first_bounce(np.concatenate([y, out * np.arange(20.0)]), 1.0, 1.0)
        assert speed == pytest.approx(-0.2)
        assert found == pytest.approx(out)


@pytest.mark.parametrize(
    ("outside", "out"),
    [
        ([1.0], (2.5 - 0.25) / 1.0),
        ([1.0, 3.0, 2.0], (4.5 - 0.25) / 2.0),
        ([1.0, 1.5, 2.0, 2.5, 2.0], (4.0 - 0.25) / 4.0),  # inside again at the last sample
    ],
)
def test_a_handle_that_comes_back_at_once_leaves_at_its_rise(
    outside: list[float], out: float
) -> None:
    y = np.array([*np.arange(20.0, -1.0, -1.0), -2.0, -1.5, *outside, -1.0])
    assert first_bounce(y, 1.0, 0.25) == (-1.0, pytest.approx(out))
    assert math.isnan(first_bounce(y[:-1], 1.0, 0.25)[1])  # nobody knows whether it does


def test_a_last_bit_is_no_exit() -> None:
    y = np.array([*np.arange(20.0, -1.0, -1.0), -1.0, 0.0, -1.0, -1.0])
    assert first_bounce(y, 1.0, 1.0) == (-1.0, 0.0)


def test_a_wall_is_known_best_before_the_hand_leaves_it() -> None:
    y = np.ones(200)
    y[10:15] = y[50:150] = y[160:190] = -1.0
    force = np.zeros(200)
    force[150:152] = 1.0  # held for two cycles more
    assert pressed_cycle(y, force) == 50 + int(102 * 0.9) - 1
    assert pressed_cycle(y[:13], force) == 10 + 1
