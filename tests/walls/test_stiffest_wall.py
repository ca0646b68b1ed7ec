"""Walls on an elastic shaft: what a law knows of it, and the stiffest wall."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import cont2discrete
from test_regression import send

from canwall.walls import (
    ESTIMATOR,
    LAWS,
    WALL,
    ElasticShaft,
    WallLoop,
    actuation_state,
    correct,
    predict,
    reset_estimator,
    set_estimator,
    set_plant,
    set_referent,
    stiffest_wall,
    wall_force,
)
from canwall.walls.estimator import kalman_model
from canwall.walls.least_squares import solve
from canwall.walls.regression import (
    REGRESSION,
    learn,
    reset_regression,
    set_regression,
)
from canwall.walls.shaft import closed_loops

PERIOD, COUNT, ROTOR = 1e-3, 4.8e-5, 1.06e-5
#: Viscous damping, and what of it is on the rotor [N·m·s/rad].
VISCOUS, DRIVE = 2e-3, 1.8e-3
Array = NDArray[np.float64]


def two_masses(load: float, hz: float, duration: float) -> tuple[Array, Array]:
    """Rotor and load, of 1e-4 kg·m² together at their resonance, after a duration; by scipy."""
    handle = 1e-4 - ROTOR
    reduced = ROTOR * handle / (ROTOR + handle)
    stiffness = (2.0 * math.pi * hz) ** 2 * reduced
    damping, hand = 2.0 * 0.02 * math.sqrt(stiffness * reduced), VISCOUS - DRIVE
    a = np.array(
        [
            [0.0, 1.0, 0.0, 0.0],
            [-stiffness / ROTOR, -(damping + DRIVE) / ROTOR, stiffness / ROTOR, damping / ROTOR],
            [0.0, 0.0, 0.0, 1.0],
            [stiffness / load, damping / load, -stiffness / load, -(damping + hand) / load],
        ]
    )
    b = np.array([[0.0], [1.0 / ROTOR], [0.0], [0.0]])
    phi, gamma, *_ = cont2discrete((a, b, np.eye(4), np.zeros((4, 1))), duration)
    return phi, gamma[:, 0]


def pressed(law: str, stiffness: float, delay: float, hz: float) -> tuple[float, float]:
    """Logarithmic growth in a period of a small motion within a wall: rendered, and computed."""
    sampled = LAWS[law].sampled
    estimator, wall = np.zeros(1, ESTIMATOR), np.zeros(1, WALL)
    set_estimator(estimator, 1e-4, VISCOUS, 0.0, 0.0, PERIOD, COUNT, 2e-3, delay)
    set_plant(wall, 1e-4, VISCOUS, 0.0, PERIOD)
    damping = 0.0 if sampled else 2.0 * 0.5 * math.sqrt(stiffness * 1e-4)
    set_referent(wall, stiffness, damping)
    reset_estimator(estimator, -1.0)
    push = -stiffness
    estimator["d"], estimator["in_flight"] = push, -push
    share = delay % 1.0
    (phi1, gamma1), (phi2, gamma2) = (
        two_masses(1e-4 - ROTOR, hz, s * PERIOD) for s in (share, 1.0 - share)
    )
    # The hand's push is on the rotor, which leaves the shaft without a twist.
    x = np.array([-1.0 + 1e-12, 0.0, -1.0, 0.0])
    flying = [-push] * 4
    size = []
    for _ in range(3000):
        correct(estimator[0], x[0])
        wall["y"], wall["v"] = actuation_state(estimator[0])
        wall["d"] = estimator["d"]
        wall["y_sample"] = x[0]
        force = wall_force(LAWS[law].address, wall[0])
        predict(estimator[0], force)
        flying = [force, *flying[:-1]]
        whole = int(delay)
        x = phi1 @ x + gamma1 * (flying[whole + 1] + push)
        x = phi2 @ x + gamma2 * (flying[whole] + push)
        size.append(abs(x[0] + 1.0) + abs(x[1]) * PERIOD)
        if not 1e-60 < size[-1] < 1e-3:
            break
    late = np.log(size[len(size) // 3 :])
    growth = float(np.polyfit(np.arange(len(late)), late, 1)[0])
    gain = tuple(estimator["steady_gain"][0].tolist())
    loop = WallLoop(1e-4, VISCOUS, gain, sampled, 0.0, 0.0 if sampled else 0.5, PERIOD, delay)
    shaft = ElasticShaft(1e-4, ROTOR, hz, 0.02, DRIVE)
    (poles,) = np.linalg.eigvals(closed_loops(shaft, 1e-4 - ROTOR, loop, np.array([stiffness])))
    return growth, math.log(np.abs(poles).max())


@pytest.mark.parametrize(
    ("law", "stiffness", "delay", "hz"),
    [
        ("mean_force", 60.0, 1.35, 400.0),
        ("mean_force", 100.0, 1.35, 400.0),
        ("mean_force", 30.0, 1.0, 250.0),
        ("mean_force", 20.0, 0.4, 250.0),
        ("standard", 5.0, 1.35, 400.0),
    ],
)
def test_closed_loop_grows_as_rendered(law: str, stiffness: float, delay: float, hz: float) -> None:
    """Estimator and law as they are compiled, on two masses by scipy."""
    rendered, computed = pressed(law, stiffness, delay, hz)
    assert computed > 0.0
    assert rendered == pytest.approx(computed, rel=0.04)


def test_stiffest_wall_is_well_below_one_that_is_unstable() -> None:
    """With a margin of eight, and the errors that it allows for; it falls with the resonance."""
    gain = tuple(kalman_model(1e-4, VISCOUS, 0.0, PERIOD, COUNT, 1e-3).gain.tolist())
    loop = WallLoop(1e-4, VISCOUS, gain, False, 0.0, 0.5, PERIOD, 1.35)
    found = []
    for hz in (400.0, 320.0, 250.0):
        shaft = ElasticShaft(1e-4, ROTOR, hz, 0.02, DRIVE)
        found.append(stiffest_wall(shaft, loop))
        walls = found[-1] * np.array([1.0, 32.0])
        within, beyond = np.abs(
            np.linalg.eigvals(closed_loops(shaft, 1e-4 - ROTOR, loop, walls))
        ).max(axis=1)
        assert within < 1.0 < beyond
    assert found[0] > found[1] > found[2] > 0.0


def load_found(load: float, hz: float, shaft: ElasticShaft | None, seed: int) -> float:
    """What a regression takes for the load, under torques that random numbers choose."""
    phi, gamma = two_masses(load, hz, PERIOD)
    torques = 0.1 * np.repeat(np.random.default_rng(seed).choice([-1.0, 1.0], 60), 7)
    regression, estimator = np.zeros(1, REGRESSION), np.zeros(1, ESTIMATOR)
    set_regression(regression[0], 1e-4, PERIOD, COUNT, 0.0, shaft)
    reset_regression(regression[0], 0.0)
    x = np.array([0.0, -2.0, 0.0, -2.0])
    for torque in torques.tolist():
        mass = 1.0 / max(solve(regression[0], 3e-4, False)[0], 200.0) + regression["rotor"][0]
        learn(regression[0], estimator[0], COUNT * round(x[0] / COUNT), mass, False, False)
        send(regression, estimator, torque)
        x = phi @ x + gamma * torque
    return float(1.0 / solve(regression[0], 3e-4, False)[0])


@pytest.mark.parametrize("load", [9e-5, 4e-4])
@pytest.mark.parametrize("hz", [250.0, 400.0])
def test_regression_finds_the_load_behind_the_shaft(load: float, hz: float) -> None:
    """Under torques of some milliseconds, with the encoder's steps; as one mass it would not."""
    shaft = ElasticShaft(1e-4, ROTOR, hz, 0.02, DRIVE)
    behind = [load_found(load, hz, shaft, seed) / load for seed in range(9)]
    as_one = [load_found(load, hz, None, seed) / (load + ROTOR) for seed in range(9)]
    assert np.median(behind) == pytest.approx(1.0, rel=0.2)
    assert np.median(np.abs(np.subtract(as_one, 1.0))) > np.median(np.abs(np.subtract(behind, 1.0)))
