"""The regression that finds the mass at the handle."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import place_poles
from scipy.stats import truncnorm

from canwall.physics import advance, make_plant
from canwall.walls import ESTIMATOR, MAX_DELAY
from canwall.walls.least_squares import mean_above_zero, solve
from canwall.walls.regression import (
    REGRESSION,
    begin_regression,
    forget_mass,
    learn,
    moves,
    predict_regression,
    reset_regression,
    set_regression,
)

PERIOD, COUNT, LIGHTEST = 1e-3, 4.8e-5, 1e-4
Array = NDArray[np.float64]


def made() -> NDArray[np.void]:
    regression = np.zeros(1, REGRESSION)
    set_regression(regression[0], LIGHTEST, PERIOD, COUNT, 0.0)
    reset_regression(regression[0], 0.0)
    return regression


def mass_known(regression: NDArray[np.void], before: float) -> float:
    return 1.0 / max(solve(regression[0], before, False)[0], 200.0)


def send(regression: NDArray[np.void], estimator: NDArray[np.void], torque: float) -> None:
    """Send a torque that acts at once."""
    predict_regression(regression[0], estimator["in_flight"][0], torque, 0.0)
    estimator["in_flight"][0] = np.roll(estimator["in_flight"][0], 1)
    estimator["in_flight"][0, 0] = torque


def play(
    mass: float,
    torques: Array,
    push: Array,
    jitter: float = 0.0,
    calm: bool = False,
    speed: float = 0.5,
) -> tuple[float, float]:
    """Return 1/m and its deviation after torques that act at once, beside a hand's push.

    speed: that of approach [rad/s].
    """
    regression, estimator = made(), np.zeros(1, ESTIMATOR)
    rng = np.random.default_rng(1)
    y, v, known = 0.0, -speed, LIGHTEST
    for torque, pushed in zip(torques.tolist(), push.tolist(), strict=True):
        sample = COUNT * round((y + jitter * v * rng.uniform(-0.5, 0.5)) / COUNT)
        learn(regression[0], estimator[0], sample, known, calm, False)
        known = mass_known(regression, known)
        send(regression, estimator, torque)
        a = (torque + pushed - 0.01 * v) / mass
        y, v = y + PERIOD * v + 0.5 * PERIOD**2 * a, v + PERIOD * a
    return solve(regression[0], known, False)


@pytest.mark.parametrize("counts", [10_000, 32_768, 131_072])
@pytest.mark.parametrize("rate", [500.0, 1000.0, 2000.0])
def test_slow_motion_is_told_from_rest(counts: int, rate: float) -> None:
    """0.13 rad/s are a fifth of a count of 10 000 in a millisecond: told by up to 8 samples."""
    count, estimator = 2.0 * math.pi / counts, np.zeros(1, ESTIMATOR)
    speed = max(0.13, 2.0 * count * rate / 8)
    regression = np.zeros(1, REGRESSION)
    set_regression(regression[0], LIGHTEST, 1.0 / rate, count, 0.0)
    reset_regression(regression[0], 0.0)
    moved = []
    for j in range(400):
        y = speed * max(j - 200, 0) / rate
        learn(regression[0], estimator[0], count * round(y / count), LIGHTEST, False, False)
        predict_regression(regression[0], estimator[0]["in_flight"], 0.0, 0.0)
        moved.append(bool(moves(regression[0])))
    assert not any(moved[:200])
    assert np.mean(moved[300:]) > 0.95


def test_observer_has_three_equal_poles() -> None:
    regression = made()[0]
    pole = math.exp(-0.2 * math.pi)
    a = np.array([[1.0, PERIOD, 0.5 * PERIOD**2], [0.0, 1.0, PERIOD], [0.0, 0.0, 1.0]])
    c = np.array([[1.0, 0.0, 0.0]])
    closed = a @ (np.eye(3) - regression["gain"][:, None] @ c)
    np.testing.assert_allclose(np.poly(closed), np.poly([pole] * 3), rtol=1e-9)
    # scipy's placement wants poles that differ; close ones come near.
    near = place_poles(a.T, (c @ a).T, pole + np.array([-1e-4, 0.0, 1e-4])).gain_matrix[0]
    np.testing.assert_allclose(regression["gain"], near, rtol=1e-3)


@pytest.mark.parametrize("mass", [1e-4, 4e-4, 3.6e-3])
def test_blow_tells_the_mass(mass: float) -> None:
    torques = np.zeros(60)
    torques[40:43] = max(0.4, 400.0 * mass)
    found, deviation = play(mass, torques, np.zeros(60))
    assert found == pytest.approx(1.0 / mass, rel=0.1)
    # Of the lightest a blow of 0.4 N·m leaves more open: its timing moves it by many counts.
    assert deviation < (0.65 if mass == LIGHTEST else 0.3) * found


@pytest.mark.parametrize(("rate", "speed"), [(7.0, 2.5), (2.0, 0.5)])
def test_torque_that_answers_a_hand_tells_nothing(rate: float, speed: float) -> None:
    """A wall that gives way to none would look heavy. A hand that came fast may push fast."""
    push = -rate * PERIOD * np.arange(100)
    found, deviation = play(4e-4, -push, push, speed=speed)
    # The mean of what there may be before the first torque.
    assert found == pytest.approx(mean_above_zero(1.0 / LIGHTEST, 0.7 / LIGHTEST))
    assert deviation > 0.5 * found


def test_push_that_begins_with_the_wall_is_not_mass() -> None:
    """Within 20 ms nobody's handle gets 0.15 N·m from the motor, and as much against it."""
    j = np.arange(60)
    torques = 0.15 * np.clip((j - 36) / 4.0, 0.0, 1.0)
    push = -0.15 * np.clip((j - 26) / 24.0, 0.0, 1.0) ** 2
    found, _ = play(LIGHTEST, torques, push)
    assert found == pytest.approx(1.0 / LIGHTEST, rel=0.15)


@pytest.mark.parametrize("mass", [1e-4, 1.3e-4, 2.3e-4, 4.2e-4])
def test_push_that_grows_before_the_wall_is_not_mass(mass: float) -> None:
    """A hand that pushes harder by 8 N·m/s reaches a wall after 14 ms."""
    j = np.arange(42)
    torques = np.zeros(42)
    torques[36:] = 0.08, 0.32, 0.27, 0.21, 0.21, 0.23
    found, _ = play(mass, torques, -8.0 * PERIOD * np.clip(j - 22, 0, None))
    assert found == pytest.approx(1.0 / mass, rel=0.12)


def test_latch_of_the_position_is_noise() -> None:
    """A drive that samples up to 0.4 ms late makes the mass less certain, not another one."""
    torques = np.zeros(160)
    torques[140:143] = 0.2
    steady, deviation = play(4e-4, torques, np.zeros(160))
    jittered, larger = play(4e-4, torques, np.zeros(160), jitter=0.0004)
    assert larger > 3.0 * deviation
    assert abs(jittered - steady) < 3.0 * larger


def test_another_hand_is_another_mass() -> None:
    regression, estimator = made(), np.zeros(1, ESTIMATOR)
    y, v, known = 0.0, -0.5, LIGHTEST
    for j in range(200):
        mass = 3.6e-3 if j < 100 else 2e-4
        torque = 0.4 if j % 40 < 3 else 0.0
        learn(regression[0], estimator[0], COUNT * round(y / COUNT), known, False, False)
        known = mass_known(regression, known)
        send(regression, estimator, torque)
        a = torque / mass
        y, v = y + PERIOD * v + 0.5 * PERIOD**2 * a, v + PERIOD * a
    assert known == pytest.approx(2e-4, rel=0.1)


def swing(delay: float, told: float, mass: float) -> NDArray[np.void]:
    """Swing a handle whose torques act after a delay of up to two periods; return what is found."""
    regression, estimator = np.zeros(1, REGRESSION), np.zeros(1, ESTIMATOR)
    set_regression(regression[0], LIGHTEST, PERIOD, COUNT, told)
    reset_regression(regression[0], 0.0)
    plant = make_plant(mass, viscous=0.005)
    y, v, known = 0.0, 0.0, LIGHTEST
    share = (delay - 1.0) * PERIOD
    rng = np.random.default_rng(2)
    for _ in range(150):
        learn(regression[0], estimator[0], COUNT * round(y / COUNT), known, False, False)
        known = mass_known(regression, known)
        older, newer = estimator["in_flight"][0, 1], estimator["in_flight"][0, 0]
        send(regression, estimator, (0.2 + 300.0 * mass) * rng.choice([-1.0, 0.0, 1.0]))
        y, v, _ = advance(plant[0], y, v, older, 0.0, share)
        y, v, _ = advance(plant[0], y, v, newer, 0.0, PERIOD - share)
    assert known == pytest.approx(mass, rel=0.05)
    return regression


@pytest.mark.parametrize("mass", [1e-4, 4e-4, 3.6e-3])
@pytest.mark.parametrize("error", [-0.3, 0.0, 0.15])
def test_delay_is_found_with_the_mass(mass: float, error: float) -> None:
    regression = swing(1.35, 1.35 + error, mass)
    assert regression["excess"][0] == pytest.approx(-error, abs=0.06)
    assert abs(regression["excess"][0] + error) < 3.0 * regression["excess_spread"][0] < 0.3


def test_delay_outlives_the_hand() -> None:
    regression = swing(1.35, 1.1, 4e-4)
    found = regression["excess"][0]
    forget_mass(regression[0])
    assert mass_known(regression, LIGHTEST) < 1.2 * LIGHTEST
    assert regression["excess"][0] == pytest.approx(found, abs=1e-6)
    reset_regression(regression[0], 0.0)
    mass_known(regression, LIGHTEST)
    assert regression["excess"][0] == 0.0


@pytest.mark.parametrize(("mean", "deviation"), [(1.0, 0.1), (0.3, 0.3), (-0.5, 0.4), (-2.0, 0.3)])
def test_lightness_is_the_mean_of_what_there_may_be(mean: float, deviation: float) -> None:
    expected = truncnorm(-mean / deviation, np.inf, mean, deviation).mean()
    # Far below zero by its limit, which is a little more.
    rel = 1e-9 if mean > -6.0 * deviation else 0.05
    assert mean_above_zero(mean, deviation) == pytest.approx(expected, rel=rel)


def test_push_that_begins_with_the_probe_is_no_answer_to_it() -> None:
    """The handle would be taken for a heavy one, and a heavy wall launches it."""
    torques = np.zeros(70)
    torques[50:] = 0.005 * np.repeat([1.0, -1.0, 1.0, -1.0, 1.0], 4)
    push = np.zeros(70)
    push[52:] = -np.minimum(15.0 * PERIOD * np.arange(18), 0.15)
    for start in range(8):
        found, _ = play(LIGHTEST, torques, np.roll(push, start) * (np.arange(70) >= 52 + start))
        assert found > 0.3 / LIGHTEST


@pytest.mark.parametrize("mass", [2e-4, 4e-4])
def test_swing_against_friction_tells_the_mass(mass: float) -> None:
    """Of a handle that turns every five samples: not one goes on in one direction for six."""
    regression, estimator = made(), np.zeros(1, ESTIMATOR)
    plant = make_plant(mass, coulomb=0.01)
    y, v, known = 0.0, 0.0, 2.0 * mass
    for j in range(200):
        torque = 250.0 * mass * math.sin(2.0 * math.pi * j / 10.0)
        learn(regression[0], estimator[0], COUNT * round(y / COUNT), known, False, False)
        found, deviation = solve(regression[0], known, False)
        known = 1.0 / max(found, 200.0)
        send(regression, estimator, torque)
        y, v, _ = advance(plant[0], y, v, torque, 0.0, PERIOD)
    assert known == pytest.approx(mass, rel=0.1)
    assert deviation < 0.15 * found


def test_swing_as_slow_as_a_hand_pushes_tells_the_mass_of_a_calm_hand() -> None:
    """With a finger's mass in its model the wall of an arm swings at some 20 Hz."""
    t, arm = PERIOD * np.arange(300), 3.6e-3
    swing = 0.15 + 0.05 * np.sin(2.0 * np.pi * 18.0 * t)
    assert np.abs(np.diff(swing)).max() / PERIOD < 8.0
    push = np.full(300, -0.15)
    found, _ = play(arm, swing, push, calm=True)
    assert 1.5e-3 < 1.0 / found < 1.5 * arm
    found, _ = play(arm, swing, push, speed=2.0)
    assert 1.0 / found < 1e-3


def test_torque_faster_than_a_hand_that_came_slowly_tells_the_mass() -> None:
    """In a soft wall it never changes as fast as any hand pushes."""
    torques = np.zeros(60)
    torques[20:] = 0.2 * np.sin(2.0 * np.pi * 6.0 * PERIOD * np.arange(40))
    assert np.abs(np.diff(torques)).max() / PERIOD < 8.0
    (slow, _), (fast, _) = (play(3.6e-3, torques, np.zeros(60), speed=v) for v in (0.3, 2.0))
    assert 1.0 / slow > 4.0 * LIGHTEST
    # What there may be before the first torque.
    assert fast == pytest.approx(mean_above_zero(1.0 / LIGHTEST, 0.7 / LIGHTEST))


def test_torque_that_falls_with_a_hand_tells_nothing_of_a_calm_one() -> None:
    """Where one withdraws within 25 ms, a wall gives way to it, and the handle hardly moves."""
    slowly, fast = np.linspace(0.0, 0.15, 300), np.linspace(0.15, 0.0, 25)
    falling = np.concatenate([slowly, fast])
    push = -falling
    push[-25:] += LIGHTEST * 10.0
    found, _ = play(LIGHTEST, falling, push, calm=True)
    assert 1.0 / found < 2.0 * LIGHTEST


def test_torque_that_something_holds_tells_nothing() -> None:
    """After lost samples the handle rests under a torque that seems to move nothing."""
    torque, estimator = 0.3, np.zeros(1, ESTIMATOR)
    found = []
    for held in (torque, 0.0):
        regression = made()
        estimator["in_flight"] = torque
        begin_regression(regression[0], 0.0, 0.0, held)
        for _ in range(60):
            learn(regression[0], estimator[0], 0.0, LIGHTEST, False, False)
            send(regression, estimator, torque)
        found.append(mass_known(regression, LIGHTEST))
    assert found[0] == pytest.approx(LIGHTEST, rel=0.2)
    assert found[1] > 4.0 * LIGHTEST


def test_torque_after_an_old_sample_acts_earlier() -> None:
    in_flight = np.array([0.1, -0.2, 0.3] + [0.0] * (MAX_DELAY - 2))
    states = []
    for delay, age in ((1.35, 0.1), (1.25, 0.0)):
        regression = np.zeros(1, REGRESSION)
        set_regression(regression[0], LIGHTEST, PERIOD, COUNT, delay)
        reset_regression(regression[0], 0.0)
        predict_regression(regression[0], in_flight, 0.4, age)
        states.append(regression["observed"][0])
    assert states[0][0, 1] != 0.0
    np.testing.assert_allclose(states[0], states[1], rtol=1e-12)
