"""A hand that can lose its handle: against scipy's event search, and what has to hold always."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from two_bodies import Handle, Log, at, integrate, moved

from canwall.physics import Force, Grasp, HandBody

STILL = Force(0.0, 0.0, 0.0, 0.0)
BOUNDED = settings(derandomize=True, deadline=None, max_examples=100)


def constant(value: float) -> Force:
    return Force(value, 0.0, 0.0, 0.0)


def energy(handle: Handle, hand: HandBody, now: Grasp) -> float:
    kinetic = 0.5 * handle.mass * now.v**2 + 0.5 * hand.mass * now.hand_v**2
    return kinetic + 0.5 * hand.spring * now.hand_y**2 + handle.cog_energy(now.y)


CASES = {
    "a hand that is drawn back": (
        Handle(1.0, 0.3, 0.05),
        HandBody(0.6, 0.2, 8.0, -1.0),
        Grasp(0.0, 0.0, 0.0, 0.0, True),
        STILL,
        Force(-0.6, 1.0, 0.0, 0.0),
        3.0,
    ),
    "thrown off and caught": (
        Handle(1.0, 0.1, 0.02),
        HandBody(0.4, 0.3, 20.0, -1.0),
        Grasp(0.1, -1.0, 0.1, -1.0, True),
        Force(3.0, -2.0, 0.0, 0.0),
        constant(-1.0),
        6.0,
    ),
    "a motor torque with a lag": (
        Handle(0.5, 0.05, 0.1),
        HandBody(0.7, 0.1, 5.0, 1.0),
        Grasp(0.0, 0.0, 0.0, 0.0, True),
        Force(-1.0, 0.2, -2.5, 8.0),
        Force(0.4, 0.1, 0.0, 0.0),
        5.0,
    ),
    "over cogs": (
        Handle(1.0, 0.2, 0.05, 0.4, 0.3),
        HandBody(0.6, 0.3, 3.0, -1.0),
        Grasp(0.5, -0.4, 0.9, -1.5, False),
        Force(0.3, -0.3, 1.0, 5.0),
        Force(-0.5, 0.3, 0.0, 0.0),
        5.0,
    ),
    "over cogs without friction": (
        Handle(1.0, 0.0, 0.0, 0.4, 0.3),
        HandBody(0.6, 0.0, 9.0, -1.0),
        Grasp(0.02, 0.0, 0.9, -1.5, False),
        STILL,
        constant(-0.5),
        8.0,
    ),
    "a handle that is stuck is struck": (
        Handle(1.0, 0.0, 0.8),
        HandBody(0.6, 0.1, 4.0, -1.0),
        Grasp(0.0, 0.0, 1.0, 0.0, False),
        constant(0.3),
        STILL,
        6.0,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_as_the_event_search_finds_it(case: str) -> None:
    handle, hand, now, motor, script, duration = CASES[case]
    log = Log()
    expected = integrate(handle, hand, now, motor, script, duration, 0.05, log)
    assert log.partings + log.impacts >= 1
    found = moved(handle, hand, now, motor, script, duration)
    assert found.touching is expected.touching
    assert found[:4] == pytest.approx(expected[:4], rel=0.0, abs=1e-8)


@st.composite
def motions(draw: st.DrawFn) -> tuple[Handle, HandBody, Grasp, Force, Force]:
    def number(low: float, high: float) -> float:
        return draw(st.integers(round(low * 1000), round(high * 1000))) / 1000

    cogging = draw(st.sampled_from([0.0, 0.2]))
    coulomb = draw(st.sampled_from([0.0, 0.1, 0.5]))
    handle = Handle(number(0.1, 3.0), number(0.0, 0.5), coulomb, cogging, 0.5)
    side = draw(st.sampled_from([-1.0, 1.0]))
    hand = HandBody(number(0.1, 3.0), number(0.0, 0.5), number(0.0, 9.0), side)
    y, v = number(-1.0, 1.0), number(-2.0, 2.0)
    if draw(st.booleans()):
        now = Grasp(y, v, y, v, True)
    else:
        now = Grasp(y, v, y - side * number(0.01, 1.0), number(-2.0, 2.0), False)
    excess = draw(st.sampled_from([0.0, 1.0, -2.0]))
    motor = Force(number(-2.0, 2.0), number(-2.0, 2.0), excess, number(0.1, 30.0))
    return handle, hand, now, motor, Force(number(-2.0, 2.0), number(-2.0, 2.0), 0.0, 0.0)


@pytest.mark.slow
@settings(derandomize=True, deadline=None, max_examples=200)
@given(motions())
def test_any_motion_is_that_of_the_event_search(
    case: tuple[Handle, HandBody, Grasp, Force, Force],
) -> None:
    handle, hand, now, motor, script = case
    expected = integrate(handle, hand, now, motor, script, 1.0, 0.05)
    found = moved(handle, hand, now, motor, script, 1.0)
    assert found[:4] == pytest.approx(expected[:4], rel=0.0, abs=1e-8)


@BOUNDED
@given(motions())
def test_the_hand_is_never_pulled_nor_beyond_the_handle(
    case: tuple[Handle, HandBody, Grasp, Force, Force],
) -> None:
    """The impulse of the contact over a short time agrees with the motion of the hand."""
    handle, hand, now, motor, script = case
    step = 2.0**-7
    for j in range(128):
        motor_now = Force(
            at(motor, j * step),
            motor.slope,
            motor.excess * math.exp(-motor.rate * j * step),
            motor.rate,
        )
        script_now = Force(at(script, j * step), script.slope, 0.0, 0.0)
        before = now
        now = moved(handle, hand, before, motor_now, script_now, step)
        assert hand.side * (now.y - now.hand_y) >= -1e-13
        # The hand alone would have gone further towards the handle, or as far.
        alone = moved(
            Handle(1.0),
            hand,
            before._replace(y=before.y + hand.side * 1e3, touching=False),
            STILL,
            script_now,
            step,
        )
        push = hand.side * hand.mass * (alone.hand_v - now.hand_v)
        # Impulse of the contact on the hand, to first order in the step.
        stray = (hand.viscous * step + hand.spring * step**2) * abs(alone.hand_v - now.hand_v)
        assert push >= -1e-12 - stray


def test_an_impact_keeps_momentum_and_loses_the_energy_of_the_relative_motion() -> None:
    handle, hand = Handle(1.3), HandBody(0.7, 0.0, 0.0, -1.0)
    v, hand_v, gap = 0.4, -1.1, 0.3
    now = moved(handle, hand, Grasp(0.0, v, gap, hand_v, False), STILL, STILL, 1.0)
    meeting = gap / (v - hand_v)
    both = (1.3 * v + 0.7 * hand_v) / 2.0
    assert now.touching
    assert now.v == now.hand_v == pytest.approx(both, rel=1e-15)
    assert now.y == now.hand_y == pytest.approx(v * meeting + both * (1.0 - meeting), rel=1e-14)
    lost = 0.5 * 1.3 * 0.7 / 2.0 * (v - hand_v) ** 2
    before = 0.5 * 1.3 * v**2 + 0.5 * 0.7 * hand_v**2
    assert before - energy(handle, hand, now) == pytest.approx(lost, rel=1e-14)


def test_parts_at_the_instant_at_which_it_would_pull() -> None:
    # Both swing on the hand's spring from compression; the contact force m·ω²·(depth)·cos(ωt)
    # is that which accelerates the handle, and turns where the spring is at its rest.
    handle, hand = Handle(1.0), HandBody(3.0, 0.0, 4.0, 1.0)
    quarter = 0.5 * math.pi
    start = Grasp(-0.2, 0.0, -0.2, 0.0, True)
    for share, touching in ((0.999999, True), (1.000001, False)):
        now = moved(handle, hand, start, STILL, STILL, share * quarter)
        assert now.touching is touching
    later = moved(handle, hand, start, STILL, STILL, quarter + 1.0)
    assert later.v == pytest.approx(0.2, rel=1e-12)
    assert later.y == pytest.approx(0.2, rel=1e-12)
    omega = math.sqrt(4.0 / 3.0)
    assert later.hand_v == pytest.approx(0.2 * math.cos(omega), rel=1e-12)


@BOUNDED
@given(motions())
def test_neither_friction_nor_contact_makes_energy(
    case: tuple[Handle, HandBody, Grasp, Force, Force],
) -> None:
    handle, hand, now, motor, script = case
    push, press = motor.constant, script.constant
    for _ in range(50):
        before = now
        now = moved(handle, hand, before, constant(push), constant(press), 0.05)
        work = push * (now.y - before.y) + press * (now.hand_y - before.hand_y)
        size = energy(handle, hand, before) + abs(work) + 1.0
        gain = energy(handle, hand, now) - energy(handle, hand, before) - work
        assert gain <= 1e-13 * size


def test_a_hand_that_rests_on_a_handle_stays() -> None:
    handle, hand = (
        Handle(1e-4, 5e-4, 0.01, 0.003, 2.0 * math.pi / 24.0),
        HandBody(6.4e-5, 0.0256, 3.2, -1.0),
    )
    now = Grasp(0.1, 0.0, 0.1, 0.0, True)
    for _ in range(20):
        now = moved(handle, hand, now, STILL, constant(0.32), 1e-3)
    assert now.touching
    assert np.all(np.array(now[:4]) == (0.1, 0.0, 0.1, 0.0))
