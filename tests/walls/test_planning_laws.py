"""The laws that steer to the continuous wall's state, against scipy's integrator and optimiser."""

from dataclasses import replace

import numpy as np
import pytest
from bouncing import Array, integrated, sample_times, zoh_of
from hypothesis import given, settings
from hypothesis import strategies as st
from law_bench import COMPENSATED, balls, force_at, wall_of
from scipy.optimize import lsq_linear

from canwall.walls import LAWS
from canwall.workbench import Ball, sampled_ball

BOUNDED = settings(derandomize=True, deadline=None, max_examples=50)

BALL = Ball(mass=0.5, gravity=2.0, height=0.3, speed=-2.0, period=0.02, periods=1)
PLANTS = {
    "mass": BALL,
    "damped floor": replace(BALL, damping=4.0),
    "friction and a spring": replace(BALL, viscous=0.2, spring=3.0),
    "all of it": replace(BALL, viscous=0.2, spring=3.0, damping=4.0),
}


def with_floor(ball: Ball, theta: float) -> Ball:
    """The floor of hardness θ, at the damping ratio that it has at θ = 1."""
    stiffness = ball.mass * (theta / ball.period) ** 2
    return replace(ball, stiffness=stiffness, damping=ball.damping * theta)


def falling(theta: float, plant: str, height: float) -> Ball:
    """A first contact and some samples after it."""
    ball = with_floor(PLANTS[plant], theta)
    return replace(ball, height=height, periods=15 + int(5.0 / theta))


def first_contact(y: Array) -> tuple[int, int]:
    """(last sample outside before, first sample outside after) the first contact of a referent."""
    inside = int(np.flatnonzero(y < 0.0)[0])
    return inside - 1, inside + int(np.flatnonzero(y[inside:] >= 0.0)[0])


@pytest.mark.parametrize("height", [0.30, 0.307, 0.315, 0.322, 0.33])
@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("theta", [0.1, 0.5, 1.3])
@pytest.mark.parametrize("law", COMPENSATED)
def test_deadbeat_meets_the_referent_at_the_first_sample_outside(
    law: str, theta: float, plant: str, height: float
) -> None:
    ball = falling(theta, plant, height)
    y_ref, v_ref, _ = integrated(ball, sample_times(ball))
    _, outside = first_contact(y_ref)
    y, v, _ = sampled_ball(ball, LAWS[law])
    after = slice(outside, outside + 3)
    assert y[after] == pytest.approx(y_ref[after], rel=0.0, abs=1e-9)
    assert v[after] == pytest.approx(v_ref[after], rel=0.0, abs=1e-8)
    # The law alone misses it.
    y_alone, _, _ = sampled_ball(ball, LAWS[law.removesuffix("+deadbeat")])
    assert abs(y_alone[outside] - y_ref[outside]) > 1e-7


@pytest.mark.parametrize("height", [0.30, 0.307, 0.315, 0.322, 0.33])
@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("theta", [0.1, 0.5, 1.3, 2.4])
def test_two_step_meets_the_referent_every_second_sample(
    theta: float, plant: str, height: float
) -> None:
    ball = falling(theta, plant, height)
    y_ref, v_ref, _ = integrated(ball, sample_times(ball))
    before, outside = first_contact(y_ref)
    y, v, _ = sampled_ball(ball, LAWS["two_step"])
    # A contact of an odd number of periods begins with a single one.
    first = 3 if (outside - before) % 2 else 2
    for sample in [*range(before + first, outside, 2), outside, outside + 1]:
        assert y[sample] == pytest.approx(y_ref[sample], rel=0.0, abs=1e-9)
        assert v[sample] == pytest.approx(v_ref[sample], rel=0.0, abs=1e-8)


positions = st.floats(-1.0, 1.0)
#: Velocities in units of a length per period.
speeds = st.floats(-2.0, 2.0)


@BOUNDED
@given(balls(), positions, speeds)
def test_mean_force_gives_the_velocity_of_the_continuous_wall(
    ball: Ball, y: float, u: float
) -> None:
    v = u / ball.period
    _, v_ref, _ = integrated(replace(ball, height=y, speed=v), np.array([0.0, ball.period]))
    wall = wall_of(ball, "mean_force")
    force = force_at(wall, "mean_force", y, v)
    phi, gamma = zoh_of(ball.mass, ball.viscous, ball.spring, ball.period)
    v_next = phi[1] @ [y, v] + gamma[1] * (force + wall["d"][0])
    scale = 4.0 / ball.period
    assert v_next == pytest.approx(v_ref[-1], rel=0.0, abs=1e-9 * scale)


@BOUNDED
@given(balls(damped=False), positions, speeds)
def test_mean_force_of_an_undamped_wall_never_pulls(ball: Ball, y: float, u: float) -> None:
    force = force_at(wall_of(ball, "mean_force"), "mean_force", y, u / ball.period)
    assert force >= -1e-9 * ball.stiffness


def approaching(theta: float, plant: str, phase: float) -> Ball:
    """The same ball at the last sample before it strikes, `phase` of a period ahead."""
    ball = with_floor(PLANTS[plant], theta)
    height = phase * ball.period * 2.0
    return replace(ball, height=height, speed=-2.0, periods=int(6.0 / theta) + 4)


@pytest.mark.parametrize("phase", [0.03, 0.4, 0.8])
@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("theta", [0.11, 0.23, 0.5, 1.1])
def test_push_only_is_the_least_change_that_arrives(theta: float, plant: str, phase: float) -> None:
    ball = approaching(theta, plant, phase)
    y_ref, v_ref, _ = integrated(ball, sample_times(ball))
    before, n = first_contact(y_ref)
    assert before == 0
    bias = -ball.mass * ball.gravity
    phi, gamma = zoh_of(ball.mass, ball.viscous, ball.spring, ball.period)
    along = np.array([y_ref, v_ref])
    # The mean force of each interval along the referent, ...
    means = (v_ref[1 : n + 1] - phi[1] @ along[:, :n]) / gamma[1] - bias
    means = np.maximum(means, 0.0)
    # ... what forces do to the state at the first sample outside, ...
    reach = np.array([np.linalg.matrix_power(phi, n - 1 - i) @ gamma for i in range(n)]).T
    free = np.linalg.matrix_power(phi, n) @ along[:, 0] + reach.sum(axis=1) * bias
    wanted = along[:, n] - free
    # ... and the least change that scipy finds, with a large weight on arriving.
    # All in units of the largest force.
    unit = means.max()
    weight = 1e5 / np.abs(reach).max(axis=1, keepdims=True)
    best = lsq_linear(
        np.vstack([np.eye(n), weight * reach]),
        np.concatenate([means, weight[:, 0] * wanted]) / unit,
        bounds=(0.0, np.inf),
        method="bvls",
    )
    assert best.success

    wall = wall_of(ball, "push_only")
    first = force_at(wall, "push_only", ball.height, ball.speed)
    plan = wall["plan"][0, :n] if n > 2 else np.array([first, wall["plan"][0, 1]])
    assert first == plan[0]
    assert np.all(plan >= 0.0)
    assert reach @ plan == pytest.approx(wanted, rel=1e-9, abs=1e-11)
    assert plan / unit == pytest.approx(best.x, rel=0.0, abs=1e-7)


@pytest.mark.parametrize("phase", [0.03, 0.4, 0.8])
@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("theta", [0.11, 0.23, 0.5, 1.1])
def test_push_only_planned_anew_at_every_sample_arrives(
    theta: float, plant: str, phase: float
) -> None:
    ball = approaching(theta, plant, phase)
    y_ref, v_ref, _ = integrated(ball, sample_times(ball))
    _, n = first_contact(y_ref)
    y, v, f = sampled_ball(ball, LAWS["push_only"])
    assert np.all(f >= 0.0)
    assert y[n] == pytest.approx(y_ref[n], rel=0.0, abs=1e-10)
    assert v[n] == pytest.approx(v_ref[n], rel=0.0, abs=1e-9)
