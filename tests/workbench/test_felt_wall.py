"""Effective impedance and Diolaiti's plane on the simulated drive, against closed forms."""

import numpy as np
import pytest

from canwall.analysis.analytic_limits import DiolaitiRegion, diolaiti_region
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
