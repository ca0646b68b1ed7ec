"""Stability boundary of spring and damper in a sweep, compared with docs/results.md."""

import math
from typing import Any

import numpy as np
import pytest
import xarray as xr
from rig import settings_with

from canwall.analysis.analytic_limits import (
    CEILINGS,
    delayed_stiffness,
    passive_stiffness,
    quantised_stiffness,
    spectral_radius,
    stable_stiffness,
)
from canwall.sweep import make_plan
from canwall.sweep.dataset import assemble_dataset
from canwall.sweep.plan import compute_piece

MASS, PERIOD = 1e-4, 1e-3
UNIT = MASS / PERIOD**2
COUNT = 2.0 * math.pi / 131072

#: The handle is laid against the wall, not struck: what follows is the linear loop's own. Encoder
#: and torque are so fine that what they do stays far below a hundredth of the penetration.
LAID = {
    "law": "damped",
    "operator": "none",
    "servo": "ideal",
    "simulation.coulomb_nm": 0.0,
    "limits.speed_rad_s": 1000.0,
    "counts": 1 << 26,
    "torque_step": 2e-5,
    "start": 1e-4,
    "speed": [0.001],
    "phase": [0.0, 0.5],
}


def found(**axes: Any) -> xr.Dataset:
    plan = make_plan(settings_with(), axes)
    return assemble_dataset(
        plan, {piece: compute_piece(plan, piece) for piece in range(plan.pieces)}
    )


def swings(dataset: xr.Dataset) -> Any:
    """Return True if the handle moves by more than 1 % of its penetration at any phase."""
    share = dataset["motion"] / dataset["penetration"]
    return (share > 0.01).any(("speed", "phase")).values.squeeze()


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0, 1, 2])
@pytest.mark.parametrize("share", [0.01, 0.02, 0.05])
def test_linear_stability_with_delay(delay: int, share: float) -> None:
    viscous = share * MASS / PERIOD
    limit = delayed_stiffness(viscous, 0.0, PERIOD, delay)
    dataset = found(
        **LAID,
        **{"simulation.viscous_nm_s_per_rad": viscous},
        delay=delay,
        damping=0.0,
        press=60.0,
        stiffness=[0.95 * limit, 1.05 * limit],
    )
    np.testing.assert_array_equal(swings(dataset), [False, True])


@pytest.mark.slow
@pytest.mark.parametrize("delay", CEILINGS)
def test_ceilings_without_damping_of_the_plant(delay: int) -> None:
    ceiling, damping = CEILINGS[delay]
    dataset = found(
        **LAID,
        **{"simulation.viscous_nm_s_per_rad": 0.0},
        delay=delay,
        damping_normalised=damping,
        press=4.0,
        stiffness_normalised=[0.97 * ceiling, 1.03 * ceiling],
    )
    np.testing.assert_array_equal(swings(dataset), [False, True])


@pytest.mark.slow
@pytest.mark.parametrize("delay", CEILINGS)
def test_ceilings_are_those_of_the_eigenvalues(delay: int) -> None:
    ceiling, damping = CEILINGS[delay]
    limits = [stable_stiffness(1.0, 0.0, b, 1.0, delay) for b in np.arange(0.02, 1.2, 0.01)]
    assert max(limits) == pytest.approx(ceiling, rel=0.01)
    assert stable_stiffness(1.0, 0.0, damping, 1.0, delay) == pytest.approx(ceiling, rel=0.01)


@pytest.mark.parametrize("delay", [0, 1, 2])
@pytest.mark.parametrize(("mass", "viscous"), [(1e-4, 5e-4), (1.0, 5e-4), (20.0, 1e-3)])
def test_limit_of_a_heavy_handle(mass: float, viscous: float, delay: int) -> None:
    limit = delayed_stiffness(viscous, 0.0, PERIOD, delay)
    assert stable_stiffness(mass, viscous, 0.0, PERIOD, delay) == pytest.approx(limit, rel=0.01)
    assert stable_stiffness(mass, 0.0, 0.0, PERIOD, delay) == 0.0


@pytest.mark.parametrize("delay", [0, 1, 2, 3])
def test_eigenvalues_are_those_of_the_loop(delay: int) -> None:
    mass, viscous, stiffness, damping, period = 1.3, 0.4, 0.02, 0.05, 0.9
    y, v = [0.0] * (delay + 1) + [1.0], 0.0
    decay = math.exp(-viscous / mass * period)
    for _ in range(4000):
        sampled, before = y[-1 - delay], y[-2 - delay]
        force = -stiffness * sampled - damping * (sampled - before) / period
        end = force / viscous
        y.append(y[-1] + end * period + (v - end) * (1.0 - decay) * mass / viscous)
        v = end + (v - end) * decay
    early, late = (max(abs(p) for p in y[n : n + 300]) for n in (1000, 3000))
    radius = spectral_radius(mass, viscous, stiffness, damping, period, delay)
    assert radius == pytest.approx((late / early) ** (1.0 / 2000.0), rel=2e-4)


@pytest.mark.parametrize(
    ("damping", "delay"), [(0.0, 0), (0.3, 0), (0.0, 1), (0.1, 1), (0.5, 1), (0.9, 1)]
)
def test_passive_stiffness_solves_its_inequality(damping: float, delay: int) -> None:
    viscous, period = 1.0, 1e-3
    kt = passive_stiffness(viscous, damping, period, delay) * period
    if delay == 0:
        assert kt / 2 + damping == pytest.approx(viscous)
    elif 0.0 < kt <= 4.0 * damping:
        assert kt / 2 + damping + kt**2 / (8 * damping) == pytest.approx(viscous)
    else:
        assert 1.5 * kt - damping == pytest.approx(viscous)
    assert passive_stiffness(viscous, 1.1, period, delay) == 0.0
    assert passive_stiffness(viscous, -1.1, period, delay) == 0.0


def lasts(dataset: xr.Dataset) -> bool:
    """Return True if any wall goes on moving, or threw the handle away.

    A passive one may rebound more often than its referent: it has its damping spent on K·T/2.
    """
    more = dataset["motion"] - dataset["referent_motion"] > dataset["tolerance"]
    return bool((more | (dataset["trip"] != 0)).any())


@pytest.mark.parametrize("operator", ["none", "finger", "arm"])
@pytest.mark.parametrize("coulomb", [0.001, 0.01])
def test_what_is_passive_with_a_quantised_position_comes_to_rest(
    operator: str, coulomb: float
) -> None:
    viscous = 0.02
    limit = quantised_stiffness(viscous, coulomb, COUNT, PERIOD)
    assert limit == min(2 * viscous / PERIOD, 2 * coulomb / COUNT)
    dataset = found(
        operator=operator,
        servo="ideal",
        torque_step=1e-4,
        delay=0,
        damping=0.0,
        press=3.0,
        stiffness=[share * limit for share in (0.1, 0.3, 0.6, 0.95)],
        **{
            "simulation.viscous_nm_s_per_rad": viscous,
            "simulation.coulomb_nm": coulomb,
            "limits.speed_rad_s": 1000.0,
        },
    )
    assert not lasts(dataset)


@pytest.mark.parametrize("operator", ["none", "finger", "arm"])
@pytest.mark.parametrize("delay", [0, 1])
def test_what_is_passive_by_its_damping_comes_to_rest(operator: str, delay: int) -> None:
    viscous, coulomb = 0.02, 0.01
    for damping in (0.0, 0.005, 0.012):
        limit = passive_stiffness(viscous, damping, PERIOD, delay)
        dataset = found(
            law="damped",
            operator=operator,
            servo="ideal",
            torque_step=1e-4,
            delay=delay,
            damping=damping,
            press=3.0,
            stiffness=[share * limit for share in (0.2, 0.5, 0.95)],
            **{
                "simulation.viscous_nm_s_per_rad": viscous,
                "simulation.coulomb_nm": coulomb,
                "limits.speed_rad_s": 1000.0,
            },
        )
        assert not lasts(dataset)
