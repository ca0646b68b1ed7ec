"""The first wall: soft by a formula, and free of chatter whatever the law."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canwall.bench.soft_wall import WORST_DELAY, rounded_down, soft_stiffness, soft_torque


@given(st.floats(1e-6, 1e6), st.integers(1, 3))
def test_rounded_down_to_digits(value: float, digits: int) -> None:
    rounded = rounded_down(value, digits)
    assert rounded <= value * (1.0 + 1e-9)
    assert rounded >= value * (1.0 - 10.0 ** (1 - digits))
    assert float(f"{rounded:.{digits - 1}e}") == rounded


def test_numbers_with_so_many_digits_stay() -> None:
    assert rounded_down(0.3, 1) == 0.3
    assert soft_torque(0.637) == 0.063
    assert soft_torque(1.0) == 0.1


@pytest.mark.parametrize("cycle_s", [0.0005, 0.001, 0.004])
@pytest.mark.parametrize("inertia", [1e-5, 1e-4, 1e-3])
def test_limit_is_between(inertia: float, cycle_s: float) -> None:
    """By simulation, not by eigenvalues: a push dies away at the soft stiffness, and grows at 22
    times as much, which is beyond the limit however it was rounded.
    """
    mass, viscous = inertia + 0.004 * 0.08**2, 2.0 * 0.08**2
    soft = soft_stiffness(inertia, 0.0, cycle_s)
    assert _grows(mass, viscous, soft, cycle_s) < 0.5
    assert _grows(mass, viscous, 22.0 * soft, cycle_s) > 1.0


def _grows(mass: float, viscous: float, stiffness: float, period: float) -> float:
    """Return by how much the swing about rest has grown after 0.5 s of f[j] = −K·y[j−D]."""
    decay = np.exp(-viscous / mass * period)
    travel = mass / viscous * (1.0 - decay)
    y, v, late = 1e-3, 0.0, [1e-3] * WORST_DELAY
    swings = []
    for _ in range(round(0.5 / period)):
        force = -stiffness * late.pop(0)
        late.append(y)
        y, v = (
            y + travel * v + force / viscous * (period - travel),
            decay * v + force / viscous * (1.0 - decay),
        )
        swings.append(abs(y))
    return max(swings[-len(swings) // 4 :]) / max(swings[: len(swings) // 4])
