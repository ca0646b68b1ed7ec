"""A swing that no hand makes, and the mass that it tells."""

import numpy as np
import pytest
from numpy.typing import NDArray

from canwall.walls.swing import SWING, end_swing, follow_swing, lightness_of_swing, set_swing

PERIOD, COUNT = 1e-3, 4.8e-5
TURNS_AT = 1e-8


def new_swing() -> NDArray[np.void]:
    swing = np.zeros(1, SWING)
    set_swing(swing[0], PERIOD, COUNT)
    end_swing(swing[0])
    return swing


def first_told(
    hz: float, mass: float, counts: float = 20.0, begin: int = 0, cycles: int = 300
) -> tuple[int, float, float]:
    """Return the sample at which a swing of the torque tells (-1: none does), 1/m, its deviation.

    A torque that goes to and fro moves a mass; the handle goes by `counts` from end to end.
    """
    swing = new_swing()
    random = np.random.default_rng(1)
    for j in range(begin, cycles):
        phase = 2.0 * np.pi * hz * j * PERIOD
        torque = 1e-7 * np.sin(phase)
        position = -torque / mass + random.uniform(-0.5, 0.5) * COUNT
        y = COUNT * np.rint(0.25 - 0.5 * counts * np.cos(phase))
        if follow_swing(swing[0], y, position, torque, TURNS_AT):
            lightness, deviation, noise = lightness_of_swing(swing[0])
            assert noise >= (0.5 * COUNT) ** 2
            return j, lightness, deviation
    return -1, 0.0, 0.0


@pytest.mark.parametrize("mass", [1.4e-4, 4e-4, 1.4e-3, 3.6e-3])
@pytest.mark.parametrize("hz", [15.0, 30.0, 50.0])
def test_swing_tells_the_mass_after_two_halves(mass: float, hz: float) -> None:
    j, lightness, deviation = first_told(hz, mass)
    halves = 2.0 * j * PERIOD * hz
    assert 2.0 < halves < 2.5
    assert abs(lightness - 1.0 / mass) < 3.0 * deviation
    assert deviation < 0.1 / 1.4e-4


def test_two_counts_are_a_swing() -> None:
    assert first_told(25.0, 1e-3, counts=2.0)[0] > 0


@pytest.mark.parametrize("begin", [5, 15, 25, 40])
def test_direction_at_the_begin_is_no_turn(begin: int) -> None:
    """Half of what is seen first may have begun any time before."""
    j, _, _ = first_told(15.0, 1e-3, begin=begin)
    assert 2.0 * (j - begin) * PERIOD * 15.0 > 2.0


@pytest.mark.parametrize(
    ("hz", "counts"),
    [
        pytest.param(8.0, 20.0, id="as a hand pushes"),
        pytest.param(80.0, 20.0, id="as a blow"),
        pytest.param(25.0, 1.0, id="sticks"),
    ],
)
def test_what_is_no_swing_tells_nothing(hz: float, counts: float) -> None:
    assert first_told(hz, 1e-3, counts)[0] == -1


@pytest.mark.parametrize(("slips", "told"), [(1, False), (2, False), (12, True)])
def test_handle_that_sticks_and_slips_does_not_swing(slips: int, told: bool) -> None:
    """It goes four counts within that many of the 20 samples of a half."""
    swing = new_swing()
    found = False
    for j in range(200):
        torque = 1e-7 * np.sin(np.pi * (j + 0.5) / 20)
        since = max(j % 20 - 1, 0)
        there = min(since, slips) * 4 // slips
        y = COUNT * (there if j // 20 % 2 else 4 - there)
        found |= follow_swing(swing[0], y, 0.0, torque, TURNS_AT)
    assert found == told


@pytest.mark.parametrize(("growth", "told"), [(3.0, True), (5.0, False)])
def test_half_in_which_a_hand_withdraws_is_none(growth: float, told: bool) -> None:
    """It goes so many times as far as the one before, while the torque falls."""
    swing = new_swing()
    found = False
    for j in range(50):
        torque = 1e-7 * np.sin(np.pi * (j + 0.5) / 20)
        counts = 4.0 * growth if j >= 20 else 4.0
        y = COUNT * np.rint((j % 20) * counts / 19.0)
        found |= follow_swing(swing[0], y, 0.0, torque, TURNS_AT)
    assert found == told


def test_part_of_a_slow_half_is_none() -> None:
    """A hand pushes for 60 ms, and not at all for some of them, before it pushes back for 30 ms."""
    swing = new_swing()
    for j in range(92):
        torque = 1e-7 if j < 60 else -1e-7
        if 40 <= j < 46:
            torque = 0.0
        y = COUNT * (j if j < 60 else 120 - j)
        assert not follow_swing(swing[0], y, 0.0, torque if j < 90 else 1e-7, TURNS_AT)


def test_pause_ends_a_swing() -> None:
    swing = new_swing()
    told = []
    for j in range(500):
        halves = int(j / 20)
        # Every two halves are followed by 120 ms without a torque.
        torque = 0.0 if halves % 8 > 1 else 1e-7 * (-1.0) ** halves
        y = COUNT * (j % 20)
        told.append(follow_swing(swing[0], y, 0.0, torque, TURNS_AT))
    assert not any(told)


@pytest.mark.parametrize("period", [5e-4, 2e-3])
def test_halves_are_judged_in_seconds(period: float) -> None:
    swing = np.zeros(1, SWING)
    set_swing(swing[0], period, COUNT)
    assert swing["shortest"][0] * period == pytest.approx(0.008)
    assert swing["longest"][0] * period == pytest.approx(0.038)
