"""Friction that holds more at rest than in motion, against closed forms and scipy."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from canwall.physics import Force, Grasp, HandBody, advance, advance_grasp, make_plant

COULOMB, STICTION = 0.01, 0.015


def test_it_holds_up_to_stiction_and_then_moves_against_coulomb() -> None:
    plant = make_plant(2e-4, coulomb=COULOMB, stiction=STICTION)[0]
    assert advance(plant, 0.1, 0.0, 0.999 * STICTION, 0.0, 1.0)[:2] == (0.1, 0.0)
    y, v, _ = advance(plant, 0.0, 0.0, 1.001 * STICTION, 0.0, 0.1)
    accelerates = (1.001 * STICTION - COULOMB) / 2e-4
    assert (y, v) == pytest.approx((0.5 * accelerates * 0.01, accelerates * 0.1), rel=1e-12)


@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_a_ramp_breaks_it_loose_at_its_time(direction: float) -> None:
    mass, slope = 2e-4, direction * 0.3
    plant = make_plant(mass, coulomb=COULOMB, stiction=STICTION)[0]
    loose = STICTION / 0.3
    y, v, _ = advance(plant, 0.0, 0.0, 0.0, slope, loose + 0.02)
    a, t = direction * (STICTION - COULOMB) / mass, 0.02
    assert v == pytest.approx(a * t + 0.5 * slope / mass * t**2, rel=1e-11)
    assert y == pytest.approx(0.5 * a * t**2 + slope / mass * t**3 / 6.0, rel=1e-11)


def test_a_lag_breaks_it_loose_at_its_time() -> None:
    mass, demand, rate = 2e-4, 0.02, 2.0 * math.pi * 300.0
    plant = make_plant(mass, coulomb=COULOMB, stiction=STICTION)[0]
    loose = -math.log(1.0 - STICTION / demand) / rate
    t = 1e-3
    _, v, _ = advance(plant, 0.0, 0.0, 0.0, 0.0, loose + t, -demand, rate)
    gone = -math.expm1(-rate * t)
    impulse = (demand - COULOMB) * t - (demand - STICTION) / rate * gone
    assert v == pytest.approx(impulse / mass, rel=1e-9)


def test_a_spring_drawn_at_constant_speed_slips_as_scipy_has_it() -> None:
    """The classic stick-slip: mass on a spring whose end moves."""
    mass, spring, viscous, speed, end = 1e-3, 4.0, 2e-3, 0.05, 1.55
    plant = make_plant(mass, viscous, spring, COULOMB, stiction=5 * COULOMB)[0]
    y, t, slips = 0.0, 0.0, 0
    while True:
        t = max(t, brentq(lambda s, y=y: spring * (speed * s - y) - 5 * COULOMB, -10.0, 10.0))  # type: ignore[misc]
        if t >= end:
            break
        slips += 1

        def derivative(s: float, state: Any) -> list[float]:
            pull = spring * (speed * s - state[0]) - viscous * state[1] - COULOMB
            return [state[1], pull / mass]

        def stops(s: float, state: Any, t: float = t) -> float:
            return float(state[1]) if s > t + 1e-6 else 1.0

        stops.terminal = True  # type: ignore[attr-defined]
        slip = solve_ivp(
            derivative, (t, end), [y, 0.0], "DOP853", rtol=1e-12, atol=1e-14, events=stops
        )
        y, t = float(slip.y[0, -1]), float(slip.t[-1])
    assert slips > 1
    found = advance(plant, 0.0, 0.0, 0.0, spring * speed, end)
    assert found[:2] == pytest.approx((y, 0.0), abs=1e-9)


@settings(derandomize=True, deadline=None, max_examples=50)
@given(st.integers(0, 10_000), st.floats(1.0, 4.0))
def test_dividing_a_motion_changes_nothing(seed: int, ratio: float) -> None:
    draw = np.random.default_rng(seed)
    plant = make_plant(
        1e-4, 5e-4, 3.0, COULOMB, cogging=3e-3, cog_pitch=0.05, stiction=ratio * COULOMB
    )[0]
    whole = parts = (float(draw.uniform(-0.1, 0.1)), 0.0)
    for _ in range(10):
        u0, u1, cut = draw.uniform(-0.03, 0.03), draw.uniform(-10.0, 10.0), draw.uniform(0.0, 2e-3)
        whole = advance(plant, *whole, u0, u1, 2e-3)[:2]
        parts = advance(plant, *parts, u0, u1, cut)[:2]
        parts = advance(plant, *parts, u0 + u1 * cut, u1, 2e-3 - cut)[:2]
        assert parts == pytest.approx(whole, rel=1e-7, abs=1e-10)


def test_a_handle_that_breaks_loose_may_leave_the_hand() -> None:
    """Motor and hand push as one until the handle gives way; the light handle runs ahead."""
    mass, hand = 1e-4, HandBody(1e-3, 0.0, 0.0, 1.0)
    handle = make_plant(mass, coulomb=COULOMB, stiction=2 * COULOMB)
    joined = make_plant(mass + hand.mass, coulomb=COULOMB, stiction=2 * COULOMB)
    motor, script = Force(0.019, 0.0, 0.0, 0.0), Force(0.0, 0.05, 0.0, 0.0)
    loose, t = 0.001 / 0.05, 0.01
    found = advance_grasp(
        handle[0], joined[0], hand, Grasp(0.0, 0.0, 0.0, 0.0, True), motor, script, loose + t
    )
    assert not found.touching
    assert found.v == pytest.approx((0.019 - COULOMB) / mass * t, rel=1e-9)
    assert found.hand_v == pytest.approx((0.001 * t + 0.5 * 0.05 * t**2) / hand.mass, rel=1e-9)


def test_stiction_is_at_least_coulomb() -> None:
    with pytest.raises(ValueError, match="stiction of at least"):
        make_plant(1.0, coulomb=0.2, stiction=0.1)
