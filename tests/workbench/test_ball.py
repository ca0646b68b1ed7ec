"""The bouncing ball on every law, and its referent, against scipy, closed forms and the theory."""

import math
from dataclasses import replace

import numpy as np
import pytest
from bouncing import Array, bounces, integrated, sample_times, zoh_of
from hypothesis import given, settings
from hypothesis import strategies as st
from numbers_drawn import log_floats, or_zero

from canwall.errors import InputError
from canwall.walls import LAWS
from canwall.workbench import Ball, continuous_ball, sampled_ball
from canwall.workbench.comparison import FORCELESS

BOUNDED = settings(derandomize=True, deadline=None, max_examples=50)

every_law = pytest.mark.parametrize("law", LAWS)


def dropped(theta: float, **changes: float | str) -> Ball:
    """g = m = height = 1, T = 0.1, 3000 periods."""
    return replace(Ball(stiffness=(theta / 0.1) ** 2), **changes)  # type: ignore[arg-type]


def energies_outside(ball: Ball, y: Array, v: Array) -> Array:
    """Energy at the samples outside over that at the start."""
    energy = 0.5 * ball.mass * v**2 + ball.mass * ball.gravity * y + 0.5 * ball.spring * y**2
    return np.asarray((energy / energy[0])[y >= 0.0])


# Energy over many bounces


@pytest.mark.parametrize(
    ("law", "theta"),
    [("half_sample+deadbeat", theta) for theta in (0.05, 0.1, 0.2, 0.32, 0.5)]
    + [("push_only", theta) for theta in (0.1, 0.5, 1.0, 1.5)]
    + [("two_step", theta) for theta in (0.1, 0.32, 0.5, 1.0, 1.5, 3.16)],
)
def test_energy_at_the_end_is_that_at_the_start(law: str, theta: float) -> None:
    ball = dropped(theta)
    y, v, _ = sampled_ball(ball, LAWS[law])
    assert bounces(y) > 20
    assert energies_outside(ball, y, v)[-1] == pytest.approx(1.0, rel=0.0, abs=1e-9)


@pytest.mark.parametrize("theta", [0.1, 0.3, 0.5, 1.0, 1.5, 2.0, 2.5])
@pytest.mark.parametrize("law", ["mean_force", "push_only"])
def test_pushing_laws_never_pull_and_never_feed_the_ball(law: str, theta: float) -> None:
    ball = dropped(theta)
    y, v, force = sampled_ball(ball, LAWS[law])
    assert force.min() >= -1e-9
    assert energies_outside(ball, y, v).max() <= 1.0 + 1e-9


@pytest.mark.parametrize(
    ("theta", "end", "digit"), [(0.1, 0.98663, 1e-5), (0.5, 0.0567, 1e-4), (1.0, 0.0021, 1e-4)]
)
def test_mean_force_loses_what_the_theory_says(theta: float, end: float, digit: float) -> None:
    ball = dropped(theta)
    y, v, _ = sampled_ball(ball, LAWS["mean_force"])
    assert energies_outside(ball, y, v)[-1] == pytest.approx(end, rel=0.0, abs=digit)


def test_half_sample_stays_within_what_the_theory_says() -> None:
    ball = dropped(0.1)
    y, v, _ = sampled_ball(ball, LAWS["half_sample"])
    energy = energies_outside(ball, y, v)
    assert energy.min() == pytest.approx(0.984, abs=5e-4)
    assert energy.max() == pytest.approx(1.023, abs=5e-4)


def logarithmic_gains(theta: float, law: str) -> Array:
    """Change of ln E from bounce to bounce, 3000 periods from the entry speed 5 on."""
    ball = Ball(stiffness=1.0, period=theta, height=0.0, speed=5.0)
    y, v, _ = sampled_ball(ball, LAWS[law])
    entering = np.flatnonzero((y[:-1] >= 0.0) & (y[1:] < 0.0))
    return np.diff(np.log(0.5 * v[entering] ** 2 + y[entering]))


@pytest.mark.parametrize(("theta", "gain"), [(0.1, 0.177), (0.5, 0.79)])
def test_standard_gains_what_the_theory_says(theta: float, gain: float) -> None:
    assert logarithmic_gains(theta, "standard").mean() == pytest.approx(gain, rel=0.05)


@pytest.mark.parametrize(("theta", "spread"), [(0.1, 0.005), (0.5, 0.058)])
def test_half_sample_gains_nothing_and_deadbeat_nothing_at_all(theta: float, spread: float) -> None:
    gains = logarithmic_gains(theta, "half_sample")
    assert abs(gains.mean()) < 0.2 * spread
    assert 0.1 * spread < gains.std() < 2.0 * spread
    compensated = logarithmic_gains(theta, "half_sample+deadbeat")
    assert len(compensated) > 20
    assert np.abs(compensated).max() < 1e-13


# Driven by the held force and nothing else


@pytest.mark.parametrize(
    "ball",
    [
        dropped(0.3),
        dropped(0.3, viscous=0.02, spring=0.4, damping=0.1),
        dropped(1.0, viscous=0.05, tension="budget", passivity=0.3),
        dropped(0.3, spring=0.4, mass=0.3, gravity=9.81, tension="clamp"),
    ],
)
@every_law
def test_state_is_that_of_the_held_force(law: str, ball: Ball) -> None:
    y, v, force = sampled_ball(ball, LAWS[law])
    assert np.any(force[:-1] > 0.0) or (law in FORCELESS and not ball.viscous)
    phi, gamma = zoh_of(ball.mass, ball.viscous, ball.spring, ball.period)
    state = np.array([ball.height, ball.speed])
    scale = np.zeros(2)
    for j in range(ball.periods + 1):
        scale = np.maximum(scale, np.abs(state))
        error = np.abs(state - (y[j], v[j]))
        assert np.all(error <= 1e-9 * scale), j
        state = phi @ state + gamma * (force[j] - ball.mass * ball.gravity)
    assert force[-1] == 0.0


def test_damper_is_on_the_backward_difference() -> None:
    ball = dropped(0.5, damping=0.4, height=-0.1, speed=-2.0, periods=200)
    y, _, force = sampled_ball(ball, LAWS["damped"])
    # At the first sample there is none yet, but a velocity.
    velocity = np.concatenate([[-2.0], np.diff(y) / ball.period])
    expected = np.where(y < 0.0, -25.0 * y - 0.4 * velocity, 0.0)
    np.testing.assert_allclose(force[:-1], expected[:-1], rtol=1e-12, atol=0.0)


# The referent


@pytest.mark.slow
@pytest.mark.parametrize(
    "ball",
    [
        dropped(0.1, periods=6000),
        dropped(1.0, periods=2200),
        dropped(0.3, spring=0.3, periods=2500),
        dropped(0.3, damping=0.02, periods=1700),
        dropped(0.3, damping=0.02, spring=0.3, periods=2000),
        dropped(0.5, damping=0.02, spring=0.3, viscous=0.002, periods=1700),
        dropped(0.3, viscous=0.002, periods=2200),
    ],
)
def test_referent_over_fifty_bounces(ball: Ball) -> None:
    y_ref, v_ref, lost = integrated(ball, sample_times(ball))
    y, v, force = continuous_ball(ball)
    assert bounces(y_ref) >= 50
    np.testing.assert_allclose(y, y_ref, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(v, v_ref, rtol=0.0, atol=1e-8)
    floor = np.where(y_ref < 0.0, -ball.stiffness * y_ref - ball.damping * v_ref, 0.0)
    np.testing.assert_allclose(force[:-1], floor[:-1], rtol=0.0, atol=1e-6)
    # Its energy is what is left when the dampers, integrated along, have had theirs.
    energy = ball.energy(y, v)
    np.testing.assert_allclose(energy + lost, energy[0], rtol=0.0, atol=1e-9)
    assert (lost[-1] > 0.05) == (ball.damping + ball.viscous > 0.0)


def test_referent_bounces_in_closed_form() -> None:
    """From rest at a height h back to it: flight 2·√(2h/g), contact (π + 2·atan(g/(ω·v)))/ω."""
    speed, omega = math.sqrt(2.0), 3.0
    contact = (math.pi + 2.0 * math.atan(1.0 / (omega * speed))) / omega
    bounce = 2.0 * speed + contact
    y, v, _ = continuous_ball(Ball(stiffness=9.0, period=bounce / 12, periods=12 * 50))
    assert y[::12] == pytest.approx(np.ones(51), abs=1e-12)
    assert v[::12] == pytest.approx(np.zeros(51), abs=1e-11)
    middle = y[6::12]  # halfway it is deepest: static depth and amplitude together
    deepest = -1.0 / omega**2 - math.hypot(speed / omega, 1.0 / omega**2)
    assert middle == pytest.approx(np.full(50, deepest), abs=1e-12)


def floats(low: float, high: float) -> st.SearchStrategy[float]:
    """Numbers and zero, but none whose square underflows in scipy's error estimate."""
    return st.floats(low, high).map(lambda number: round(number, 9))


undamped_balls = st.builds(
    Ball,
    stiffness=log_floats(0.1, 100.0),
    mass=log_floats(0.1, 10.0),
    spring=or_zero(log_floats(0.01, 3.0)),
    gravity=or_zero(floats(-1.0, 1.0)),
    height=floats(-1.0, 1.0),
    speed=floats(-3.0, 3.0),
    period=log_floats(0.01, 0.3),
    periods=st.integers(1, 60),
)


@st.composite
def damped_balls(draw: st.DrawFn) -> Ball:
    ball = draw(undamped_balls)
    return replace(
        ball,
        damping=draw(or_zero(log_floats(0.01, 3.0))),
        viscous=draw(or_zero(log_floats(0.01, 1.0))),
    )


@BOUNDED
@given(undamped_balls)
def test_undamped_referent_runs_backwards_as_it_runs_forwards(ball: Ball) -> None:
    y, v, _ = continuous_ball(ball)
    back_y, back_v, _ = continuous_ball(replace(ball, height=y[-1], speed=-v[-1]))
    scale = max(1.0, float(np.abs(y).max()), float(np.abs(v).max()))
    np.testing.assert_allclose(back_y[::-1], y, rtol=0.0, atol=1e-9 * scale)
    np.testing.assert_allclose(-back_v[::-1], v, rtol=0.0, atol=1e-8 * scale)


@BOUNDED
@given(damped_balls())
def test_energy_of_the_damped_referent_is_what_the_dampers_leave(ball: Ball) -> None:
    y_ref, v_ref, lost = integrated(ball, sample_times(ball))
    y, v, _ = continuous_ball(ball)
    energy = ball.energy(y, v)
    scale = max(1.0, float(np.abs(energy).max()), float(np.abs(y_ref).max() + np.abs(v_ref).max()))
    np.testing.assert_allclose(y, y_ref, rtol=0.0, atol=1e-8 * scale)
    np.testing.assert_allclose(energy + lost, energy[0], rtol=0.0, atol=1e-8 * scale)


@BOUNDED
@given(damped_balls(), st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
def test_held_force_acts_linearly(ball: Ball, first: float, second: float) -> None:
    """Without a floor: the motion of a sum is the sum of the motions."""
    free = replace(ball, stiffness=0.0, damping=0.0)

    def motion(height: float, speed: float, gravity: float) -> Array:
        moved = replace(free, height=height, speed=speed, gravity=gravity)
        return np.array(sampled_ball(moved, LAWS["standard"])[:2])

    one, other = (ball.height, ball.speed, first), (second, first, ball.gravity)
    both = [first * a + second * b for a, b in zip(one, other, strict=True)]
    parts = first * motion(*one) + second * motion(*other)
    scale = 1.0 + float(np.abs(parts).max())
    np.testing.assert_allclose(motion(*both), parts, rtol=0.0, atol=1e-11 * scale)


#: Exponents of (mass, length, time) in each option that has a unit.
OPTION_UNITS = {
    "release": (0, 1, 0),
    "length": (0, 1, 0),
    "threshold": (0, 1, -1),
    "offset": (0, 1, 0),
    "stiffness": (1, 0, -2),
    "damping": (1, 0, -1),
}


def in_other_units(ball: Ball, mass: float, length: float, time: float) -> Ball:
    return replace(
        ball,
        stiffness=ball.stiffness * mass / time**2,
        damping=ball.damping * mass / time,
        mass=ball.mass * mass,
        viscous=ball.viscous * mass / time,
        spring=ball.spring * mass / time**2,
        gravity=ball.gravity * length / time**2,
        height=ball.height * length,
        speed=ball.speed * length / time,
        period=ball.period * time,
    )


def check_units(ball: Ball, law: str, mass: float, length: float, time: float) -> float:
    """Largest difference, over the largest value, between a motion and itself in other units."""
    options = {
        name: 3.0 * value if name in OPTION_UNITS else value
        for name, value in LAWS[law].options.items()
    }
    scaled = {
        name: value * mass**m * length**n * time**t
        for name, value in options.items()
        for m, n, t in [OPTION_UNITS.get(name, (0, 0, 0))]
    }
    here = sampled_ball(ball, LAWS[law], options)
    there = sampled_ball(in_other_units(ball, mass, length, time), LAWS[law], scaled)
    units = (length, length / time, mass * length / time**2)
    return max(
        float(np.abs(b / unit - a).max() / (1.0 + np.abs(a).max()))
        for a, b, unit in zip(here, there, units, strict=True)
    )


@pytest.mark.parametrize("scales", [(4.0, 0.125, 0.5), (2.0**-12, 2.0**9, 2.0**-7)])
@every_law
def test_powers_of_two_in_the_units_change_no_bit(
    law: str, scales: tuple[float, float, float]
) -> None:
    ball = dropped(0.5, damping=0.1, viscous=0.01, spring=0.2, periods=500)
    assert check_units(ball, law, *scales) == 0.0


@BOUNDED
@given(
    law=st.sampled_from(sorted(LAWS)),
    theta=st.floats(0.05, 1.5),
    damping=or_zero(st.floats(0.01, 1.0)),
    spring=or_zero(st.floats(0.01, 1.0)),
    mass=log_floats(1e-3, 1e3),
    length=log_floats(1e-3, 1e3),
    time=log_floats(1e-3, 1e3),
)
def test_no_law_knows_its_units(
    law: str,
    theta: float,
    damping: float,
    spring: float,
    mass: float,
    length: float,
    time: float,
) -> None:
    # One bounce: a rounding error grows from each to the next.
    ball = dropped(theta, damping=damping, spring=spring, viscous=0.1 * spring, periods=16)
    ball = replace(ball, periods=16 + int(4.0 / theta), height=1.0037)
    assert check_units(ball, law, mass, length, time) < 1e-7


# Where nothing much is left of the problem

degenerate = pytest.mark.timeout(20)

#: The rigid stop asks for no K; some laws push no undamped ball.
COMPLIANT = [law for law in LAWS if law not in ("rigid", *FORCELESS)]
compliant = pytest.mark.parametrize("law", COMPLIANT)

#: Each returns the ball as the continuous floor does, at any hardness.
EXACT = ("half_sample+deadbeat", "pole_placement+deadbeat", "two_step")


def check_free_fall(ball: Ball, y: Array, v: Array) -> None:
    t = sample_times(ball)
    height = ball.height + ball.speed * t - 0.5 * ball.gravity * t**2
    np.testing.assert_allclose(y, height, rtol=1e-11, atol=1e-9)
    np.testing.assert_allclose(v, ball.speed - ball.gravity * t, rtol=1e-11, atol=1e-9)


@degenerate
@compliant
def test_no_floor(law: str) -> None:
    ball = dropped(0.0, periods=300)
    y, v, force = sampled_ball(ball, LAWS[law])
    assert not force.any()
    check_free_fall(ball, y, v)


@degenerate
@compliant
def test_soft_floor_sampled_fast_is_the_continuous_one(law: str) -> None:
    """θ = 0.001: what a law does differently from the continuous floor goes with θ."""
    ball = Ball(stiffness=1.0, height=0.01, speed=-1.0, period=0.001, periods=4000)
    # Options that make a plain spring of it.
    plain = {"softening": 1.0, "length": 1e9}
    options = {name: value for name, value in plain.items() if name in LAWS[law].options}
    y, v, _ = sampled_ball(ball, LAWS[law], options)
    y_ref, v_ref, _ = continuous_ball(ball)
    np.testing.assert_allclose(y, y_ref, rtol=0.0, atol=0.005)
    np.testing.assert_allclose(v, v_ref, rtol=0.0, atol=0.005)


@degenerate
@every_law
def test_no_periods(law: str) -> None:
    y, v, force = sampled_ball(dropped(1.0, periods=0, height=2.0, speed=3.0), LAWS[law])
    assert (y.tolist(), v.tolist(), force.tolist()) == ([2.0], [3.0], [0.0])


@degenerate
@pytest.mark.parametrize("height", [0.0, 1.0])
@every_law
def test_at_rest_without_a_bias(law: str, height: float) -> None:
    y, v, force = sampled_ball(dropped(1.0, gravity=0.0, height=height, periods=100), LAWS[law])
    assert np.all(y == height)
    assert not v.any()
    assert not force.any()


@degenerate
@pytest.mark.parametrize("theta", [0.1, 1.0, 2.5])
@compliant
def test_one_bounce_without_a_bias(law: str, theta: float) -> None:
    ball = dropped(theta, gravity=0.0, height=0.53, speed=-1.0, periods=100)
    y, v, _ = sampled_ball(ball, LAWS[law])
    assert y[-1] > 1.0
    assert v[-1] > 0.0
    if law in (*EXACT, "push_only"):
        assert v[-1] == pytest.approx(1.0, rel=1e-12)


@degenerate
@every_law
def test_bias_that_pulls_out(law: str) -> None:
    """From outside it never touches; from inside, or struck, it leaves and does not return."""
    ball = dropped(1.0, gravity=-1.0, periods=200)
    y, v, force = sampled_ball(ball, LAWS[law])
    assert not force.any()
    check_free_fall(ball, y, v)
    for height, speed in ((-0.5, 0.0), (0.03, -1.0), (0.0, 0.0)):
        struck = replace(ball, height=height, speed=speed)
        y, v, force = sampled_ball(struck, LAWS[law])
        outside = int(np.flatnonzero((y >= 0.0) & (v > 0.0))[0])
        assert np.all(np.diff(y[outside:]) > 0.0)
        assert not force[outside + 2 :].any()


@degenerate
@pytest.mark.parametrize("law", [law for law in COMPLIANT if law != "exponential"])
def test_start_inside_at_the_equilibrium(law: str) -> None:
    ball = dropped(0.5, height=-1.0 / 25.0, periods=300, damping=1.0)
    y, v, force = sampled_ball(ball, LAWS[law])
    assert y == pytest.approx(np.full(301, -0.04), rel=1e-12)
    assert v == pytest.approx(np.zeros(301), abs=1e-12)
    assert force[:-1] == pytest.approx(np.ones(300), rel=1e-12)


@degenerate
@pytest.mark.parametrize(("height", "speed"), [(-0.5, 0.0), (-0.5, -3.0), (-1e-9, 2.0)])
@pytest.mark.parametrize("law", [*EXACT, "push_only"])
def test_start_inside_ends_as_the_referent_does(law: str, height: float, speed: float) -> None:
    ball = dropped(0.5, height=height, speed=speed, periods=500)
    y, v, _ = sampled_ball(ball, LAWS[law])
    assert bounces(y) > 3
    last = np.flatnonzero(y >= 0.0)[-1]
    assert ball.energy(y, v)[last] == pytest.approx(ball.energy(y, v)[0], rel=1e-9)


@degenerate
@pytest.mark.parametrize("theta", [3.2, 7.0, 40.0])
@pytest.mark.parametrize("law", EXACT)
def test_contact_shorter_than_a_period(law: str, theta: float) -> None:
    ball = dropped(theta)
    y, v, _ = sampled_ball(ball, LAWS[law])
    y_ref, v_ref, _ = continuous_ball(ball)
    # They differ from before an impact to the second sample after it.
    same = np.abs(y - y_ref) < 1e-7
    assert np.count_nonzero(same) > 0.8 * len(y)
    np.testing.assert_allclose(v[same], v_ref[same], rtol=0.0, atol=1e-6)


@degenerate
@pytest.mark.parametrize(
    "changes",
    [
        {"stiffness": 1e3},
        {"stiffness": 1e4, "height": 0.00125},
        {"stiffness": 1e6, "damping": 1e3},
        {"damping": 1e3},
        {"stiffness": 0.0, "damping": 5.0},
        {"stiffness": 1e-12},
        {"period": 1e-9},
        {"height": -1.0, "stiffness": 1e3},
        {"viscous": 1e6},
        {"spring": 50.0},
        {"mass": 1e-6, "stiffness": 1e-6},
        {"mass": 1e6, "stiffness": 1e6},
        {"height": 1e12, "periods": 100},
    ],
)
@every_law
def test_extremes_end_in_numbers(law: str, changes: dict[str, float]) -> None:
    for tension in ("allow", "clamp", "budget"):
        ball = Ball(**{"periods": 300, **changes, "tension": tension})  # type: ignore[arg-type]
        for column in sampled_ball(ball, LAWS[law]):
            assert np.all(np.isfinite(column)), tension
    for column in continuous_ball(ball):
        assert np.all(np.isfinite(column))


@pytest.mark.parametrize(
    ("name", "wrong"),
    [(name, x) for name in ("mass", "period") for x in (0.0, -1.0, math.nan, math.inf)]
    + [(n, x) for n in ("stiffness", "damping") for x in (-1.0, math.nan, math.inf)]
    + [(n, x) for n in ("viscous", "spring", "passivity") for x in (-1.0, math.nan, math.inf)]
    + [(n, x) for n in ("gravity", "height", "speed") for x in (math.nan, math.inf, -math.inf)]
    + [("periods", -1), ("tension", "alow")],
)
def test_what_no_ball_can_be(name: str, wrong: float | str) -> None:
    with pytest.raises(InputError) as caught:
        replace(Ball(), **{name: wrong})  # type: ignore[arg-type]
    message = str(caught.value)
    assert message.startswith(f"{name} has to be ")
    assert (f"not {wrong!r}" if isinstance(wrong, str) else f"not {wrong:g}") in message
    assert "\n" not in message


@degenerate
@pytest.mark.parametrize("law", EXACT)
def test_bounces_shorter_than_a_period(law: str) -> None:
    ball = Ball(stiffness=1e4, height=0.00125)
    y, _, _ = sampled_ball(ball, LAWS[law])
    y_ref, _, _ = continuous_ball(ball)
    assert y[-1] == pytest.approx(y_ref[-1], rel=0.0, abs=1e-6)
