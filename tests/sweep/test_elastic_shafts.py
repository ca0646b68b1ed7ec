"""Walls that know the elastic shaft of their drive."""

import numpy as np
import pytest
from rig import SIM_CONFIG

from canwall import config
from canwall.sweep import OPERATORS, make_plan
from canwall.sweep.plan import compute_piece


@pytest.mark.slow
@pytest.mark.parametrize(("model", "softest"), [("drive", 0.5), ("matched", 0.25)])
def test_cap_keeps_every_wall_quiet_on_an_elastic_shaft(model: str, softest: float) -> None:
    """Seeded strikes of all operators; without a bound by the shaft, most of them chatter."""
    asked = np.random.default_rng(14).uniform(30.0, 5000.0, 3).round()
    plan = make_plan(
        config.load(SIM_CONFIG),
        {
            "operator": list(OPERATORS),
            "model": model,
            "servo": "1600Hz",
            "friction": 0.01,
            "simulation.shaft_hz": [400.0, 250.0],
            "stiffness": asked.tolist(),
            "press": 1.2,
            "speed": 0.8,
            "phase": 0.35,
        },
    )
    measured = np.concatenate([compute_piece(plan, i) for i in range(plan.pieces)])
    assert measured.shape == (12, 3)
    assert not measured["chatters"].any()
    in_force = measured["stiffness_in_force"]
    assert (in_force > softest).all()
    # The softer shaft bears less, in every hand.
    assert (in_force[1::2] < in_force[::2]).all()


@pytest.mark.slow
@pytest.mark.parametrize("hz", [400.0, 600.0])
def test_a_handle_that_nobody_holds_comes_to_rest(hz: float) -> None:
    """Without friction nothing but the wall's damper takes the swing of a soft wall."""
    plan = make_plan(
        config.load(SIM_CONFIG),
        {
            "operator": "none",
            "model": "drive",
            "servo": ["1600Hz", "800Hz"],
            "delay_error": [-0.3, 0.0, 0.15],
            "friction": 0.0,
            "simulation.shaft_hz": hz,
            "stiffness": 618.0,
            "press": 1.2,
            "speed": 0.795,
            "phase": [0.296, 0.736],
        },
    )
    measured = np.concatenate([compute_piece(plan, i) for i in range(plan.pieces)])
    assert measured.size == 12
    assert not measured["chatters"].any()
    # What the torque's steps do to a wall as soft as the one in force is no chatter.
    assert (measured["tolerance"] > 6.0 * 4.8e-5).all()
