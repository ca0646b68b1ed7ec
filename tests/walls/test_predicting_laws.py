"""Half-sample prediction, midpoint and pole placement, against scipy's matrix exponential."""

import math

import numpy as np
import pytest
from bouncing import Array, zoh_of
from hypothesis import given, settings
from hypothesis import strategies as st
from law_bench import COMPENSATED, PREDICTING, balls, force_at, wall_of
from scipy.linalg import expm

from canwall.workbench import Ball

BOUNDED = settings(derandomize=True, deadline=None, max_examples=50)

depths = st.floats(-1.0, -1e-3)
#: Velocities in units of a length per period.
speeds = st.floats(-1.0, 1.0)


def referent_flow(ball: Ball, t: float) -> Array:
    """exp of the mass on the wall, with state (y, ẏ, 1), over time t."""
    generator = np.zeros((3, 3))
    generator[0, 1] = 1.0
    stiffness, damping = ball.spring + ball.stiffness, ball.viscous + ball.damping
    generator[1] = -stiffness / ball.mass, -damping / ball.mass, -ball.gravity
    return np.asarray(expm(generator * t))


def feedback(ball: Ball, law: str) -> tuple[float, Array]:
    """(c, k) of a law f = c − k·x inside the wall, from three of its forces."""
    speed = 1.0 / ball.period
    wall = wall_of(ball, law)
    base = force_at(wall, law, -1.0, 0.0)
    k1 = force_at(wall, law, -2.0, 0.0) - base
    k2 = (force_at(wall, law, -1.0, -speed) - base) / speed
    return base - k1, np.array([k1, k2])


def closed_loop(ball: Ball, law: str) -> Array:
    """Φ − Γ·k, with ẏ in lengths per period, so that its entries have one scale."""
    phi, gamma = zoh_of(ball.mass, ball.viscous, ball.spring, ball.period)
    loop = phi - np.outer(gamma, feedback(ball, law)[1])
    return np.asarray(loop * np.array([[1.0, 1.0 / ball.period], [ball.period, 1.0]]))


@BOUNDED
@given(balls(), depths, speeds)
def test_half_sample_is_the_wall_law_half_a_period_ahead(ball: Ball, y: float, u: float) -> None:
    v = u / ball.period
    y_half, v_half, _ = referent_flow(ball, 0.5 * ball.period) @ [y, v, 1.0]
    expected = -ball.stiffness * y_half - ball.damping * v_half
    scale = ball.stiffness + ball.damping / ball.period
    wall = wall_of(ball, "half_sample")
    assert force_at(wall, "half_sample", y, v) == pytest.approx(expected, rel=0, abs=1e-12 * scale)


@BOUNDED
@given(balls(), depths, speeds)
def test_midpoint_is_the_wall_law_on_a_straight_line(ball: Ball, y: float, u: float) -> None:
    v = u / ball.period
    expected = -ball.stiffness * (y + v * ball.period / 2.0) - ball.damping * v
    assert force_at(wall_of(ball, "midpoint"), "midpoint", y, v) == pytest.approx(expected)


@BOUNDED
@given(st.floats(1e-4, 1e2), st.floats(1e-4, 1.0), st.floats(0.02, 4.0))
def test_midpoint_contact_has_determinant_one_for_any_mass(
    mass: float, period: float, theta: float
) -> None:
    ball = Ball(mass=mass, period=period, stiffness=mass * (theta / period) ** 2)
    assert np.linalg.det(closed_loop(ball, "midpoint")) == pytest.approx(1.0, abs=1e-11)


@BOUNDED
@given(balls())
def test_pole_placement_gives_the_eigenvalues_of_the_referent(ball: Ball) -> None:
    # Compared as characteristic polynomials: double eigenvalues are ill-conditioned.
    placed = np.poly(closed_loop(ball, "pole_placement"))
    wanted = np.poly(referent_flow(ball, ball.period)[:2, :2])
    np.testing.assert_allclose(placed, wanted, rtol=0.0, atol=1e-11)


@BOUNDED
@given(balls(), st.floats(1e-3, 1.0))
def test_pole_placement_keeps_the_equilibrium_under_a_bias(ball: Ball, press: float) -> None:
    y_eq = -press
    bias = (ball.spring + ball.stiffness) * y_eq
    wall = wall_of(ball, "pole_placement")
    wall["d"] = bias
    force = force_at(wall, "pole_placement", y_eq, 0.0)
    phi, gamma = zoh_of(ball.mass, ball.viscous, ball.spring, ball.period)
    y, v = phi @ [y_eq, 0.0] + gamma * (force + bias)
    assert y == pytest.approx(y_eq, rel=1e-12)
    assert v * ball.period == pytest.approx(0.0, abs=1e-12)


def test_pole_placement_of_a_damper_alone() -> None:
    """Without a spring the velocity decays as that of the continuous damper, e^(−(b + B)·T/m)."""
    ball = Ball(stiffness=0.0, damping=0.02, mass=1e-4, viscous=1e-3, gravity=0.0, period=1e-3)
    force = force_at(wall_of(ball, "pole_placement"), "pole_placement", -0.01, -1.0)
    phi, gamma = zoh_of(ball.mass, ball.viscous, ball.spring, ball.period)
    _, v = phi @ [-0.01, -1.0] + gamma * force
    assert v == pytest.approx(-math.exp(-0.021 * 1e-3 / 1e-4), rel=1e-9)


@pytest.mark.parametrize("theta", [0.01, 0.1, 1.0, 2.0, 3.0])
def test_pole_placement_of_a_mass_in_closed_form(theta: float) -> None:
    mass, period = 0.3, 0.02
    ball = Ball(mass=mass, period=period, stiffness=mass * (theta / period) ** 2, gravity=0.0)
    constant, gains = feedback(ball, "pole_placement")
    softer = ball.stiffness * (math.sin(theta / 2.0) / (theta / 2.0)) ** 2
    assert constant == pytest.approx(0.0, abs=1e-11 * softer)
    # Half-sample prediction along a straight line, with stiffness K·sinc²(θ/2).
    assert gains == pytest.approx([softer, softer * period / 2.0], rel=1e-10)
    one_minus_cosine = 2.0 * math.sin(theta / 2.0) ** 2
    assert gains[0] == pytest.approx(mass * 2.0 * one_minus_cosine / period**2, rel=1e-10)
    assert gains[1] == pytest.approx(mass * one_minus_cosine / period, rel=1e-10)


@pytest.mark.parametrize("law", PREDICTING)
def test_no_force_outside(law: str) -> None:
    wall = wall_of(Ball(stiffness=100.0, damping=2.0), law)
    for y, v in ((0.0, -10.0), (0.001, -10.0), (0.1, 1.0)):
        assert force_at(wall, law, y, v) == 0.0


@pytest.mark.parametrize("law", COMPENSATED)
def test_compensation_does_not_touch_a_contact_without_end(law: str) -> None:
    base = law.removesuffix("+deadbeat")
    ball = Ball(stiffness=100.0, damping=30.0, gravity=9.81)
    wall, plain = wall_of(ball, law), wall_of(ball, base)
    for y, v in ((-0.1, 0.0), (-0.098, 0.01), (-0.3, -1.0)):
        assert force_at(wall, law, y, v) == force_at(plain, base, y, v) > 0.0


@pytest.mark.parametrize("theta", [1e-4, 1e-6, 1e-7])
def test_soft_wall_under_a_bias(theta: float) -> None:
    stiffness = (theta / 1e-3) ** 2
    wall = wall_of(Ball(stiffness=stiffness, period=1e-3), "pole_placement")
    force = force_at(wall, "pole_placement", -1.0, 0.0)
    assert force == pytest.approx(stiffness, rel=1e-5)
