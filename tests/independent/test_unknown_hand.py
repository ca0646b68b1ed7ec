"""Stiff and quiet in any hand, on a plant written apart from the package.

`figures.py` beside this file has the whole tables; here is a share of them.
"""

import math

import numpy as np
import pytest
from figures import after_change, first_strikes, sampled, unknown_hand
from plant import FORCES, OPERATORS, SERVOS, STRIKES, Bench, Servo, judge, ripple
from scipy.integrate import solve_ivp

pytestmark = pytest.mark.slow


def test_continuous_wall_of_the_plant_is_that_of_scipy() -> None:
    servo, hand = SERVOS["1600"]._replace(coulomb=0.0), OPERATORS["grip"]
    strike, stiffness, damping = STRIKES[4], 100.0, 0.2
    s = Bench(sampled("damped"), servo, 0.2).strike(hand, strike, stiffness, damping)
    mass, viscous = servo.mass + hand.mass, servo.viscous + hand.viscous
    lead = hand.viscous * strike.speed / hand.spring
    deepest = strike.press / hand.spring

    def motion(t: float, x: tuple[float, float]) -> tuple[float, float]:
        y, v = x
        rest = max(strike.speed * (strike.contact_s - t) - lead, -deepest - lead)
        wall = max(0.0, -stiffness * y - damping * v) if y < 0.0 else 0.0
        return v, (wall + hand.spring * (rest - y) - viscous * v) / mass

    start = (strike.contact_s + strike.phase * 1e-3) * strike.speed
    t = np.arange(len(s.y)) * s.period
    exact = solve_ivp(motion, (0.0, t[-1]), (start, -strike.speed), t_eval=t, max_step=1e-5).y[0]
    np.testing.assert_allclose(s.referent_y, exact, atol=2e-5)


def test_ripple_is_that_of_a_sine() -> None:
    t = np.arange(300 * FORCES) * 1e-3 / FORCES
    inside, outside = np.sin(2.0 * math.pi * 100.0 * t), np.sin(2.0 * math.pi * 10.0 * t)
    assert ripple(inside, 1e-3) == pytest.approx(math.sqrt(0.5), rel=1e-3)
    assert ripple(outside + 3.0, 1e-3) < 0.1


@pytest.mark.parametrize("name", OPERATORS)
def test_wall_is_stiff_and_quiet_in_every_hand(name: str) -> None:
    """One configuration for all, at five to fifty times the limit of the standard wall."""
    servo, hand = SERVOS["1600"], OPERATORS[name]
    mass = servo.mass + hand.mass
    stiffness = 0.5 * mass / 1e-6
    bench, standard = Bench(unknown_hand(servo), servo), Bench(sampled("standard"), servo)
    damping = math.sqrt(stiffness * mass)
    for strike in STRIKES[1::3]:
        s = bench.strike(hand, strike, stiffness, referent_damping=damping)
        assert judge(s)[0], strike
        assert s.mass[-1] == pytest.approx(mass, rel=0.2), strike
        assert not judge(standard.strike(hand, strike, stiffness))[0]


def test_first_strike_is_no_deeper_than_twice_and_throws_no_hand_back() -> None:
    servo = SERVOS["1600"]
    bench = Bench(unknown_hand(servo), servo, 0.5)
    for name, hand in OPERATORS.items():
        depths, exits = first_strikes(bench, hand, 200.0, 6)
        assert max(depths) < 2.3, name
        assert max(exits) < 1.0, name


def test_handle_that_nobody_holds_is_stopped_as_soon_as_by_the_continuous_wall() -> None:
    """At K·T²/m = 2: with what the filter was behind of the push it went in 1.8 times as deep."""
    servo = SERVOS["800"]
    bench = Bench(unknown_hand(servo), servo, 0.5)
    depths, exits = first_strikes(bench, OPERATORS["none"], 200.0, 300)
    assert max(depths[:12]) < 1.55
    assert max(depths) < 1.85
    # Where it is stopped just before the wall, noise decides how its next touch ends.
    assert np.sum(np.array(exits) > 1.0) <= 2
    assert max(exits) < 1.2


def test_light_hand_that_takes_over_from_an_arm_is_quiet_soon() -> None:
    servo = SERVOS["1600"]
    bench = Bench(unknown_hand(servo, **{"wall.cap": 0.8}), servo)
    # How long friction holds the handle before is no merit of the law: 0.14 to 0.26 s.
    _, loud_s, burst = after_change(bench, OPERATORS["arm"], OPERATORS["finger20"])
    assert 0.0 < loud_s < 0.1
    assert burst < 8.0


@pytest.mark.parametrize("servo", SERVOS.values(), ids=SERVOS)
@pytest.mark.parametrize(
    ("light", "heavy"),
    [("finger", "arm"), ("finger", "hand"), ("finger20", "arm"), ("finger20", "hand")],
)
def test_heavy_hand_that_takes_over_without_friction_is_quiet_soon(
    servo: Servo, light: str, heavy: str
) -> None:
    """The wall of the light hand swings, from nothing: the mass is known before that is loud."""
    servo = servo._replace(coulomb=0.0)
    bench = Bench(unknown_hand(servo, **{"wall.cap": 0.8}), servo)
    quiet_s, loud_s, burst = after_change(bench, OPERATORS[light], OPERATORS[heavy])
    assert quiet_s <= 0.15
    assert loud_s < 0.06
    assert burst < 3.0


def test_cap_keeps_any_stiffness_quiet() -> None:
    servo = SERVOS["1600"]
    bench = Bench(unknown_hand(servo, **{"wall.cap": 1.0}), servo)
    for name in ("finger20", "grip", "hand"):
        hand = OPERATORS[name]
        most = (servo.mass + hand.mass) / bench.period**2
        for strike in STRIKES[::3]:
            s = bench.strike(hand, strike, 5000.0, referent_damping=most * bench.period)
            assert judge(s)[0], (name, strike)
            assert s.stiffness_in_force[-1] < 1.35 * most
