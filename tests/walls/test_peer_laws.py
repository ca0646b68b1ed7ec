"""The laws of others that bound themselves by the device's damping, against closed forms."""

import numpy as np
import pytest
from bouncing import Array
from law_bench import force_at_sample, wall_of

from canwall.analysis.analytic_limits import passive_stiffness
from canwall.workbench import Ball

MASS, VISCOUS, PERIOD = 1.6e-4, 5e-4, 1e-3


def forces(law: str, y: Array, k: float, b: float = 0.0, /, **options: float) -> Array:
    """Forces of a law over these samples."""
    ball = Ball(stiffness=k, damping=b, mass=MASS, viscous=VISCOUS, period=PERIOD, height=1.0)
    wall = wall_of(ball, law, **options)
    v = np.diff(y, prepend=y[0]) / PERIOD
    return np.array([force_at_sample(wall, law, *at) for at in zip(y, v, strict=True)])


def any_motion(seed: int, cycles: int = 2000) -> Array:
    """A motion in and out of the wall with much of everything, from outside."""
    random = np.random.default_rng(seed)
    steps = random.normal(size=cycles) * random.choice([1e-5, 1e-4, 1e-3], size=cycles)
    return np.asarray(0.002 + np.cumsum(steps - 0.02 * np.cumsum(steps)))


# Energy bounding


@pytest.mark.parametrize("delay", [0, 1, 2])
@pytest.mark.parametrize("stiffness", [0.1, 1.0, 50.0, 1e4])
def test_energy_bounding_gives_off_no_more_than_the_device_takes(
    stiffness: float, delay: int
) -> None:
    for seed in range(2):
        y = any_motion(seed)
        f = forces("energy_bounding", y, stiffness, delay=delay)
        moved = np.diff(y)
        # f[j] acts from y[j + D] to y[j + D + 1].
        given_off = f[: len(moved) - delay] * moved[delay:]
        taken = VISCOUS / PERIOD * moved[delay:] ** 2
        assert f.max() > 1e-5
        assert np.cumsum(given_off - taken).max() <= 1e-15


@pytest.mark.parametrize("stiffness", [2.0, 50.0, 1e4])
def test_a_standard_wall_above_the_bound_gives_off_more(stiffness: float) -> None:
    y = any_motion(0)
    f, moved = forces("standard", y, stiffness), np.diff(y)
    assert np.cumsum(f[:-1] * moved - VISCOUS / PERIOD * moved**2).max() > 1e-9


@pytest.mark.parametrize("delay", [0.0, 0.5, 1.0])
def test_force_of_a_stiff_wall_rises_with_the_passive_stiffness(delay: float) -> None:
    y = 1e-4 - 1e-4 * np.arange(40)
    rises = 2.0 * VISCOUS / (PERIOD * (1.0 + 2.0 * delay))
    f = forces("energy_bounding", y, 1e4, delay=delay)
    np.testing.assert_allclose(f, np.maximum(-rises * y, 0.0), rtol=1e-9, atol=1e-15)
    if delay != 0.5:
        assert rises == pytest.approx(passive_stiffness(VISCOUS, 0.0, PERIOD, int(delay)))


def test_a_soft_wall_and_a_well_damped_device_are_left_alone() -> None:
    y = any_motion(1)
    soft = forces("energy_bounding", y, 0.3)
    np.testing.assert_allclose(soft, np.maximum(-0.3 * y, 0.0), rtol=1e-9, atol=1e-15)
    f = forces("energy_bounding", y, 500.0, damping=10.0)
    np.testing.assert_allclose(f, forces("standard", y, 500.0), rtol=1e-9, atol=1e-15)


def test_an_undamped_device_gets_no_force() -> None:
    ball = Ball(stiffness=1.0, viscous=0.0)
    wall = wall_of(ball, "energy_bounding")
    assert [force_at_sample(wall, "energy_bounding", y, -1.0) for y in (1.0, -1.0, -2.0)] == [
        0.0
    ] * 3


# Virtual coupling


def coupling_over_frequency(omega: Array, k: float, /, **options: float) -> Array:
    """H = −F/Y of the law in contact, from its response to an impulse of the position."""
    rest = np.full(20_000, -1.0)
    pushed = rest.copy()
    pushed[10_000] -= 1e-3
    difference = (
        forces("virtual_coupling", pushed, k, **options)
        - forces("virtual_coupling", rest, k, **options)
    )[10_000:]
    j = np.arange(len(difference))
    kept = np.abs(difference) > 1e-9 * np.abs(difference).max()
    return np.asarray(difference[kept] @ np.exp(-1j * np.outer(j[kept], omega * PERIOD)) / 1e-3)


def damping_needed(omega: Array, h: Array, delay: int) -> float:
    """b that Colgate and Schenkel ask for: T/(2(1 − cos ωT))·Re[(1 − e^{−jωT})·z^{−D}·H]."""
    z = np.exp(1j * omega * PERIOD)
    needed = 0.5 * PERIOD / (1.0 - np.cos(omega * PERIOD)) * ((1.0 - 1.0 / z) * h / z**delay).real
    return float(needed.max())


@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize("stiffness", [1.0, 100.0, 1e9])
def test_coupling_is_passive_with_a_wall_of_any_stiffness(stiffness: float, delay: int) -> None:
    omega = np.linspace(1e-3, 1.0, 400) * np.pi / PERIOD
    needed = damping_needed(omega, coupling_over_frequency(omega, stiffness, delay=delay), delay)
    assert needed <= VISCOUS * (1.0 + 1e-6)
    if stiffness == 1e9:
        assert needed == pytest.approx(VISCOUS, rel=1e-4)


def test_coupling_of_one_s_own() -> None:
    omega = np.array([100.0, 1000.0])
    h = coupling_over_frequency(omega, 1e10, stiffness=3.0, damping=2e-3)
    z = np.exp(1j * omega * PERIOD)
    np.testing.assert_allclose(h, 3.0 + 2e-3 * (1.0 - 1.0 / z) / PERIOD, rtol=1e-6)


def test_at_rest_coupling_and_wall_are_springs_in_series() -> None:
    f = forces("virtual_coupling", np.full(2000, -0.01), 5.0, 1e-3, stiffness=3.0, damping=2e-3)
    assert f[-1] == pytest.approx(0.01 * 3.0 * 5.0 / 8.0, rel=1e-6)


def test_outside_the_tool_follows_the_handle() -> None:
    f = forces("virtual_coupling", 0.01 + 0.005 * np.sin(np.arange(300)), 1e6)
    assert not np.abs(f).max() > 1e-15
