"""Begin and end of a contact, compared with closed forms and SciPy's event search."""

import math
from dataclasses import astuple

import pytest
from hybrid_motion import Handle, integrate
from hypothesis import given, settings
from hypothesis import strategies as st

from canwall.physics import contact_end, make_plant, time_to_wall

GRAVITY = 9.81
BOUNDED = settings(derandomize=True, deadline=None, max_examples=40)


def ends(handle: Handle, y: float, v: float, u: float, horizon: float) -> tuple[float, float]:
    return contact_end(make_plant(*astuple(handle))[0], y, v, u, horizon)


@BOUNDED
@given(st.floats(0.01, 2.0), st.floats(-5.0, 5.0))
def test_a_falling_mass_strikes_on_time(y: float, v: float) -> None:
    strike = (v + math.sqrt(v**2 + 2.0 * GRAVITY * y)) / GRAVITY
    plant = make_plant(1.0, wall_stiffness=100.0)[0]
    for end in (1.01 * strike, 3.0 * strike):
        assert time_to_wall(plant, y, v, -GRAVITY, end) == pytest.approx(strike, rel=1e-13)


def test_a_sprung_mass_strikes_on_time() -> None:
    mass, spring, y = 0.2, 5.0, 0.4
    omega = math.sqrt(spring / mass)
    plant = make_plant(mass, spring=spring, wall_stiffness=100.0)[0]
    strike = time_to_wall(plant, y, 0.0, 0.0, 0.75 * math.pi / omega)
    assert strike == pytest.approx(0.5 * math.pi / omega, rel=1e-14)


@BOUNDED
@given(st.floats(0.01, 2.0), st.floats(-5.0, 5.0), st.floats(1.0, 1e5))
def test_a_contact_ahead_on_an_undamped_wall(y: float, v: float, stiffness: float) -> None:
    speed, omega = math.sqrt(v**2 + 2.0 * GRAVITY * y), math.sqrt(stiffness)
    strike = (v + speed) / GRAVITY
    in_contact = (math.pi + 2.0 * math.atan(GRAVITY / (omega * speed))) / omega
    handle = Handle(1.0, wall_stiffness=stiffness)
    expected = (strike + in_contact, speed)
    assert ends(handle, y, v, -GRAVITY, 1.001 * strike) == pytest.approx(expected, rel=1e-11)
    assert ends(handle, y, v, -GRAVITY, 0.999 * strike) == (math.inf, 0.0)


@BOUNDED
@given(st.floats(-2.0, -0.01), st.floats(-5.0, 5.0), st.floats(10.0, 1e5))
def test_a_contact_that_is_on(y: float, v: float, stiffness: float) -> None:
    omega = math.sqrt(stiffness)
    c1, c2 = y + GRAVITY / stiffness, v / omega
    amplitude = math.hypot(c1, c2)
    s = GRAVITY / stiffness / amplitude
    if s > 0.999999:
        return
    expected = math.fmod(math.asin(s) - math.atan2(c1, c2) + 4.0 * math.pi, 2.0 * math.pi) / omega
    end, v_end = ends(Handle(1.0, wall_stiffness=stiffness), y, v, -GRAVITY, 1e-3)
    assert end == pytest.approx(expected, rel=1e-9)
    assert v_end == pytest.approx(omega * amplitude * math.sqrt(1.0 - s * s), rel=1e-9)


@pytest.mark.parametrize("start", [(0.3, -1.0), (-0.05, 2.0), (-0.05, -2.0)])
@pytest.mark.parametrize(
    "handle",
    [
        Handle(0.5, 0.1, 0.0, 0.0, 800.0, 4.0),
        Handle(0.5, 0.1, 3.0, 0.0, 800.0, 4.0),
        Handle(0.5, 0.1, 3.0, 0.5, 800.0, 4.0),
        Handle(0.5, 0.0, 0.0, 0.5, 800.0, 0.0),
    ],
)
def test_any_contact_ends_at_the_threshold(handle: Handle, start: tuple[float, float]) -> None:
    end, v_end = ends(handle, *start, -2.0, 1.0)
    reference = integrate(handle, *start, -2.0, 0.0, end)
    assert reference.y == pytest.approx(0.0, abs=1e-10)
    assert reference.v == pytest.approx(v_end, rel=1e-9)
    assert v_end > 0.0
    assert integrate(handle, *start, -2.0, 0.0, 0.999 * end).y < 0.0


@pytest.mark.parametrize("y", [0.1, 0.0, -0.01])
def test_what_turns_round_inside_stays(y: float) -> None:
    # Overdamped or nearly so, and pressed in: it comes to rest inside.
    for damping in (30.0, 60.0, 500.0):
        handle = Handle(0.5, wall_stiffness=800.0, wall_damping=damping)
        assert ends(handle, y, -1.0, -2.0, 1.0) == (math.inf, 0.0)


def test_what_sticks_inside_stays() -> None:
    assert ends(Handle(0.5, coulomb=3.0, wall_stiffness=800.0), -1e-3, 0.0, -2.0, 1.0) == (
        math.inf,
        0.0,
    )


def test_no_contact_without_a_push() -> None:
    handle = Handle(1.0, wall_stiffness=100.0)
    assert ends(handle, 0.1, 0.0, 0.0, 10.0) == (math.inf, 0.0)
    assert ends(handle, 0.1, 1.0, 3.0, 10.0) == (math.inf, 0.0)
    assert ends(Handle(1.0), -0.1, -1.0, -3.0, 10.0) == (math.inf, 0.0)
