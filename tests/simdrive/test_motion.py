"""Motor, handle and hand against scipy's integrator with the same moving hand."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq
from scipy.signal import cont2discrete, lfilter

from canwall.config import Hand, Simulation
from canwall.simdrive import ServoMotion, hand_plant, handle_plant
from canwall.simdrive.mechanics.hand import hand_path

Array = NDArray[np.float64]

PERIOD = 1e-3
COUNTS_PER_REV = 131072.0

HAND = Hand(
    inertia_kg_m2=6.4e-5,
    damping_nm_s_per_rad=0.0256,
    stiffness_nm_per_rad=3.2,
    strikes=1,
    first_strike_s=0.02,
    approach_s=0.1,
    press_s=0.1,
    withdraw_s=0.1,
    press_torque_nm=-0.1,
)
SMOOTH = Simulation(
    inertia_kg_m2=1e-4, viscous_nm_s_per_rad=5e-4, coulomb_nm=0.0, hand=HAND
).with_ideal_servo()


def torque_at(j: int) -> float:
    """A motor torque that is another one in every period [N·m]."""
    return 0.3 * math.sin(0.9 * j) + 0.1 * math.cos(0.013 * j)


def least_jerk(hand: Hand, t: float) -> float:
    """Return the share of the way from rest to press that the hand has gone in its one strike."""
    since = t - hand.first_strike_s
    leaving = hand.approach_s + hand.press_s
    if since < leaving:
        s = min(max(since / hand.approach_s, 0.0), 1.0)
    else:
        s = min(max(1.0 - (since - leaving) / hand.withdraw_s, 0.0), 1.0)
    return 10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5


def test_what_moves_is_drive_and_hand_together() -> None:
    simulation = SMOOTH.model_copy(
        update={"coulomb_nm": 0.01, "stiction_nm": 0.02, "cogging_nm": 0.003}
    )
    friction = {"coulomb": 0.01, "stiction": 0.02}
    cogs = {"cogging": 0.003, "cog_pitch": math.pi / 12.0}
    assert hand_plant(simulation) == pytest.approx(
        {"mass": 1.64e-4, "viscous": 0.0261, "spring": 3.2, **friction, **cogs}
    )
    assert handle_plant(simulation) == pytest.approx(
        {"mass": 1e-4, "viscous": 5e-4, **friction, **cogs}
    )


def test_a_handle_on_a_shaft_resonates_at_its_frequency() -> None:
    """Zero crossings of the encoder about the centre of mass, after a jerk of the motor."""
    nobody = Hand(strikes=0, inertia_kg_m2=0.0, damping_nm_s_per_rad=0.0, stiffness_nm_per_rad=0.0)
    changes = {"shaft_hz": 250.0, "shaft_damping_ratio": 0.0, "viscous_nm_s_per_rad": 0.0}
    simulation = SMOOTH.model_copy(update={"hand": nobody, **changes})
    motion, step = ServoMotion(simulation, PERIOD, COUNTS_PER_REV), 1e-5
    motion.advance(0.5, 1e-3)
    begin, speed = motion.position_rad, 0.5e-3 / 1e-4
    off = []
    for j in range(10_000):
        off.append(motion.position_rad - begin - speed * j * step)
        motion.advance(0.0, step)
    swing = np.array(off) - np.mean(off)
    crossings = np.flatnonzero((swing[:-1] < 0.0) & (swing[1:] >= 0.0))
    period = (crossings[-1] - crossings[0]) * step / (len(crossings) - 1)
    assert 1.0 / period == pytest.approx(250.0, rel=1e-3)


def test_motion_is_that_of_the_differential_equation() -> None:
    motion = ServoMotion(SMOOTH, PERIOD, COUNTS_PER_REV)
    y, v = HAND.rest_rad, 0.0
    for j in range(350):
        before, after = (least_jerk(HAND, i * PERIOD) for i in (j, j + 1))

        def derivative(
            t: float, state: Array, j: int = j, before: float = before, after: float = after
        ) -> list[float]:
            stage = before + (after - before) * t / PERIOD
            way = HAND.press_rad - HAND.rest_rad
            hand, hand_speed = HAND.rest_rad + way * stage, way * (after - before) / PERIOD
            torque = (
                torque_at(j)
                + HAND.press_torque_nm * stage
                + HAND.stiffness_nm_per_rad * (hand - state[0])
                + HAND.damping_nm_s_per_rad * (hand_speed - state[1])
                - SMOOTH.viscous_nm_s_per_rad * state[1]
            )
            return [state[1], torque / (SMOOTH.inertia_kg_m2 + HAND.inertia_kg_m2)]

        end = solve_ivp(derivative, (0.0, PERIOD), [y, v], "DOP853", rtol=1e-11, atol=1e-12)
        y, v = (float(x) for x in end.y[:, -1])
        motion.advance(torque_at(j), PERIOD)
        assert motion.position_rad == pytest.approx(y, rel=0.0, abs=1e-9)
        assert motion.speed_rad_s == pytest.approx(v, rel=0.0, abs=1e-7)
    assert abs(y - HAND.rest_rad) > 1e-3


def test_the_script_goes_on_however_long_the_run() -> None:
    """A strike long after the first piece of the script that is laid out."""
    hand = HAND.model_copy(update={"first_strike_s": 9.5, "press_torque_nm": 0.0})
    motion = ServoMotion(SMOOTH.model_copy(update={"hand": hand}), PERIOD, COUNTS_PER_REV)
    mass, viscous, spring = 1.64e-4, 0.0261, 3.2
    generator = np.zeros((4, 4))
    generator[0, 1] = generator[2, 3] = 1.0
    generator[1] = -spring / mass, -viscous / mass, 1.0 / mass, 0.0
    propagator = expm(generator * PERIOD)
    path = hand_path(hand, PERIOD, 10_000)
    state = np.array([hand.rest_rad, 0.0])
    lowest = hand.rest_rad
    for before, after in pairwise(path):
        speed = (after - before) / PERIOD
        force = spring * before + 0.0256 * speed
        state = (propagator @ [*state, force, spring * speed])[:2]
        motion.advance(0.0, PERIOD)
        assert motion.position_rad == pytest.approx(state[0], rel=0.0, abs=1e-10)
        lowest = min(lowest, motion.position_rad)
    assert lowest < -0.09


def test_begins_at_rest_where_the_hand_does() -> None:
    motion = ServoMotion(SMOOTH, PERIOD, COUNTS_PER_REV)
    assert (motion.position_rad, motion.speed_rad_s) == (HAND.rest_rad, 0.0)
    for _ in range(20):  # until the strike begins
        motion.advance(0.0, PERIOD)
    assert motion.position_rad == pytest.approx(HAND.rest_rad, rel=0.0, abs=1e-15)
    assert motion.speed_rad_s == pytest.approx(0.0, abs=1e-12)


def test_friction_holds_the_handle_until_the_hand_pulls_harder() -> None:
    coulomb = 0.2
    hand = HAND.model_copy(update={"press_torque_nm": 0.0, "damping_nm_s_per_rad": 0.0})
    simulation = SMOOTH.model_copy(update={"coulomb_nm": coulomb, "hand": hand})
    way = hand.press_rad - hand.rest_rad
    breakaway = brentq(lambda t: -3.2 * way * least_jerk(hand, t) - coulomb, 0.02, 0.12, xtol=1e-12)
    motion = ServoMotion(simulation, PERIOD, COUNTS_PER_REV)
    for j in range(120):
        motion.advance(0.0, PERIOD)
        stuck = (j + 1) * PERIOD <= breakaway
        assert (motion.position_rad == hand.rest_rad) is stuck
    assert motion.position_rad < hand.rest_rad


def test_friction_holds_against_the_motor() -> None:
    simulation = SMOOTH.model_copy(update={"coulomb_nm": 0.2, "hand": Hand(strikes=0)})
    motion = ServoMotion(simulation, PERIOD, COUNTS_PER_REV)
    for torque in (0.19, -0.19, 0.1) * 20:
        motion.advance(torque, PERIOD)
    assert (motion.position_rad, motion.speed_rad_s) == (0.1, 0.0)
    motion.advance(0.3, PERIOD)
    # (0.3 − 0.2)/m over one period, against bearing, hand and spring that are hardly felt yet.
    assert motion.speed_rad_s == pytest.approx(0.1 / 1.64e-4 * PERIOD, rel=0.1)


def resting_at(position: float, counts_per_rev: float) -> ServoMotion:
    hand = HAND.model_copy(update={"rest_rad": position})
    return ServoMotion(SMOOTH.model_copy(update={"hand": hand}), PERIOD, counts_per_rev)


@pytest.mark.parametrize("step", [-0.51, -0.49, 0.49, 0.51, 12345.49, -12345.51])
def test_counts_are_the_nearest(step: float) -> None:
    motion = resting_at(step * 2.0 * math.pi / COUNTS_PER_REV, COUNTS_PER_REV)
    assert motion.counts() == round(step)


@settings(derandomize=True, deadline=None, max_examples=50)
@given(st.floats(-1e4, 1e4), st.floats(100.0, 1e7))
def test_counts_are_off_by_half_a_count_at_the_most(position: float, counts_per_rev: float) -> None:
    motion = resting_at(position, counts_per_rev)
    exact = position / (2.0 * math.pi) * counts_per_rev
    assert abs(motion.counts() - exact) <= 0.5 + 1e-12 * abs(exact)


@pytest.mark.parametrize("bandwidth", [0.0, 50.0, 200.0])
def test_velocity_is_the_difference_of_the_encoder_through_its_filter(
    bandwidth: float,
) -> None:
    simulation = SMOOTH.model_copy(update={"velocity_filter_hz": bandwidth})
    motion = ServoMotion(simulation, PERIOD, COUNTS_PER_REV)
    assert motion.speed_counts_per_s() == 0.0
    counts, quotients, seen = [motion.counts()], [], []
    for j in range(200):
        # However the period is divided, the drive looks at its encoder once in it.
        for share in (0.25, 0.75) if j % 3 else (1.0,):
            motion.advance(torque_at(j), share * PERIOD)
        counts.append(motion.counts())
        quotients.append((counts[-1] - counts[-2]) / PERIOD)
        seen.append(motion.speed_counts_per_s())
    assert max(map(abs, quotients)) > 10_000.0
    expected = np.array(quotients)
    if bandwidth:
        # Zero-order-hold equivalent of 1/(1 + s/ω), by scipy.
        omega = 2.0 * math.pi * bandwidth
        num, den, _ = cont2discrete(([omega], [1.0, omega]), PERIOD)
        expected = lfilter(num[0][1:], den, expected)
    np.testing.assert_allclose(seen, expected, rtol=1e-12, atol=1e-6)


def test_script_is_a_function_of_time_however_periods_are_divided() -> None:
    rng = np.random.default_rng(3)
    whole = ServoMotion(SMOOTH, PERIOD, COUNTS_PER_REV)
    parts = ServoMotion(SMOOTH, PERIOD, COUNTS_PER_REV)
    for _ in range(330):
        torque = float(rng.normal(0.0, 0.1))
        whole.advance(torque, PERIOD)
        share = float(rng.uniform(0.0, 1.0))
        parts.advance(torque, share * PERIOD)
        parts.advance(torque, (1.0 - share) * PERIOD)
        assert parts.position_rad == pytest.approx(whole.position_rad, rel=0.0, abs=1e-12)
        assert parts.speed_rad_s == pytest.approx(whole.speed_rad_s, rel=0.0, abs=1e-9)
    coarse = ServoMotion(SMOOTH, PERIOD, COUNTS_PER_REV)
    fine = ServoMotion(SMOOTH, PERIOD, COUNTS_PER_REV)
    coarse.advance(0.05, 0.2)
    for _ in range(1000):
        fine.advance(0.05, 0.0002)
    assert fine.position_rad == pytest.approx(coarse.position_rad, rel=0.0, abs=1e-11)


@pytest.mark.parametrize("bandwidth", [20.0, 1600.0])
def test_a_torque_step_arrives_as_the_lag_lets_it(bandwidth: float) -> None:
    hand = Hand(strikes=0, inertia_kg_m2=0.0, damping_nm_s_per_rad=0.0, stiffness_nm_per_rad=0.0)
    simulation = Simulation(
        inertia_kg_m2=1e-4,
        viscous_nm_s_per_rad=0.0,
        coulomb_nm=0.0,
        cogging_nm=0.0,
        torque_step_nm=0.0,
        current_bandwidth_hz=bandwidth,
        drive_cycle_s=0.0,
        hand=hand,
    )
    motion = ServoMotion(simulation, PERIOD, COUNTS_PER_REV)
    lag = 1.0 / (2.0 * math.pi * bandwidth)
    for j in range(1, 40):
        motion.advance(0.3, 0.37 * PERIOD)
        t = j * 0.37 * PERIOD
        left = math.exp(-t / lag)
        assert motion.torque_nm() == pytest.approx(0.3 * (1.0 - left), rel=1e-12)
        speed = 0.3 / 1e-4 * (t - lag * (1.0 - left))
        way = 0.3 / 1e-4 * (0.5 * t**2 - lag * t + lag**2 * (1.0 - left))
        assert motion.speed_rad_s == pytest.approx(speed, rel=1e-10)
        assert motion.position_rad - hand.rest_rad == pytest.approx(way, rel=1e-8, abs=1e-15)


def test_the_current_loop_knows_torques_in_steps() -> None:
    simulation = SMOOTH.model_copy(update={"torque_step_nm": 0.01, "current_bandwidth_hz": 0.0})
    stepped = ServoMotion(simulation, PERIOD, COUNTS_PER_REV)
    smooth = ServoMotion(
        SMOOTH.model_copy(update={"torque_step_nm": 0.0, "current_bandwidth_hz": 0.0}),
        PERIOD,
        COUNTS_PER_REV,
    )
    for torque, step in ((0.0149, 0.01), (0.0151, 0.02), (-0.0049, 0.0), (-0.306, -0.31)):
        stepped.advance(torque, PERIOD)
        smooth.advance(step, PERIOD)
        assert stepped.position_rad == pytest.approx(smooth.position_rad, rel=1e-14)
    assert stepped.torque_nm() is None


def test_a_motion_that_is_no_number_is_an_error() -> None:
    motion = ServoMotion(SMOOTH, PERIOD, COUNTS_PER_REV)
    with pytest.raises(ArithmeticError, match="not a number"):
        motion.advance(math.nan, PERIOD)
