"""standard, damped, midpoint and half_sample: by hand, by expm, and their effect on energy."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm

from canwall.compiled import Record, compiled
from canwall.physics import zoh
from canwall.walls import LAWS, WALL, call_law, set_plant, set_referent

BOUNDED = settings(derandomize=True, deadline=None, max_examples=100)

Array = NDArray[np.float64]

FIRST_LAWS = ("standard", "damped", "midpoint", "half_sample")


def make_wall(
    stiffness: float,
    damping: float = 0.0,
    mass: float = 1.0,
    viscous: float = 0.0,
    spring: float = 0.0,
    period: float = 1e-3,
) -> NDArray[np.void]:
    wall = np.zeros(1, WALL)
    set_plant(wall, mass, viscous, spring, period)
    set_referent(wall, stiffness, damping)
    return wall


@compiled
def called(address: int, wall: Record) -> float:
    force: float = call_law(address, wall)
    return force


def force_of(law: str, wall: NDArray[np.void], **seen: float) -> float:
    """Force of a law for these values, all others being NaN."""
    for name in ("y_sample", "v_sample", "y", "v", "d"):
        wall[name] = seen.get(name, math.nan)
    return called(LAWS[law].address, wall[0])


@pytest.mark.parametrize(("y", "force"), [(-0.02, 6.0), (-1e-9, 3e-7), (0.0, 0.0), (0.02, 0.0)])
def test_standard_is_a_spring_on_the_sample(y: float, force: float) -> None:
    wall = make_wall(300.0, damping=7.0)
    assert force_of("standard", wall, y_sample=y) == pytest.approx(force, rel=1e-14)


@pytest.mark.parametrize(
    ("y", "v", "force"),
    [
        (-0.02, -3.0, 6.0 + 21.0),
        (-0.02, 0.0, 6.0),
        (-0.02, 3.0, 6.0 - 21.0),
        (0.0, -3.0, 0.0),
        (0.02, -3.0, 0.0),
    ],
)
def test_damped_is_a_spring_and_a_damper_on_the_sample(y: float, v: float, force: float) -> None:
    wall = make_wall(300.0, damping=7.0)
    assert force_of("damped", wall, y_sample=y, v_sample=v) == pytest.approx(force, rel=1e-14)


@pytest.mark.parametrize(
    ("y", "v", "force"),
    [
        (-0.02, -3.0, 300.0 * (0.02 + 3.0 * 0.005) + 21.0),
        (-0.02, 3.0, 300.0 * (0.02 - 3.0 * 0.005) - 21.0),
        (0.0, -3.0, 0.0),
        (0.02, -30.0, 0.0),
    ],
)
def test_midpoint_is_the_wall_half_a_period_ahead(y: float, v: float, force: float) -> None:
    wall = make_wall(300.0, damping=7.0, period=0.01)
    assert force_of("midpoint", wall, y=y, v=v) == pytest.approx(force, rel=1e-13)


@BOUNDED
@given(
    st.tuples(st.floats(0.1, 10.0), st.floats(0.0, 3.0), st.floats(0.0, 10.0)),
    st.tuples(st.floats(0.1, 1e3), st.floats(0.0, 10.0), st.floats(1e-3, 0.3)),
    st.floats(-1.0, -1e-3),
    st.floats(-5.0, 5.0),
    st.floats(-5.0, 5.0),
)
def test_half_sample_is_the_referent_half_a_period_ahead(
    plant: tuple[float, float, float],
    wall: tuple[float, float, float],
    y: float,
    v: float,
    d: float,
) -> None:
    mass, viscous, spring = plant
    stiffness, damping, period = wall
    referent = np.array(
        [
            [0.0, 1.0, 0.0],
            [-(spring + stiffness) / mass, -(viscous + damping) / mass, 1.0 / mass],
            [0.0, 0.0, 0.0],
        ]
    )
    y_half, v_half, _ = expm(referent * period / 2.0) @ np.array([y, v, d])
    expected = -stiffness * y_half - damping * v_half
    size = stiffness * (abs(y) + abs(v) * period) + damping * abs(v) + abs(d)
    record = make_wall(stiffness, damping, mass, viscous, spring, period)
    assert force_of("half_sample", record, y=y, v=v, d=d) == pytest.approx(
        expected, rel=0.0, abs=1e-11 * size
    )


def test_half_sample_gives_no_force_outside() -> None:
    wall = make_wall(300.0, damping=7.0, period=0.01)
    for y in (0.0, 0.02):
        assert force_of("half_sample", wall, y=y, v=-100.0, d=-50.0) == 0.0


def contact_map(law: str, wall: NDArray[np.void]) -> Array:
    """One period inside the wall as a matrix, from the hold equivalent and three forces."""
    phi, gamma = zoh(*(float(wall[n][0]) for n in ("mass", "viscous", "spring", "period")))

    def force(y: float, v: float) -> float:
        return force_of(law, wall, y_sample=y, v_sample=v, y=y, v=v, d=0.0)

    at = force(-1.0, 0.0)
    gradient = np.array([force(-2.0, 0.0) - at, force(-1.0, 1.0) - at]) * np.array([-1.0, 1.0])
    assert at == pytest.approx(-gradient[0]), "not linear inside"
    return np.asarray(phi + np.outer(gamma, gradient))


@pytest.mark.parametrize("theta", [0.01, 0.1, 0.5, 1.0, 1.9])
@pytest.mark.parametrize("mass", [1e-4, 0.3, 20.0])
def test_determinant_of_a_sampled_contact(mass: float, theta: float) -> None:
    period = 1e-3
    wall = make_wall(mass * (theta / period) ** 2, mass=mass, period=period)
    determinant = {law: float(np.linalg.det(contact_map(law, wall))) for law in FIRST_LAWS}
    assert determinant["midpoint"] == pytest.approx(1.0, rel=1e-13)
    assert determinant["standard"] == pytest.approx(1.0 + theta**2 / 2.0, rel=1e-13)
    # f = −K·(y·cos(θ/2) + ẏ·sin(θ/2)/ω₀)
    expected = 1.0 + theta**2 / 2.0 * math.cos(theta / 2.0) - theta * math.sin(theta / 2.0)
    assert determinant["half_sample"] == pytest.approx(expected, rel=1e-12)
    # A wrong mass does not matter to midpoint.
    wall["mass"] *= 7.0
    phi, gamma = zoh(mass, 0.0, 0.0, period)
    gradient = [-float(wall["stiffness"][0]), -float(wall["stiffness"][0]) * period / 2.0]
    assert np.linalg.det(phi + np.outer(gamma, gradient)) == pytest.approx(1.0, rel=1e-13)
    assert force_of("midpoint", wall, y=-0.1, v=0.7) == pytest.approx(
        gradient[0] * -0.1 + gradient[1] * 0.7, rel=1e-13
    )


@compiled
def bounce(address: int, wall: Record, speed: float, phase: float, energies: Array) -> None:
    """Energies of unit mass under unit gravity at the first sample outside after each bounce.

    It first strikes at `speed`; `phase` is the part of a period from there to the first sample
    inside. No delay: the state at the sample is what the law sees.
    """
    phi, gamma = wall.phi, wall.gamma
    wall.d = -1.0
    t = phase * wall.period
    y, v = -speed * t - 0.5 * t * t, -speed - t
    for i in range(len(energies)):
        was_inside = False
        for _ in range(100_000):
            was_inside = was_inside or y < 0.0
            wall.y, wall.v, wall.y_sample, wall.v_sample = y, v, y, v
            u = call_law(address, wall) + wall.d
            y, v = (
                phi[0, 0] * y + phi[0, 1] * v + gamma[0] * u,
                phi[1, 0] * y + phi[1, 1] * v + gamma[1] * u,
            )
            if was_inside and y >= 0.0:
                energies[i] = 0.5 * v * v + y
                break


def changes_per_bounce(law: str, theta: float, bounces: int) -> Array:
    """Changes of ln E from bounce to bounce, K = m = g = 1, first entry speed 5, ten phases."""
    wall = make_wall(1.0, period=theta)
    energies = np.full((10, bounces + 1), math.nan)
    energies[:, 0] = 0.5 * 5.0**2
    for row, phase in zip(energies, np.linspace(0.05, 0.95, 10), strict=True):
        bounce(LAWS[law].address, wall[0], 5.0, phase, row[1:])
    return np.diff(np.log(energies), axis=1)


# The expected values are means over bounces that follow one another: as it gains,
# standard strikes faster and faster and gains less and less, which makes their number matter.
@pytest.mark.parametrize(("theta", "mean"), [(0.1, 0.177), (0.5, 0.79)])
def test_standard_gains_energy_at_every_bounce(theta: float, mean: float) -> None:
    changes = changes_per_bounce("standard", theta, bounces=20)
    assert changes.mean() == pytest.approx(mean, rel=0.02)
    assert changes.min() > 0.0


@pytest.mark.parametrize(
    ("theta", "mean", "deviation"), [(0.1, -2e-4, 0.005), (0.5, -0.010, 0.058)]
)
def test_half_sample_keeps_the_energy_on_average(
    theta: float, mean: float, deviation: float
) -> None:
    changes = changes_per_bounce("half_sample", theta, bounces=100)
    assert changes.mean() == pytest.approx(mean, abs=0.1 * deviation)
    assert changes.std() == pytest.approx(deviation, rel=0.1)
