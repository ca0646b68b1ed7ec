"""The oscillator's flow against the matrix exponential, quadrature and what must not change."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numbers_drawn import log_floats, or_zero
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.linalg import expm
from scipy.signal import cont2discrete

from canwall.physics import acceleration, basis, flow, zoh, zoh_coefficients

BOUNDED = settings(derandomize=True, deadline=None, max_examples=200)

#: √(k/m)·t from a billionth of a turn to several turns.
ANGLES = (0.0, 1e-8, 1e-5, 1e-3, 0.1, 0.499, 0.501, 1.0, 3.0, math.pi, 4.0, 6.5, 20.0)
#: Damping as a share of the critical: none, under, at and around the critical, far over.
DAMPING = (0.0, 1e-9, 1e-3, 0.5, 1.0 - 1e-9, 1.0, 1.0 + 1e-9, 2.0, 50.0, 1000.0)


amounts = st.floats(-10.0, 10.0)
masses = log_floats(1e-4, 1e2)
dampings = or_zero(log_floats(1e-4, 1e1))
springs = or_zero(log_floats(1e-3, 1e3))


def exponential(p: float, q: float) -> NDArray[np.float64]:
    """exp of the oscillator with state (y, ẏ, u, u̇) over unit time, p = b·t/m and q = k·t²/m."""
    generator = np.zeros((4, 4))
    generator[0, 1] = generator[1, 2] = generator[2, 3] = 1.0
    generator[1, :2] = -q, -p
    return np.asarray(expm(generator))


def check_basis(p: float, q: float, t: float, tolerance: float) -> None:
    """basis at time t, whose sign is that of p, in units of |t| against the exponential."""
    span = abs(t)
    h1, h0, g1, g2 = basis(abs(p) / span, q / span**2, t)
    got = np.array([h1, h0 / t, g1 / t**2, g2 / t**3])
    reference = exponential(math.copysign(p, t), q)
    want = np.array([reference[1, 1], reference[0, 1], reference[0, 2], reference[0, 3]])
    np.testing.assert_allclose(got, want, rtol=0.0, atol=tolerance * np.abs(want).max())


@pytest.mark.parametrize("damping", DAMPING)
@pytest.mark.parametrize("angle", ANGLES)
def test_basis_is_the_matrix_exponential(angle: float, damping: float) -> None:
    p = 2.0 * damping * angle
    for t in (1.0, 1e-3, 20.0):
        check_basis(p, angle**2, t, 1e-11)
        if p < 100.0:  # beyond, an overdamped motion grows backwards out of what a double holds
            check_basis(p, angle**2, -t, 1e-11)


@pytest.mark.parametrize("p", [0.0, 1e-12, 1e-8, 1e-3, 0.3, 0.7, 3.0, 30.0, 1e4])
def test_basis_without_a_spring(p: float) -> None:
    check_basis(p, 0.0, 0.25, 1e-11)


@BOUNDED
@given(p=or_zero(log_floats(1e-12, 0.3)), q=or_zero(log_floats(1e-16, 0.04)))
def test_no_digits_are_lost_within_one_short_period(p: float, q: float) -> None:
    check_basis(p, q, 1e-3, 4e-15)


def test_basis_of_the_free_mass_is_exact() -> None:
    t = 0.3
    h1, h0, g1, g2 = basis(0.0, 0.0, t)
    assert (h1, h0) == (1.0, t)
    assert (g1, g2) == pytest.approx((t**2 / 2.0, t**3 / 6.0), rel=1e-15)


def test_basis_at_time_zero() -> None:
    assert basis(3.0, 5.0, 0.0) == (1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("angle", [1e-8, 0.2, 1.0, math.pi / 2.0, math.pi, 5.0, 30.0])
def test_undamped_flow_is_sine_and_cosine(angle: float) -> None:
    mass, spring = 0.3, 7.0
    omega = math.sqrt(spring / mass)
    y, v = flow(mass, 0.0, spring, 0.4, -2.0, 0.0, 0.0, angle / omega)
    c, s = math.cos(angle), math.sin(angle)
    assert y == pytest.approx(0.4 * c - 2.0 / omega * s, abs=1e-12)
    assert v == pytest.approx(-0.4 * omega * s - 2.0 * c, abs=1e-12 * omega)


def test_critically_damped_flow() -> None:
    mass, omega, t = 2.0, 3.0, 0.9
    y, v = flow(mass, 2.0 * mass * omega, mass * omega**2, 1.0, 0.5, 0.0, 0.0, t)
    slope = 0.5 + omega
    decay = math.exp(-omega * t)
    assert y == pytest.approx((1.0 + slope * t) * decay, rel=1e-13)
    assert v == pytest.approx((slope - omega * (1.0 + slope * t)) * decay, rel=1e-13)


@BOUNDED
@given(masses, dampings, springs, amounts, amounts, amounts, amounts, st.floats(-0.3, 3.0))
def test_flow_is_the_matrix_exponential(
    m: float, b: float, k: float, y: float, v: float, u0: float, u1: float, t: float
) -> None:
    if t == 0.0 or (t < 0.0 and b * -t / m > 100.0):
        return
    # In units of the mass and of the time, so that the reference has its digits too.
    state = np.array([y, v * t, u0 * t**2 / m, u1 * t**3 / m])
    propagator = exponential(b * t / m, k * t**2 / m)
    want = propagator @ state
    got = flow(m, b, k, y, v, u0, u1, t)
    size = (np.abs(propagator) @ np.abs(state)).max()
    # Over many turns the phase is as uncertain as its last digit.
    tolerance = 1e-12 * size * (1.0 + abs(t) * (b / m + math.sqrt(k / m)))
    assert got[0] == pytest.approx(want[0], rel=0.0, abs=tolerance)
    assert got[1] * t == pytest.approx(want[1], rel=0.0, abs=tolerance)


def test_flow_takes_no_time_for_no_time() -> None:
    assert flow(0.2, 0.3, 9.0, 0.7, -1.5, 4.0, 5.0, 0.0) == (0.7, -1.5)


@BOUNDED
@given(
    st.tuples(masses, dampings, springs, st.floats(0.0, 1.0)),
    *[st.tuples(amounts, amounts, amounts, amounts)] * 2,
    amounts,
)
def test_flow_is_linear_in_state_and_input(
    plant: tuple[float, float, float, float],
    one: tuple[float, float, float, float],
    other: tuple[float, float, float, float],
    factor: float,
) -> None:
    m, b, k, t = plant

    def moved(values: Sequence[float]) -> NDArray[np.float64]:
        y, v, u0, u1 = values
        return np.array(flow(m, b, k, y, v, u0, u1, t))

    sums = [factor * x + z for x, z in zip(one, other, strict=True)]
    # The largest state that any part of the sum can come from or lead to bounds what is rounded.
    propagator = np.array([moved(unit) for unit in np.eye(4).tolist()]).T
    sizes = np.abs(factor) * np.abs(one) + np.abs(other)
    np.testing.assert_allclose(
        moved(sums),
        factor * moved(one) + moved(other),
        rtol=0.0,
        atol=1e-13 * max((np.abs(propagator) @ sizes).max(), sizes.max()),
    )


@BOUNDED
@given(masses, springs, amounts, amounts, amounts, st.floats(0.0, 1.0))
def test_undamped_motion_runs_backwards_with_the_velocity_reversed(
    m: float, k: float, y: float, v: float, u0: float, t: float
) -> None:
    y_end, v_end = flow(m, 0.0, k, y, v, u0, 0.0, t)
    y_back, v_back = flow(m, 0.0, k, y_end, -v_end, u0, 0.0, t)
    omega = math.sqrt(k / m)
    size = abs(y) + abs(v) * t + abs(u0) * t * t / m
    turns = 1.0 + omega * t
    assert y_back == pytest.approx(y, rel=0.0, abs=1e-11 * size * turns)
    assert -v_back * t == pytest.approx(v * t, rel=0.0, abs=1e-11 * size * turns**2)


@BOUNDED
@given(masses, dampings, springs, amounts, amounts, amounts, amounts, st.floats(0.01, 1.0))
def test_negative_time_undoes_positive_time(
    m: float, b: float, k: float, y: float, v: float, u0: float, u1: float, t: float
) -> None:
    decay = b * t / m
    if decay > 5.0:
        return  # what has decayed cannot be recovered
    y_end, v_end = flow(m, b, k, y, v, u0, u1, t)
    y_back, v_back = flow(m, b, k, y_end, v_end, u0 + u1 * t, u1, -t)
    size = abs(y) + abs(v) * t + (abs(u0) + abs(u1) * t) * t * t / m
    tolerance = 1e-11 * size * math.exp(decay) * (1.0 + math.sqrt(k / m) * t) ** 2
    assert y_back == pytest.approx(y, rel=0.0, abs=tolerance)
    assert v_back * t == pytest.approx(v * t, rel=0.0, abs=tolerance)


@BOUNDED
@given(
    st.tuples(masses, dampings, springs),
    st.tuples(amounts, amounts, amounts, amounts),
    st.floats(0.0, 1.0),
    st.floats(0.0, 1.0),
)
def test_two_times_one_after_the_other_are_their_sum(
    plant: tuple[float, float, float],
    start: tuple[float, float, float, float],
    t1: float,
    t2: float,
) -> None:
    m, b, k = plant
    y, v, u0, u1 = start
    t = t1 + t2
    whole = flow(m, b, k, y, v, u0, u1, t)
    halfway = flow(m, b, k, y, v, u0, u1, t1)
    parts = flow(m, b, k, *halfway, u0 + u1 * t1, u1, t2)
    size = abs(y) + abs(v) * t + (abs(u0) + abs(u1) * t) * t * t / m
    tolerance = 1e-11 * size * (1.0 + math.sqrt(k / m) * t) ** 2
    assert parts[0] == pytest.approx(whole[0], rel=0.0, abs=tolerance)
    assert parts[1] * t == pytest.approx(whole[1] * t, rel=0.0, abs=tolerance)


@BOUNDED
@given(
    st.tuples(masses, dampings, springs),
    st.tuples(amounts, amounts, amounts, amounts),
    st.floats(0.0, 1.0),
    *[log_floats(1e-3, 1e3)] * 3,
)
def test_units_do_not_matter(
    plant: tuple[float, float, float],
    start: tuple[float, float, float, float],
    t: float,
    kilogram: float,
    metre: float,
    second: float,
) -> None:
    m, b, k = plant
    y, v, u0, u1 = start
    force = kilogram * metre / second**2
    in_other_units = flow(
        m * kilogram,
        b * kilogram / second,
        k * kilogram / second**2,
        y * metre,
        v * metre / second,
        u0 * force,
        u1 * force / second,
        t * second,
    )
    want = flow(m, b, k, y, v, u0, u1, t)
    size = abs(y) + abs(v) * t + (abs(u0) + abs(u1) * t) * t * t / m
    tolerance = 1e-11 * size * (1.0 + math.sqrt(k / m) * t) ** 2
    assert in_other_units[0] / metre == pytest.approx(want[0], rel=0.0, abs=tolerance)
    assert in_other_units[1] * second / metre * t == pytest.approx(
        want[1] * t, rel=0.0, abs=tolerance
    )


@pytest.mark.parametrize(
    ("m", "b", "k"), [(1.0, 0.3, 20.0), (0.2, 5.0, 3.0), (2.0, 0.0, 8.0), (0.5, 0.7, 0.0)]
)
def test_work_goes_into_energy_and_damping(m: float, b: float, k: float) -> None:
    y, v, u0, u1, t = -0.4, 3.0, -2.0, 5.0, 0.8

    def speed(time: float) -> float:
        return flow(m, b, k, y, v, u0, u1, time)[1]

    supplied, _ = quad(lambda s: (u0 + u1 * s) * speed(s), 0.0, t, epsabs=1e-13, epsrel=1e-13)
    damped, _ = quad(lambda s: b * speed(s) ** 2, 0.0, t, epsabs=1e-13, epsrel=1e-13)
    y_end, v_end = flow(m, b, k, y, v, u0, u1, t)
    stored = 0.5 * m * (v_end**2 - v**2) + 0.5 * k * (y_end**2 - y**2)
    assert supplied == pytest.approx(stored + damped, rel=1e-11)


def test_acceleration_is_the_derivative_of_the_velocity() -> None:
    m, b, k, u = 0.3, 0.4, 50.0, 1.7
    step = 1e-5
    _, before = flow(m, b, k, 0.2, -1.0, u, 0.0, -step)
    _, after = flow(m, b, k, 0.2, -1.0, u, 0.0, step)
    expected = (after - before) / (2.0 * step)
    assert acceleration(m, b, k, 0.2, -1.0, u) == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize("angle", [1e-6, 1e-2, 0.5, 3.0, 4.0])
@pytest.mark.parametrize("damping", [0.0, 0.1, 1.0, 20.0])
def test_zoh_is_that_of_scipy(angle: float, damping: float) -> None:
    mass, period = 0.3, 0.7
    spring = mass * (angle / period) ** 2
    viscous = 2.0 * damping * math.sqrt(spring * mass)
    a = np.array([[0.0, 1.0], [-spring / mass, -viscous / mass]])
    b = np.array([[0.0], [1.0 / mass]])
    phi_reference, gamma_reference, *_ = cont2discrete((a, b, np.eye(2), np.zeros((2, 1))), period)
    phi, gamma = zoh(mass, viscous, spring, period)
    assert phi.shape == (2, 2)
    assert gamma.shape == (2,)
    np.testing.assert_allclose(phi, phi_reference, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(gamma, gamma_reference[:, 0], rtol=1e-11, atol=1e-13)
    np.testing.assert_array_equal(
        zoh_coefficients(mass, viscous, spring, period), np.concatenate([phi.ravel(), gamma])
    )


def test_zoh_of_the_free_mass() -> None:
    mass, period = 1.3e-4, 1e-3
    phi, gamma = zoh(mass, 0.0, 0.0, period)
    np.testing.assert_array_equal(phi, [[1.0, period], [0.0, 1.0]])
    np.testing.assert_allclose(gamma, [period**2 / 2.0 / mass, period / mass], rtol=1e-15)


@BOUNDED
@given(masses, dampings, springs, log_floats(1e-4, 1.0))
def test_zoh_contracts_areas_by_the_damping(m: float, b: float, k: float, period: float) -> None:
    phi, _ = zoh(m, b, k, period)
    turns = 1.0 + math.sqrt(k / m) * period + b / m * period
    # Liouville: det Φ = exp(−b·T/m), whatever the spring.
    assert np.linalg.det(phi) == pytest.approx(
        math.exp(-b * period / m), rel=0.0, abs=1e-14 * turns**2
    )
