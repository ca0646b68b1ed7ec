"""Effective impedance and Diolaiti's plane on the simulated drive, against closed forms."""

import numpy as np
import pytest

from canwall.analysis.analytic_limits import DiolaitiRegion, diolaiti_region
from canwall.physics import zoh
from canwall.workbench.felt_wall import measure_impedance, plain_wall_motion


@pytest.mark.parametrize(
    ("beta", "sigma", "region"),
    [
        (1.6, 0.6, DiolaitiRegion.PASSIVE),
        (1.6, 0.4, DiolaitiRegion.LIMIT_CYCLE),
        (1.4, 0.6, DiolaitiRegion.LOCALLY_STABLE),
        (1.4, 0.4, DiolaitiRegion.UNSTABLE),
    ],
)
def test_regions(beta: float, sigma: float, region: DiolaitiRegion) -> None:
    assert diolaiti_region(beta, sigma, 1.0) is region
    assert diolaiti_region(beta - 1.0, sigma, 0.0) is region


@pytest.mark.slow
def test_a_plain_wall_does_what_its_region_says() -> None:
    assert plain_wall_motion(2.0, 2.0) <= 1.0
    assert 1.0 < plain_wall_motion(2.0, 0.1) < 20.0
    assert plain_wall_motion(0.5, 2.0) > 20.0
    assert plain_wall_motion(0.5, 0.1) > 20.0


@pytest.mark.slow
def test_a_sampled_spring_takes_one_and_a_half_periods_of_damping() -> None:
    """With D = 1 the force is 1.5·T late: B_eff = b − 1.5·K·T, and B more with a damper."""
    plain = measure_impedance("standard")
    slow = plain.frequency < 20.0
    np.testing.assert_allclose(plain.damping[slow], 0.02 - 1.5 * 10.0 * 1e-3, rtol=0.15)
    np.testing.assert_allclose(plain.stiffness[plain.frequency < 5.0], 10.0, rtol=0.02)
    damped = measure_impedance("damped")
    np.testing.assert_allclose((damped.damping - plain.damping)[slow], 0.01, rtol=0.15)


@pytest.mark.slow
def test_impedance_of_a_plain_wall_is_that_of_the_sampled_loop() -> None:
    """F/Y of a sinusoidal push on m and b, with −K·y held a period after its sample."""
    found = measure_impedance("standard")
    s = 2j * np.pi * found.frequency
    z = np.exp(1e-3 * s)
    phi, gamma = zoh(1e-4, 0.02, 0.0, 1e-3)
    held = np.array([np.linalg.solve(each * np.eye(2) - phi, gamma)[0] for each in z])
    exact = (1e-4 * s**2 + 0.02 * s) * (1.0 + 10.0 * held / z)
    np.testing.assert_allclose(np.abs(found.impedance / exact - 1.0), 0.0, atol=0.03)
