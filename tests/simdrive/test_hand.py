"""The hand's script: where it wants to be at each SYNC, and the force that comes of it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from canwall.config import Hand
from canwall.simdrive.mechanics.hand import hand_force, hand_path, pressing

Array = NDArray[np.float64]

PERIOD = 1e-3

SCRIPT = Hand(
    strikes=2,
    first_strike_s=0.2,
    interval_s=1.0,
    approach_s=0.1,
    press_s=0.3,
    withdraw_s=0.05,
    rest_rad=0.15,
    press_rad=-0.1,
)


def at(values: Array, second: float) -> float:
    return float(values[round(second / PERIOD)])


def test_corners_of_the_script() -> None:
    path = hand_path(SCRIPT, PERIOD, 2000)
    assert path.shape == (2001,)
    for start in (0.2, 1.2):
        assert at(path, start) == pytest.approx(0.15, abs=1e-15)
        assert at(path, start + 0.002) < 0.15
        assert at(path, start + 0.098) > -0.1
        for pressed in (0.1, 0.25, 0.4):
            assert at(path, start + pressed) == pytest.approx(-0.1, abs=1e-15)
        assert at(path, start + 0.402) > -0.1
        assert at(path, start + 0.448) < 0.15
        assert at(path, start + 0.45) == pytest.approx(0.15, abs=1e-15)
    for rest in (0.0, 0.1, 0.7, 1.7, 2.0):
        assert at(path, rest) == 0.15


def test_approach_has_the_least_jerk() -> None:
    # Flash and Hogan 1985: from rest to rest in unit time, x = 10·s³ − 15·s⁴ + 6·s⁵.
    s = np.linspace(0.0, 1.0, 101)
    expected = 0.15 - 0.25 * (10 * s**3 - 15 * s**4 + 6 * s**5)
    path = hand_path(SCRIPT, PERIOD, 700)
    np.testing.assert_allclose(path[200:301], expected, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(path[600:651], expected[::-2], rtol=0.0, atol=1e-14)
    # Speed and acceleration are zero at both ends.
    assert abs(path[201] - path[200]) < 10 * 0.25 * 0.01**3 * 1.01
    assert abs(path[300] - path[299]) < 10 * 0.25 * 0.01**3 * 1.01


def test_after_the_last_strike_it_rests() -> None:
    assert np.all(hand_path(SCRIPT, PERIOD, 20_000)[1700:] == 0.15)


def test_without_strikes_it_rests() -> None:
    assert np.all(hand_path(Hand(strikes=0), PERIOD, 500) == 0.1)


def test_no_periods() -> None:
    assert hand_path(SCRIPT, PERIOD, 0).tolist() == [0.15]


def test_a_strike_at_once_and_without_a_stay() -> None:
    hand = Hand(strikes=2, first_strike_s=0.0, interval_s=0.2, press_s=0.0)
    path = hand_path(hand, PERIOD, 400)
    for j, position in ((0, 0.1), (50, 0.0), (100, -0.1), (150, 0.0), (200, 0.1), (300, -0.1)):
        assert path[j] == pytest.approx(position, abs=1e-12)
    assert path[1] < 0.1


@settings(derandomize=True, deadline=None, max_examples=100)
@given(
    st.integers(0, 5),
    *[st.floats(0.01, 0.5)] * 3,
    st.floats(0.0, 0.5),
    st.floats(1e-4, 0.05),
    st.integers(1, 400),
)
def test_any_script_stays_between_rest_and_press(
    strikes: int,
    approach: float,
    withdraw: float,
    first: float,
    press: float,
    period: float,
    periods: int,
) -> None:
    hand = Hand(
        strikes=strikes,
        first_strike_s=first,
        interval_s=approach + press + withdraw,
        approach_s=approach,
        press_s=press,
        withdraw_s=withdraw,
    )
    stage = pressing(hand, period, periods)
    assert stage.shape == (periods + 1,)
    assert stage[0] == 0.0
    assert stage.min() >= -1e-12
    assert stage.max() <= 1.0 + 1e-12
    # What comes later does not change what was, and it may be laid out in pieces.
    longer = pressing(hand, period, 2 * periods)
    np.testing.assert_array_equal(longer[: periods + 1], stage)
    np.testing.assert_array_equal(pressing(hand, period, periods, periods), longer[periods:])
    for whole, piece in zip(
        hand_force(hand, period, 2 * periods),
        hand_force(hand, period, periods, periods),
        strict=True,
    ):
        np.testing.assert_array_equal(piece, whole[periods:])


def test_force_is_that_of_spring_damper_and_muscle() -> None:
    hand = SCRIPT.model_copy(
        update={"stiffness_nm_per_rad": 3.0, "damping_nm_s_per_rad": 0.02, "press_torque_nm": -0.4}
    )
    constant, slope = hand_force(hand, PERIOD, 700)
    assert constant.shape == slope.shape == (700,)
    path, stage = hand_path(hand, PERIOD, 700), pressing(hand, PERIOD, 700)
    for j in (0, 199, 200, 230, 299, 300, 450, 620, 699):
        for t in (0.0, 0.3 * PERIOD, PERIOD):
            share = t / PERIOD
            position = (1 - share) * path[j] + share * path[j + 1]
            speed = (path[j + 1] - path[j]) / PERIOD
            muscle = -0.4 * ((1 - share) * stage[j] + share * stage[j + 1])
            expected = 3.0 * position + 0.02 * speed + muscle
            assert constant[j] + slope[j] * t == pytest.approx(expected, rel=1e-11, abs=1e-13)
    # Pressing with all it has, and at rest with nothing but its spring.
    assert constant[400] == pytest.approx(3.0 * -0.1 - 0.4)
    assert constant[100] == pytest.approx(3.0 * 0.15)
