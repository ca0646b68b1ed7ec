"""Bounces on the continuous wall against closed forms and scipy's event search."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
from hybrid_motion import Handle, integrate, moved, thousandths, touches
from hypothesis import given, settings
from hypothesis import strategies as st
from numbers_drawn import or_zero

from canwall.physics import flow, make_plant

GRAVITY = 9.81
BOUNDED = settings(derandomize=True, deadline=None, max_examples=60)


def bounce_period(stiffness: float, height: float) -> float:
    """From rest at `height` back to it: unit mass, gravity, undamped wall (5.7–5.10, corrected)."""
    speed, omega = math.sqrt(2.0 * GRAVITY * height), math.sqrt(stiffness)
    in_contact = (math.pi + 2.0 * math.atan(GRAVITY / (omega * speed))) / omega
    return 2.0 * speed / GRAVITY + in_contact


def test_free_fall_until_the_strike() -> None:
    handle = Handle(1.0, wall_stiffness=100.0)
    y0, v0 = 2.0, 3.0
    strike = (v0 + math.sqrt(v0**2 + 2.0 * GRAVITY * y0)) / GRAVITY
    y, v = moved(handle, y0, v0, -GRAVITY, 0.0, strike)
    assert y == pytest.approx(0.0, abs=1e-14)
    assert v == pytest.approx(-math.sqrt(v0**2 + 2.0 * GRAVITY * y0), rel=1e-15)
    assert not touches(handle, y0, v0, -GRAVITY, 0.0, 0.999 * strike)
    assert touches(handle, y0, v0, -GRAVITY, 0.0, 1.001 * strike)


@pytest.mark.parametrize("stiffness", [1.0, 100.0, 1e6])
def test_undamped_bounces_repeat_themselves(stiffness: float) -> None:
    handle = Handle(1.0, wall_stiffness=stiffness)
    for bounces in (1, 2, 50):
        duration = bounces * bounce_period(stiffness, 1.5)
        y, v = moved(handle, 1.5, 0.0, -GRAVITY, 0.0, duration)
        assert y == pytest.approx(1.5, rel=1e-11)
        # The turning point is hit to the last bits of its time.
        assert v == pytest.approx(0.0, abs=GRAVITY * duration * 1e-11)


def test_undamped_bounces_keep_their_energy() -> None:
    handle = Handle(0.02, spring=0.5, wall_stiffness=3e3)
    weight = handle.mass * GRAVITY
    y, v = 0.7, -1.0
    start = handle.energy(y, v) + weight * y
    for _ in range(200):
        y, v = moved(handle, y, v, -weight, 0.0, 0.3737)
        assert handle.energy(y, v) + weight * y == pytest.approx(start, rel=1e-11)


@pytest.mark.parametrize(
    "handle",
    [
        Handle(1.0, wall_stiffness=1000.0),
        Handle(1.0, spring=3.0, wall_stiffness=1000.0),
        Handle(1.0, 0.001, wall_stiffness=2000.0, wall_damping=0.05),
        Handle(1.0, 0.001, spring=3.0, wall_stiffness=2000.0, wall_damping=0.05),
        Handle(1.0, spring=3.0, wall_stiffness=3000.0, wall_damping=0.5, coulomb=0.01),
    ],
)
def test_fifty_bounces(handle: Handle) -> None:
    reference = integrate(handle, 0.5, 0.0, -GRAVITY, 0.0, 40.0)
    assert reference.bounces >= 50
    y, v = moved(handle, 0.5, 0.0, -GRAVITY, 0.0, 40.0)
    assert y == pytest.approx(reference.y, rel=0.0, abs=1e-8)
    assert v == pytest.approx(reference.v, rel=0.0, abs=1e-8)


@pytest.mark.parametrize(
    ("handle", "u0", "u1"),
    [
        (Handle(1.0, wall_damping=3.0), -0.5, 0.0),
        (Handle(1.0, wall_damping=3.0), -1.0, 0.5),
        (Handle(1.0, wall_stiffness=50.0, wall_damping=40.0), -9.0, 0.0),
        (Handle(1.0, wall_stiffness=50.0, wall_damping=40.0), -9.0, 4.0),
        (Handle(0.1, 0.1, 2.0, 0.3, 500.0, 1.0), -3.0, 0.0),
        (Handle(0.1, 0.1, 2.0, 0.3, 500.0, 1.0), -8.0, 3.0),
        (Handle(0.1, 0.0, 2.0, 0.0, 500.0, 0.0), 4.0, -3.0),
        (Handle(0.1, 0.5, 0.0, 0.3, 0.0, 0.0), -2.0, 1.0),
    ],
)
def test_every_combination_of_wall_and_friction(handle: Handle, u0: float, u1: float) -> None:
    for duration in (0.1, 0.7, 2.0, 6.0):
        reference = integrate(handle, 0.4, -1.0, u0, u1, duration)
        y, v = moved(handle, 0.4, -1.0, u0, u1, duration)
        assert y == pytest.approx(reference.y, rel=1e-9, abs=1e-9)
        assert v == pytest.approx(reference.v, rel=1e-9, abs=1e-9)


handles = st.builds(
    Handle,
    mass=thousandths(0.1, 10.0),
    viscous=or_zero(thousandths(0.01, 3.0)),
    spring=or_zero(thousandths(0.1, 10.0)),
    coulomb=or_zero(thousandths(0.01, 3.0)),
    wall_stiffness=or_zero(thousandths(1.0, 300.0)),
    wall_damping=or_zero(thousandths(0.01, 30.0)),
)
starts = st.tuples(thousandths(-1.0, 1.0), or_zero(thousandths(-5.0, 5.0)))
forces = st.tuples(thousandths(-10.0, 10.0), or_zero(thousandths(-5.0, 5.0)))


@BOUNDED
@given(handles, starts, forces, thousandths(0.0, 4.0))
def test_any_motion(
    handle: Handle, start: tuple[float, float], force: tuple[float, float], duration: float
) -> None:
    reference = integrate(handle, *start, *force, duration)
    y, v = moved(handle, *start, *force, duration)
    assert y == pytest.approx(reference.y, rel=1e-8, abs=1e-8)
    assert v == pytest.approx(reference.v, rel=1e-8, abs=1e-8)


@BOUNDED
@given(handles, starts, forces, st.lists(st.floats(0.0, 0.7), min_size=2, max_size=8))
def test_pieces_of_time_make_the_whole(
    handle: Handle, start: tuple[float, float], force: tuple[float, float], pieces: list[float]
) -> None:
    instants = [0.0]
    for piece in pieces:
        instants.append(instants[-1] + piece)
    y, v = start
    u0, u1 = force
    for before, after in pairwise(instants):
        y, v = moved(handle, y, v, u0 + u1 * before, u1, after - before)
    assert (y, v) == pytest.approx(moved(handle, *start, *force, instants[-1]), rel=0.0, abs=1e-9)


@BOUNDED
@given(handles, starts, forces, *[st.floats(-6.0, 6.0)] * 3)
def test_units_do_not_matter(
    handle: Handle,
    start: tuple[float, float],
    force: tuple[float, float],
    kilogram_log: float,
    metre_log: float,
    second_log: float,
) -> None:
    kilogram, metre, second = 10.0**kilogram_log, 10.0**metre_log, 10.0**second_log
    newton = kilogram * metre / second**2
    in_other_units = Handle(
        handle.mass * kilogram,
        handle.viscous * kilogram / second,
        handle.spring * kilogram / second**2,
        handle.coulomb * newton,
        handle.wall_stiffness * kilogram / second**2,
        handle.wall_damping * kilogram / second,
    )
    y, v = moved(
        in_other_units,
        start[0] * metre,
        start[1] * metre / second,
        force[0] * newton,
        force[1] * newton / second,
        2.0 * second,
    )
    expected = moved(handle, *start, *force, 2.0)
    assert (y / metre, v / metre * second) == pytest.approx(expected, rel=0.0, abs=1e-9)


@pytest.mark.parametrize("zero", [0.0, -0.0])
def test_on_the_threshold_motion_and_push_decide(zero: float) -> None:
    handle = Handle(2.0, spring=1.0, wall_stiffness=72.0)
    inside, t = replace(handle, spring=73.0), 0.1
    for v, u0, acts in (
        (-1.0, 0.0, True),
        (-1.0, 5.0, True),
        (zero, -5.0, True),
        (zero, 5.0, False),
        (1.0, 5.0, False),
    ):
        stiff = inside.spring if acts else handle.spring
        expected = flow(2.0, 0.0, stiff, 0.0, v, u0, 0.0, t)
        assert moved(handle, zero, v, u0, 0.0, t) == pytest.approx(expected, rel=1e-13)
        assert touches(handle, zero, v, u0, 0.0, t) is acts


def test_at_rest_on_the_threshold_it_stays() -> None:
    handle = Handle(1.0, wall_stiffness=100.0)
    assert moved(handle, 0.0, 0.0, 0.0, 0.0, 5.0) == (0.0, 0.0)
    assert not touches(handle, 0.0, 0.0, 0.0, 0.0, 5.0)


@pytest.mark.parametrize("slope", [-3.0, 3.0])
def test_a_ramp_takes_it_off_the_threshold(slope: float) -> None:
    handle = Handle(1.0, wall_stiffness=100.0)
    t = 0.2
    stiff = 100.0 if slope < 0.0 else 0.0
    expected = flow(1.0, 0.0, stiff, 0.0, 0.0, 0.0, slope, t)
    assert moved(handle, 0.0, 0.0, 0.0, slope, t) == pytest.approx(expected, rel=1e-12)


def test_at_rest_in_equilibrium_inside_it_stays() -> None:
    handle = Handle(1.0, spring=28.0, wall_stiffness=100.0)
    assert moved(handle, -0.25, 0.0, -32.0, 0.0, 1e3) == (-0.25, 0.0)


@pytest.mark.parametrize("duration", [0.0, -1.0])
def test_no_time_no_motion(duration: float) -> None:
    handle = Handle(1.0, 0.1, 2.0, 0.3, 500.0, 1.0)
    for state in ((0.3, -2.0), (-0.3, 2.0), (0.0, 0.0)):
        assert moved(handle, *state, 4.0, 1.0, duration) == state


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", range(4))
def test_what_is_not_finite_comes_back(place: int, bad: float) -> None:
    handle = Handle(1.0, 0.1, 2.0, 0.3, 500.0, 1.0)
    for speed in (0.0, -2.0, 2.0):
        y, v, u0, u1 = (bad if i == place else x for i, x in enumerate((0.3, speed, 4.0, 1.0)))
        assert len(moved(handle, y, v, u0, u1, 1.0)) == 2


@pytest.mark.parametrize("place", range(4))
def test_in_motion_a_nan_is_not_hidden(place: int) -> None:
    handle = Handle(1.0, 0.1, 2.0, 0.3, 500.0, 1.0)
    start = (math.nan if i == place else x for i, x in enumerate((0.3, -2.0, 4.0, 1.0)))
    y, v, u0, u1 = start
    y, v = moved(handle, y, v, u0, u1, 1.0)
    assert math.isnan(y)
    assert math.isnan(v)


def test_a_motion_with_too_many_events_is_given_up() -> None:
    handle = Handle(1.0, wall_stiffness=1e12)
    y, v = moved(handle, -1.0, 0.0, -2e12, 0.0, 10.0)
    assert math.isnan(y)
    assert math.isnan(v)


@pytest.mark.parametrize(
    "values",
    [
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        (-1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        (1.0, -0.1, 0.0, 0.0, 0.0, 0.0),
        (1.0, 0.0, -0.1, 0.0, 0.0, 0.0),
        (1.0, 0.0, 0.0, -0.1, 0.0, 0.0),
        (1.0, 0.0, 0.0, 0.0, -0.1, 0.0),
        (1.0, 0.0, 0.0, 0.0, 0.0, -0.1),
        (math.nan, 0.0, 0.0, 0.0, 0.0, 0.0),
        (math.inf, 0.0, 0.0, 0.0, 0.0, 0.0),
        (1.0, math.inf, 0.0, 0.0, 0.0, 0.0),
        (1.0, 0.0, 0.0, math.nan, 0.0, 0.0),
    ],
)
def test_impossible_plants_are_refused(values: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="mass > 0"):
        make_plant(*values)
