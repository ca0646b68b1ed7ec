"""The rigid stop: forces against the impact in closed form, and a ball that comes to rest."""

import math

import numpy as np
import pytest
from law_bench import force_at, wall_of

from canwall.walls import LAWS
from canwall.workbench import Ball, sampled_ball

MASS, PERIOD, GRAVITY = 0.2, 0.01, 9.81


def stop(restitution: float = 0.0, recovery: float = 0.2) -> tuple[Ball, dict[str, float]]:
    ball = Ball(mass=MASS, period=PERIOD, gravity=GRAVITY, stiffness=5.0, damping=3.0)
    return ball, {"restitution": restitution, "recovery": recovery}


def velocity_after(y: float, v: float, restitution: float, recovery: float = 0.2) -> float:
    """Velocity one period later under the stop's force."""
    ball, options = stop(restitution, recovery)
    wall = wall_of(ball, "rigid", **options)
    return v + PERIOD * (force_at(wall, "rigid", y, v) / MASS - GRAVITY)


@pytest.mark.parametrize("restitution", [0.0, 0.3, 1.0])
@pytest.mark.parametrize(("y", "v"), [(0.002, -1.0), (0.019, -2.0), (0.0, -0.7)])
def test_impact_between_two_samples(y: float, v: float, restitution: float) -> None:
    strike = (v + math.sqrt(v * v + 2.0 * GRAVITY * y)) / GRAVITY  # (5.7), put right
    v_strike = v - GRAVITY * strike
    assert 0.0 <= strike < PERIOD
    left = PERIOD - strike
    rebound = -restitution * v_strike - GRAVITY * left
    # A ball that would be back on the stop within the period rests on it.
    rests = -restitution * v_strike * left - 0.5 * GRAVITY * left**2 <= 0.0
    expected = 0.0 if rests else rebound
    assert velocity_after(y, v, restitution) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(("y", "v"), [(0.01, -0.5), (0.0, 1.0), (0.2, -10.0)])
def test_no_force_where_nothing_is_struck(y: float, v: float) -> None:
    ball, options = stop(1.0)
    assert force_at(wall_of(ball, "rigid", **options), "rigid", y, v) == 0.0


def test_a_share_of_the_depth_is_taken_back_per_period() -> None:
    assert velocity_after(-0.01, -1.0, 0.0) == pytest.approx(0.2 * 0.01 / PERIOD)
    assert velocity_after(-0.01, -1.0, 0.0, recovery=0.5) == pytest.approx(0.5 * 0.01 / PERIOD)
    # A handle that still moves in is reversed, ...
    assert velocity_after(-0.001, -1.0, 0.8) == pytest.approx(0.8)
    # ... and one that moves out faster than wanted is not braked: a stop does not pull.
    assert velocity_after(-0.001, 3.0, 0.8) == pytest.approx(3.0 - GRAVITY * PERIOD)


@pytest.mark.parametrize("restitution", [0.0, 0.5])
def test_ball_comes_to_rest_on_the_stop(restitution: float) -> None:
    ball = Ball(mass=MASS, period=PERIOD, gravity=GRAVITY, height=0.3, periods=3000)
    y, v, f = sampled_ball(ball, LAWS["rigid"], {"restitution": restitution})
    assert np.all(f >= 0.0)
    assert np.abs(y[-100:]).max() < 1e-12
    assert np.abs(v[-100:]).max() < 1e-12
    assert f[-100:-1] == pytest.approx(MASS * GRAVITY)
    # The ball gets no deeper than it falls within the period of the impact.
    assert y.min() >= v.min() * PERIOD


def test_stiffness_and_damping_have_no_effect() -> None:
    soft = sampled_ball(Ball(stiffness=0.0), LAWS["rigid"])
    hard = sampled_ball(Ball(stiffness=1e6, damping=50.0), LAWS["rigid"])
    assert np.array_equal(soft, hard)
