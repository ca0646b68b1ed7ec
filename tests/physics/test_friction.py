"""Coulomb friction: sliding to a stop, sticking and breaking away, and no energy from nowhere."""

import math
from dataclasses import astuple

import numpy as np
import pytest
from hybrid_motion import Handle, moved, thousandths
from hypothesis import given, settings
from hypothesis import strategies as st
from numbers_drawn import or_zero
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.physics import PLANT, advance, flow, make_plant

BOUNDED = settings(derandomize=True, deadline=None, max_examples=100)

Array = NDArray[np.float64]


@pytest.mark.parametrize("v", [-3.0, 3.0])
def test_slides_to_a_stop_and_stays(v: float) -> None:
    mass, coulomb = 0.4, 1.5
    handle = Handle(mass, coulomb=coulomb)
    stop = mass * abs(v) / coulomb
    there = 0.2 + math.copysign(mass * v**2 / (2.0 * coulomb), v)
    y, still_moving = moved(handle, 0.2, v, 0.0, 0.0, 0.999 * stop)
    assert still_moving == pytest.approx(0.001 * v, rel=1e-9)
    assert abs(y - 0.2) < abs(there - 0.2)
    for duration in (1.001 * stop, 2.0 * stop, 1e9):
        y, at_rest = moved(handle, 0.2, v, 0.0, 0.0, duration)
        assert y == pytest.approx(there, rel=1e-14)
        assert at_rest == 0.0


def test_slides_to_a_stop_through_a_viscous_bearing() -> None:
    mass, viscous, coulomb, v = 0.4, 0.7, 1.5, 3.0
    stop = mass / viscous * math.log(1.0 + viscous * v / coulomb)
    y, at_rest = moved(Handle(mass, viscous, coulomb=coulomb), 0.0, v, 0.0, 0.0, 1.0001 * stop)
    assert y == pytest.approx((mass * v - coulomb * stop) / viscous, rel=1e-13)
    assert at_rest == 0.0


@pytest.mark.parametrize("start", [1.0, -1.0, 0.83])
def test_a_spring_loses_the_same_amplitude_each_half_swing(start: float) -> None:
    mass, spring, coulomb = 0.4, 9.0, 0.6
    handle = Handle(mass, spring=spring, coulomb=coulomb)
    half_swing = math.pi * math.sqrt(mass / spring)
    dead_band = coulomb / spring
    turning, swings = abs(start), 0
    while turning > dead_band:
        y, v = moved(handle, start, 0.0, 0.0, 0.0, swings * half_swing)
        assert y == pytest.approx(math.copysign(turning, start) * (-1) ** swings, rel=1e-12)
        assert v == pytest.approx(0.0, abs=1e-12)
        turning = abs(turning - 2.0 * dead_band)
        swings += 1
    assert swings > 5
    stopped = moved(handle, start, 0.0, 0.0, 0.0, (swings + 0.01) * half_swing)
    assert abs(stopped[0]) == pytest.approx(turning, rel=1e-11)
    assert stopped[1] == 0.0
    assert moved(handle, start, 0.0, 0.0, 0.0, 1e4 * half_swing) == pytest.approx(stopped)


@BOUNDED
@given(
    st.floats(0.01, 10.0),
    st.floats(0.0, 10.0),
    st.floats(0.01, 5.0),
    st.floats(-1.0, 1.0),
    st.floats(-2.0, 2.0),
)
def test_sticks_for_ever_under_a_load_within_its_friction(
    mass: float, spring: float, coulomb: float, share: float, y: float
) -> None:
    force = spring * y + 0.999999 * share * coulomb
    assert moved(Handle(mass, 0.1, spring, coulomb), y, 0.0, force, 0.0, 1e6) == (y, 0.0)


@pytest.mark.parametrize("sense", [-1.0, 1.0])
def test_at_the_very_threshold_it_sticks_and_beyond_it_slips(sense: float) -> None:
    coulomb = 0.25
    handle = Handle(1.0, coulomb=coulomb)
    assert moved(handle, 0.0, 0.0, sense * coulomb, 0.0, 1e6) == (0.0, 0.0)
    y, v = moved(handle, 0.0, 0.0, sense * 1.5 * coulomb, 0.0, 2.0)
    assert (y, v) == pytest.approx((sense * coulomb, sense * coulomb), rel=1e-14)


@pytest.mark.parametrize("sense", [-1.0, 1.0])
def test_a_spring_pulling_with_the_friction_exactly_holds(sense: float) -> None:
    handle = Handle(1.0, spring=2.0, coulomb=0.5)
    assert moved(handle, -sense * 0.25, 0.0, 0.0, 0.0, 1e6) == (-sense * 0.25, 0.0)


@pytest.mark.parametrize("sense", [-1.0, 1.0])
def test_a_ramp_breaks_a_free_mass_away_on_time(sense: float) -> None:
    mass, coulomb, slope = 0.3, 0.8, 2.0
    handle = Handle(mass, coulomb=coulomb)
    breakaway = coulomb / slope
    assert moved(handle, 0.1, 0.0, 0.0, sense * slope, breakaway) == (0.1, 0.0)
    for later in (1e-6, 0.01, 1.0):
        y, v = moved(handle, 0.0, 0.0, 0.0, sense * slope, breakaway + later)
        assert y == pytest.approx(sense * slope * later**3 / (6.0 * mass), rel=1e-8)
        assert v == pytest.approx(sense * slope * later**2 / (2.0 * mass), rel=1e-8)


@pytest.mark.parametrize("sense", [-1.0, 1.0])
@pytest.mark.parametrize("y", [-0.06, 0.0, 0.06])
def test_a_ramp_breaks_away_against_a_spring(y: float, sense: float) -> None:
    mass, viscous, spring, coulomb, slope, later = 0.3, 0.5, 11.0, 0.8, 2.0, 0.4
    handle = Handle(mass, viscous, spring, coulomb)
    breakaway = (coulomb + sense * spring * y) / slope
    assert moved(handle, y, 0.0, 0.0, sense * slope, 0.999999 * breakaway) == (y, 0.0)
    # From there on spring and friction are in balance, and only the growth of the ramp moves it.
    distance, speed = flow(mass, viscous, spring, 0.0, 0.0, 0.0, sense * slope, later)
    assert moved(handle, y, 0.0, 0.0, sense * slope, breakaway + later) == pytest.approx(
        (y + distance, speed), rel=1e-11
    )


def test_a_ramp_that_began_on_the_threshold() -> None:
    handle = Handle(0.5, coulomb=0.25)
    y, v = moved(handle, 0.0, 0.0, 0.25, 2.0, 0.1)
    assert (y, v) == pytest.approx((2.0 * 1e-3 / 3.0, 0.02), rel=1e-13)
    # Away from the threshold it has the whole width of the friction to cross.
    assert moved(handle, 0.0, 0.0, 0.25, -2.0, 0.25) == (0.0, 0.0)
    y, v = moved(handle, 0.0, 0.0, 0.25, -2.0, 0.35)
    assert (y, v) == pytest.approx((-2.0 * 1e-3 / 3.0, -0.02), rel=1e-11)


@BOUNDED
@given(
    st.builds(
        Handle,
        thousandths(0.01, 10.0),
        or_zero(thousandths(0.01, 1.0)),
        or_zero(thousandths(0.01, 10.0)),
        or_zero(thousandths(0.01, 2.0)),
    ),
    *[thousandths(-2.0, 2.0)] * 4,
)
def test_left_and_right_are_alike(handle: Handle, y: float, v: float, u0: float, u1: float) -> None:
    y_end, v_end = moved(handle, y, v, u0, u1, 1.5)
    mirrored = moved(handle, -y, -v, -u0, -u1, 1.5)
    assert mirrored == pytest.approx((-y_end, -v_end), rel=1e-10, abs=1e-10)


@compiled
def largest_gain(
    plant: Record, y: float, v: float, forces: Array, slopes: Array, period: float, lost: Array
) -> float:
    """Largest energy that friction gave in any period, against the largest energy so far.

    lost[0] becomes what friction took in all.
    """
    worst = 0.0
    size = 0.0
    for j in range(len(forces)):
        spring = plant.spring + (plant.wall_stiffness if y < 0.0 else 0.0)
        before = 0.5 * plant.mass * v * v + 0.5 * spring * y * y
        y_before = y
        y, v, _ = advance(plant, y, v, forces[j], 0.0, period)
        spring = plant.spring + (plant.wall_stiffness if y < 0.0 else 0.0)
        after = 0.5 * plant.mass * v * v + 0.5 * spring * y * y
        gain = after - before - forces[j] * (y - y_before)
        lost[0] -= gain
        size = max(size, before)
        worst = max(worst, gain / size if size > 0.0 else 0.0)
    return worst


@pytest.mark.parametrize(
    "handle",
    [
        Handle(1.64e-4, 0.0, 3.2, 0.01),
        Handle(1.64e-4, 0.0, 0.0, 0.01),
        Handle(1.64e-4, 0.0261, 3.2, 0.01, 50.0),
        Handle(1.64e-4, 0.0, 3.2, 0.001, 2000.0, 0.05),
    ],
)
def test_friction_never_gives_energy(handle: Handle) -> None:
    periods = 100_000
    rng = np.random.default_rng(7)
    # Held pushes of either sign and rests: it moves, turns and sticks.
    forces = rng.normal(0.0, 0.02, periods) * rng.integers(0, 2, periods)
    lost = np.zeros(1)
    plant = make_plant(*astuple(handle))
    gain = largest_gain(plant[0], 0.01, 0.0, forces, np.zeros(periods), 1e-3, lost)
    assert gain < 1e-12
    assert lost[0] > 0.01
    assert plant.dtype == PLANT
