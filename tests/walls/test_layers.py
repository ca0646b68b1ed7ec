"""The layers over any law: tension policy, passivity observer and passivity controller."""

from dataclasses import replace

import numpy as np
import pytest
from bouncing import Array, bounces
from law_bench import PREDICTING, bounced_in_python, force_at, wall_of

from canwall.walls import LAWS, put_in_force, set_applied_force
from canwall.workbench import Ball, sampled_ball

#: Each pulls now and then on this ball.
PULLING = ("half_sample", "half_sample+deadbeat", "pole_placement", "midpoint", "two_step")
BALL = Ball(stiffness=25.0, periods=1000)


def energies_put_in(y: Array, force: Array) -> list[float]:
    """Energy that the operator has put into the wall before each force, contact by contact."""
    held, energies = 0.0, []
    for j in range(len(force)):
        if j > 0:
            held -= force[j - 1] * (y[j] - y[j - 1])
        if y[j] >= 0.0 and (j == 0 or force[j - 1] == 0.0):
            held = 0.0
        energies.append(held)
    return energies


@pytest.mark.parametrize("tension", ["allow", "clamp", "budget"])
@pytest.mark.parametrize("law", LAWS)
def test_absorbed_energy_is_exact(law: str, tension: str) -> None:
    ball = replace(BALL, damping=0.3, tension=tension, passivity=0.5, periods=400)
    y, _, force, absorbed = bounced_in_python(ball, wall_of(ball, law), law)
    scale = max(1.0, float(np.abs(absorbed).max()))
    np.testing.assert_allclose(absorbed, energies_put_in(y, force), rtol=0, atol=1e-12 * scale)


@pytest.mark.parametrize("law", PREDICTING)
def test_clamp_removes_pulls_and_nothing_else(law: str) -> None:
    allowed, clamped = wall_of(BALL, law), wall_of(replace(BALL, tension="clamp"), law)
    pulls = 0
    for y in np.linspace(-0.2, 0.05, 26):
        for v in np.linspace(-4.0, 4.0, 17):
            force = force_at(allowed, law, y, v)
            pulls += force < 0.0
            assert force_at(clamped, law, y, v) == max(force, 0.0)
    assert pulls > 10


@pytest.mark.parametrize("law", PULLING)
def test_clamped_laws_do_not_pull(law: str) -> None:
    _, _, force = sampled_ball(BALL, LAWS[law])
    assert force.min() < -0.1
    _, _, force = sampled_ball(replace(BALL, tension="clamp"), LAWS[law])
    assert force.min() == 0.0 < force.max()


@pytest.mark.parametrize("theta", [0.1, 0.5])
def test_clamping_makes_half_sample_active(theta: float) -> None:
    """From the entry speed 5: +0.003 and +0.031 per bounce."""
    ball = Ball(stiffness=1.0, period=theta, height=0.0, speed=5.0, periods=30000)
    gains = {}
    for tension in ("allow", "clamp"):
        chosen = replace(ball, tension=tension)
        y, v, _ = sampled_ball(chosen, LAWS["half_sample"])
        last = np.flatnonzero(y >= 0.0)[-1]
        gains[tension] = np.log(chosen.energy(y, v)[last] / 12.5) / bounces(y)
    assert abs(gains["allow"]) < 1e-3
    assert gains["clamp"] > {0.1: 0.002, 0.5: 0.025}[theta]


@pytest.mark.parametrize("law", PULLING)
def test_budget_spends_what_was_absorbed_and_no_more(law: str) -> None:
    ball = replace(BALL, tension="budget", periods=3000)
    y, _, force, absorbed = bounced_in_python(ball, wall_of(ball, law), law)
    pulling = np.flatnonzero(force < 0.0)
    assert len(pulling) > 10
    spent = force[pulling] * (y[pulling + 1] - y[pulling])
    assert np.all(spent <= np.maximum(absorbed[pulling], 0.0) + 1e-12)


@pytest.mark.parametrize(("absorbed", "granted"), [(0.0, False), (0.62, False), (0.63, True)])
def test_budget_grants_a_pull_that_is_covered(absorbed: float, granted: bool) -> None:
    """Pulled by 5 N from 1 m/s on, 1 kg moves 0.125 m further in within 0.1 s: 0.625 J."""
    wall = wall_of(Ball(tension="budget", gravity=0.0, stiffness=0.0), "midpoint")
    wall["damping"] = -5.0
    # Absorbed in the last period: a push of 1 N against a handle moving in.
    wall["y_before"], wall["force_before"] = -0.01 + absorbed, 1.0
    force = force_at(wall, "midpoint", -0.01, -1.0)
    assert wall["absorbed"][0] == pytest.approx(absorbed)
    assert force == pytest.approx(-5.0 if granted else 0.0)


def test_budget_lets_a_pull_that_takes_energy_pass() -> None:
    """Against a handle moving out, a pull absorbs energy instead of spending any."""
    wall = wall_of(Ball(tension="budget", gravity=0.0, stiffness=4.0), "midpoint")
    assert force_at(wall, "midpoint", -0.01, 1.0) == pytest.approx(-4.0 * 0.04)
    assert wall["absorbed"][0] == 0.0


@pytest.mark.parametrize("y", [-0.01, 0.01])
def test_stiffness_comes_back_from_nothing(y: float) -> None:
    """A hand for which the shaft allows no wall is followed by one for which it does."""
    wall = wall_of(Ball(stiffness=100.0), "half_sample")
    wall["cap"], wall["y_sample"], wall["stiffest"] = 100.0, y, 0.0
    put_in_force(wall[0])
    assert wall["stiffness"] == 0.0
    wall["stiffest"] = 4.57
    least = 4.57
    for _ in range(1500):
        before = wall["stiffness"].item()
        put_in_force(wall[0])
        least = min(least, wall["stiffness"].item() - before)
    assert wall["stiffness"] == 4.57
    assert least >= 0.0


def test_spring_under_load_does_not_gain_more_than_the_damper_takes() -> None:
    """A mass that is found to be heavier inside would throw the handle with K·y²/2."""
    mass, period = 1e-4, 1e-3
    ball = Ball(stiffness=40.0, damping=0.005, mass=mass, period=period)
    wall = wall_of(ball, "half_sample")
    wall["cap"], wall["stiffest"], wall["stiffness"] = 1.0, 40.0, 4.0
    gained = taken = 0.0
    for j in range(100):
        angle = 2.0 * np.pi * j / 50.0
        wall["y"] = wall["y_sample"] = y = -0.1 + 0.05 * np.cos(angle)
        wall["v"] = v = -0.05 * 2.0 * np.pi / 0.05 * np.sin(angle)
        before = wall["stiffness"].item()
        taken += wall["damping"].item() * v**2 * period
        put_in_force(wall[0])
        rise = wall["stiffness"].item() - before
        assert rise >= 0.0
        gained += 0.5 * rise * y**2
    assert wall["stiffness"] < 40.0
    # At rest it returns within a second.
    assert gained < 1.5 * taken + 100 * 0.001 * 40.0 * 0.5 * 0.15**2
    assert gained > 0.5 * taken
    wall["v"] = 0.0
    before = wall["stiffness"].item()
    put_in_force(wall[0])
    assert wall["stiffness"] - before == pytest.approx(0.04)
    # The surface, where nothing is loaded, and outside.
    wall["stiffness"], wall["y"], wall["y_sample"] = 4.0, 0.0, -1e-5
    put_in_force(wall[0])
    assert wall["stiffness"] == pytest.approx(4.0 * 1.03)
    wall["y_sample"] = 1e-5
    put_in_force(wall[0])
    assert wall["stiffness"] == pytest.approx(4.0 * 1.03 * 1.2)


def test_absorbed_energy_ends_with_the_contact() -> None:
    wall = wall_of(replace(BALL, tension="budget"), "half_sample")
    wall["absorbed"] = 3.0
    wall["y"] = wall["y_before"] = -0.1
    assert force_at(wall, "half_sample", -0.1, 0.0) > 0.0
    assert wall["absorbed"][0] == 3.0
    force_at(wall, "half_sample", 0.1, 1.0)
    assert wall["absorbed"][0] == 0.0


@pytest.mark.parametrize("theta", [0.05, 0.1, 0.2])
def test_passivity_controller_bounds_the_energy_of_a_bouncing_ball(theta: float) -> None:
    """Alone, the standard wall feeds the ball; controlled, it takes all back within the contact."""
    ball = Ball(stiffness=(theta / 0.1) ** 2, periods=3000)
    y, v, force = sampled_ball(ball, LAWS["standard"])
    assert np.cumsum(force[:-1] * np.diff(y)).max() > 10.0

    y, v, force = sampled_ball(replace(ball, passivity=5.0), LAWS["standard"])
    force = force[:-1]
    out = np.cumsum(force * np.diff(y))
    # Never more than what one contact puts out, ...
    assert out.max() < 0.6
    # ... nothing left over in flight, ...
    in_flight = (y[:-1] >= 0.0) & (force == 0.0)
    assert np.count_nonzero(np.diff(in_flight.astype(int)) == 1) > 20
    assert out[in_flight].max() < 1e-9
    # ... so that the ball does not rise above where it began.
    energy = ball.energy(y, v)
    assert energy[:-1][in_flight].max() < 1.0 + 1e-9


def test_passivity_controller_damps_the_energy_put_out() -> None:
    """α = E/(T·v²), up to the largest damping; none where no energy was put out or v = 0."""
    ball = Ball(stiffness=4.0, period=0.1)

    def damping_force(put_out: float, v: float, largest: float) -> float:
        wall = wall_of(replace(ball, passivity=largest), "midpoint")
        # From y = −1 − E to −1 under a force of 1 the wall has put out E.
        wall["y_before"], wall["force_before"] = -1.0 - put_out, 1.0
        plain = force_at(wall_of(ball, "midpoint"), "midpoint", -1.0, v)
        return force_at(wall, "midpoint", -1.0, v) - plain

    needed = 0.3 / (0.1 * 2.0**2)
    assert damping_force(0.3, 2.0, 10.0) == pytest.approx(-needed * 2.0)
    assert damping_force(0.3, -2.0, 10.0) == pytest.approx(needed * 2.0)
    assert damping_force(0.3, 0.01, 10.0) == pytest.approx(-10.0 * 0.01)
    for put_out, v, largest in ((0.3, 0.0, 10.0), (-0.3, 2.0, 10.0), (0.3, 2.0, 0.0)):
        assert damping_force(put_out, v, largest) == 0.0


def test_the_observer_works_on_the_applied_force() -> None:
    """The force after saturation and rounding counts, not the one that the law returned."""
    ball = Ball(stiffness=100.0)
    wall = wall_of(ball, "midpoint")
    force = force_at(wall, "midpoint", -0.1, 0.0)
    assert force == pytest.approx(10.0)
    set_applied_force(wall[0], 0.25 * force)
    force_at(wall, "midpoint", -0.3, 0.0)
    assert wall["absorbed"][0] == pytest.approx(0.25 * 10.0 * 0.2)
