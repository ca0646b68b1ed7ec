"""The referent moves what the simulated drive moves: without a wall they are one."""

import math
from typing import Any

import numpy as np
import pytest
from rig import settings_with
from scipy.integrate import solve_ivp

from canwall.analysis import AskedWall
from canwall.config import Settings, with_overrides
from canwall.run.referent import referent_motion
from canwall.simdrive import ServoMotion


@pytest.mark.parametrize("grip", [True, False])
@pytest.mark.parametrize("side", ["below", "above"])
def test_without_a_wall_it_moves_as_the_handle_does(grip: bool, side: str) -> None:
    base = settings_with({"wall.side": side, "wall.position_rad": 0.013})
    assert base.simulation is not None
    hand = base.simulation.hand.model_copy(update={"grip": grip})
    simulation = base.simulation.model_copy(update={"hand": hand, "cogging_nm": 0.02})
    settings: Settings = base.model_copy(update={"simulation": simulation})
    nothing, position = np.zeros(1500), np.full(1500, 0.013)
    position[700:] = -0.02  # the wall is moved, the handle is not
    referent = referent_motion(settings, AskedWall(*[nothing] * 4), position)
    assert referent is not None
    motion = ServoMotion(simulation, settings.bus.cycle_s, 2.0 * math.pi * 1e6)
    seen, parted = [], False
    for _ in range(1500):
        seen.append(motion.position_rad)
        motion.advance(0.0, settings.bus.cycle_s)
        parted = parted or not motion.touching
    sign = 1.0 if side == "below" else -1.0
    np.testing.assert_allclose(sign * referent.y + position, seen, rtol=0.0, atol=1e-9)
    assert np.ptp(seen) > 0.1
    assert parted is not grip


def test_damping_and_cap_are_those_of_the_mass_that_moves() -> None:
    """The wall is max(0, −K·y − 2·ζ·√(K·m)·ẏ), K = c·m/T², m of drive and hand, whatever B says."""
    asked, ratio, press = 5000.0, 0.5, -0.2
    hand = {
        "simulation.hand.strikes": 1,
        "simulation.hand.first_strike_s": 0.0,
        "simulation.hand.rest_rad": 0.0,
        "simulation.hand.press_rad": 0.0,
        "simulation.hand.press_torque_nm": press,
        "simulation.hand.approach_s": 0.02,
        "simulation.hand.stiffness_nm_per_rad": 0.0,
        "simulation.coulomb_nm": 0.0,
    }
    base = with_overrides(settings_with(), hand).with_ideal_servo()
    assert base.simulation is not None
    settings = base.model_copy(update={"schedule": ()})
    n, period = 120, settings.bus.cycle_s
    each = np.ones(n)
    cap = 0.6
    wall = AskedWall(asked * each, 7.0 * each, ratio * each, cap * each)
    found = referent_motion(settings, wall, 0.0 * each)
    assert found is not None
    simulation = base.simulation
    mass = simulation.inertia_kg_m2 + simulation.hand.inertia_kg_m2
    viscous = simulation.viscous_nm_s_per_rad + simulation.hand.damping_nm_s_per_rad
    stiffness = cap * mass / period**2
    damping = 2.0 * ratio * math.sqrt(stiffness * mass)

    def push(t: float) -> float:
        # The muscle's torque, straight from SYNC to SYNC.
        s = np.clip(np.arange(n + 1) * period / 0.02, 0.0, 1.0)
        torque = press * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        return float(np.interp(t, np.arange(n + 1) * period, torque))

    def motion(t: float, x: tuple[float, float]) -> tuple[float, float]:
        y, v = x
        wall = max(0.0, -stiffness * y - damping * v) if y < 0.0 else 0.0
        return v, (wall + push(t) - viscous * v) / mass

    t = np.arange(n) * period
    exact = solve_ivp(motion, (0.0, t[-1]), (0.0, 0.0), t_eval=t, rtol=1e-9, max_step=1e-4).y[0]
    np.testing.assert_allclose(found.y, exact, atol=1e-6)
    assert found.y.min() < press / stiffness  # it overshoots: it is not overdamped


@pytest.mark.parametrize(
    ("keys", "stiffest"),
    [
        ({"simulation.objects": {"0x608F:01": 10_000}}, 2.2 * 0.08 / (2.0 * math.pi / 10_000)),
        ({"estimator.delay_cycles": 2.0}, 0.83 * (1.85 / 2.5) ** 5 * 1.64e-4 / 1e-6),
        ({}, 0.83 * (1.85 / 1.5) ** 5 * 1.64e-4 / 1e-6),
    ],
)
def test_capped_wall_is_as_stiff_as_encoder_and_delay_bear(
    keys: dict[str, Any], stiffest: float
) -> None:
    """2.2 N a count, and 0.83·(1.85/D)⁵·m/T²; walls without a cap are as asked."""
    estimator = {"force_walk_nm_per_sqrt_s": None, "delay_margin_cycles": 0.5}
    capped = {f"estimator.{key}": value for key, value in estimator.items()}
    settings = settings_with(capped | {"wall.law": "mean_force", "wall.cap": 40.0} | keys)
    n = 1500
    each, position = np.ones(n), np.zeros(n)
    motions = []
    for asked, cap in ((5000.0, 40.0), (stiffest, 40.0), (stiffest, 0.0), (5000.0, 0.0)):
        wall = AskedWall(asked * each, 0.0 * each, 0.5 * each, cap * each)
        found = referent_motion(settings, wall, position)
        assert found is not None
        motions.append(found.y)
    np.testing.assert_allclose(motions[0], motions[1], rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(motions[1], motions[2])
    assert np.abs(motions[2] - motions[3]).max() > 1e-4


def test_hand_of_a_drive_elsewhere_has_no_known_begin_in_measured_time() -> None:
    wall, position = AskedWall(*[np.zeros(10)] * 4), np.zeros(10)
    elsewhere = {"bus.interface": "unixcan", "bus.channel": "bus.sock"}
    for changes, known in (
        ({}, True),
        ({"bus.pace": "real_time"}, True),
        (elsewhere | {"bus.pace": "simulated"}, True),
        (elsewhere | {"bus.pace": "real_time"}, False),
    ):
        referent = referent_motion(settings_with(changes), wall, position)
        assert (referent is not None) == known, changes
