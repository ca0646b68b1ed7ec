"""Speeds into and out of a contact, on positions made by hand."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from canwall.analysis.restitution import first_bounce, kicks, largest_restitution, swing_samples

Array = NDArray[np.float64]

#: A referent that is never left.
HELD = np.array([2.0, 1.0, -1.0, -1.0])


def bounces(*speeds: tuple[float, float], phase: float = 0.5, samples: int = 12) -> Array:
    """Contacts of two samples with a speed in and one out, in radians a sample."""
    parts = []
    for into, out in speeds:
        steps = np.arange(samples)
        parts += [(steps[::-1] + phase) * into, [-(1.0 - phase) * into, -(1.0 - phase) * out]]
        parts.append((steps + phase) * out)
    return np.concatenate(parts)


@pytest.mark.parametrize("restitution", [0.3, 1.0, 1.7])
def test_restitution_is_speed_out_over_speed_in(restitution: float) -> None:
    steps = np.arange(20.0)
    out = (steps - 1.0) * restitution * 1e-3
    y = np.concatenate([(20.0 - steps) * 1e-3, [0.0, -1e-3], out])
    speed, found = first_bounce(y, 1e-3, 1e-4)
    assert speed == pytest.approx(-1.0)
    assert found == pytest.approx(restitution)


def test_speed_of_approach_is_that_before_a_wall_acts_ahead_of_its_surface() -> None:
    y = np.array([9.0, 8.0, 7.0, 6.0, 5.0, 4.0, 3.0, 2.1, 1.3, 0.6]) * 1e-3
    y = np.concatenate([y, [-1e-5], np.arange(-1.0, 20.0) * 0.5e-3])
    speed, found = first_bounce(y, 1e-3, 1e-4)
    assert speed == pytest.approx(-1.0)
    assert found == pytest.approx(0.5)


def test_speed_of_a_handle_that_creeps_in_is_a_count_a_sample() -> None:
    y = np.array([9.0, 4.0, *np.ones(12), 0.0, -1.0, -1.0])
    for out in (0.4, 2.0):
        speed, found = first_bounce(np.concatenate([y, out * np.arange(20.0)]), 1.0, 1.0)
        assert speed == pytest.approx(-0.5)
        assert found == pytest.approx(out)


@pytest.mark.parametrize(
    ("outside", "out"),
    [
        ([1.0], (2.5 - 0.25) / 1.0),
        ([0.5, 3.0, 2.0], (4.5 - 0.25) / 2.0),
        ([0.0, 1.5, 3.5, 6.0, 2.0], (7.5 - 0.25) / 4.0),  # inside again at the last sample
    ],
)
def test_a_handle_that_comes_back_at_once_leaves_at_its_rise(
    outside: list[float], out: float
) -> None:
    y = np.array([*np.arange(20.0, -1.0, -1.0), -1.0, -1.5, *outside, -1.0])
    assert first_bounce(y, 1.0, 0.25) == (-1.0, pytest.approx(out))
    assert math.isnan(first_bounce(y[:-1], 1.0, 0.25)[1])  # nobody knows whether it does


@pytest.mark.parametrize("restitution", [0.5, 2.0])
def test_a_hand_that_changes_the_speed_hides_no_exit(restitution: float) -> None:
    """Half of the speed is gone two samples later, or was not there two samples before."""
    way = np.cumsum(0.5 ** (np.arange(20.0) / 2.0))
    y = np.concatenate([way[::-1] - 0.5, [-0.5], restitution * way - 0.5])
    speed, found = first_bounce(y, 1.0, 1e-9)
    assert (speed, found) == (pytest.approx(-1.0), pytest.approx(restitution))


def test_a_last_bit_is_no_exit() -> None:
    y = np.array([*np.arange(20.0, -1.0, -1.0), -1.0, 0.0, -1.0, -1.0])
    assert first_bounce(y, 1.0, 1.0) == (-1.0, 0.0)


@pytest.mark.parametrize("restitution", [0.5, 1.05, 1.15, 3.0])
def test_a_contact_kicks_that_is_left_faster(restitution: float) -> None:
    """Of any of them, with a count that is small beside the speeds."""
    for first, second in ((restitution, 0.7), (0.7, restitution)):
        y = bounces((1.0, first), (0.6, 0.6 * second))
        assert largest_restitution(y, 1e-9, 1) == pytest.approx(max(first, second))
        assert kicks(y, HELD, 1e-9, 1) is (restitution > 1.1)


@pytest.mark.parametrize("speed", [0.3, 1.0, 2.5, 7.0])
def test_counts_make_no_kick(speed: float) -> None:
    """At any phase against the counts and the SYNC, with speeds of few counts a sample."""
    rng = np.random.default_rng(3)
    for _ in range(300):
        y = bounces((speed, speed), phase=rng.random())
        assert not kicks(np.floor(y + rng.random()), HELD, 1.0, 1)
        assert not kicks(np.round(y), HELD, 1.0, 1)
        y = bounces((speed, 4.0 + 2.0 * speed), phase=rng.random())
        assert kicks(np.floor(y), HELD, 1.0, 1)


def test_a_kick_that_the_referent_has_too_is_allowed_for() -> None:
    """As where a hand pulls."""
    y, pulled = bounces((1.0, 2.0)), bounces((0.5, 0.95))
    assert kicks(y, HELD, 1e-6, 1)
    assert not kicks(y, pulled, 1e-6, 1)
    assert kicks(bounces((1.0, 2.2)), pulled, 1e-6, 1)


def test_a_contact_without_beginning_or_end_has_no_restitution() -> None:
    y = bounces((1.0, 2.0))
    inside = int(np.argmin(y))
    assert largest_restitution(y[inside:], 1e-6, 1) == 0.0
    assert largest_restitution(y[: inside + 1], 1e-6, 1) == 0.0
    assert largest_restitution(y[:0], 1e-6, 1) == 0.0


def test_a_wall_that_slows_the_handle_ahead_of_its_surface_does_not_kick() -> None:
    y = np.array([9.0, 8.0, 7.0, 6.0, 5.0, 4.0, 3.0, 2.1, 1.3, 0.6, -0.1, *np.arange(0.5, 9.0)])
    assert largest_restitution(y, 1e-6, 1) == pytest.approx(1.0, rel=1e-5)


def test_a_rotor_that_swings_on_its_shaft_does_not_kick() -> None:
    """The handle leaves half as fast as it came; the rotor swings about it, in four samples."""
    assert [swing_samples(hz, 1e-3) for hz in (0.0, 250.0, 400.0, 2500.0)] == [1, 4, 3, 1]
    y = bounces((1.0, 0.5), samples=30)
    left = np.arange(len(y)) > 30
    swing = 0.7 * np.sin(0.5 * np.pi * np.arange(len(y)) + 0.25 * np.pi)
    swung = np.where(left, y + swing, y)
    assert kicks(swung, HELD, 1e-6, 1)
    assert not kicks(swung, HELD, 1e-6, 4)
    assert kicks(np.where(left, 2.5 * y + swing, y), HELD, 1e-6, 4)
