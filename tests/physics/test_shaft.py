"""Two masses on an elastic shaft, against matrix exponentials, scipy's integrator, and energy."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from canwall.physics import Force, TwoMasses, advance, advance_shaft, make_plant, make_shaft

ROTOR, LOAD, OMEGA = 1e-5, 9e-5, 2.0 * math.pi * 400.0
REDUCED = ROTOR * LOAD / (ROTOR + LOAD)
SHAFT = {"stiffness": OMEGA**2 * REDUCED, "damping": 0.04 * OMEGA * REDUCED}
RATE = 2.0 * math.pi * 1600.0


def shaft(
    coulomb: float = 0.0,
    stiction: float | None = None,
    viscous: float = 0.0,
    cogging: float = 0.0,
    load: tuple[float, float, float] = (LOAD, 0.0, 0.0),
    **changes: float,
) -> NDArray[np.void]:
    rotor: dict[str, Any] = {
        "mass": ROTOR,
        "viscous": viscous,
        "coulomb": coulomb,
        "stiction": stiction,
        "cogging": cogging,
        "cog_pitch": 0.02,
    }
    return make_shaft(rotor, *load, **(SHAFT | changes))


def derivative_matrix(s: Any) -> NDArray[np.float64]:
    """The linear system of (y, v, load_y, load_v), written down from Newton's law."""
    k, c = float(s["stiffness"]), float(s["damping"])
    b = float(s["rotor"]["viscous"][0])
    m, load_b, load_k = (float(s[n]) for n in ("load_mass", "load_viscous", "load_spring"))
    return np.array(
        [
            [0, 1, 0, 0],
            [-k / ROTOR, -(c + b) / ROTOR, k / ROTOR, c / ROTOR],
            [0, 0, 0, 1],
            [k / m, c / m, -(k + load_k) / m, -(c + load_b) / m],
        ]
    )


def test_it_rings_at_its_frequency_and_decays_by_its_ratio() -> None:
    """Free-free: the twist is a damped oscillator, the centre of mass moves on."""
    (s,) = shaft()
    twist, speed = 1e-3, 2.0
    for t in (1e-4, 1e-3, 0.0123):
        now = TwoMasses(
            twist * LOAD / (ROTOR + LOAD), speed, -twist * ROTOR / (ROTOR + LOAD), speed
        )
        nothing = Force(0.0, 0.0, 0.0, 0.0)
        end = advance_shaft(s, now, nothing, nothing, t)
        damped = OMEGA * math.sqrt(1.0 - 0.02**2)
        shape = math.cos(damped * t) + 0.02 * OMEGA / damped * math.sin(damped * t)
        expected = twist * math.exp(-0.02 * OMEGA * t) * shape
        assert end.y - end.load_y == pytest.approx(expected, abs=1e-15)
        centre = (ROTOR * end.y + LOAD * end.load_y) / (ROTOR + LOAD)
        assert centre == pytest.approx(speed * t, rel=1e-12)


@pytest.mark.parametrize("excess", [0.0, 0.3])
def test_without_friction_it_is_the_matrix_exponential(excess: float) -> None:
    (s,) = shaft(viscous=5e-4, load=(1.6e-4, 0.03, 3.2))
    now = np.array([0.01, -1.0, 0.012, 2.0])
    motor, script = Force(0.2, 40.0, excess, RATE), Force(-0.1, 70.0, 0.0, 0.0)
    # The inputs as states: 1, t and what is left of the lag.
    generator = np.zeros((7, 7))
    generator[:4, :4] = derivative_matrix(s)
    generator[1, 4:] = np.array([0.2 - excess, 40.0, excess]) / ROTOR
    generator[3, 4:6] = np.array([-0.1, 70.0]) / 1.6e-4
    generator[5, 4], generator[6, 6] = 1.0, -RATE
    for t in (1e-5, 1e-3, 0.02):
        end = expm(generator * t) @ [*now, 1.0, 0.0, 1.0]
        found = advance_shaft(s, TwoMasses(*now), motor, script, t)
        np.testing.assert_allclose(found, end[:4], rtol=1e-10, atol=1e-13)


def test_a_stiff_shaft_is_none() -> None:
    (s,) = shaft(0.01, 0.015, 5e-4, 3e-3, stiffness=1e6, damping=1.0)
    plant = make_plant(ROTOR + LOAD, 5e-4, 0.0, 0.01, 0.0, 0.0, 3e-3, 0.02, 0.015)[0]
    one, two = (0.0, 0.0), TwoMasses(0.0, 0.0, 0.0, 0.0)
    for u in (0.05, -0.08, 0.012, 0.03, 0.0):
        one = advance(plant, *one, u, 0.0, 5e-3)[:2]
        two = advance_shaft(s, two, Force(u, 0.0, 0.0, 0.0), Force(0.0, 0.0, 0.0, 0.0), 5e-3)
        # Setting out and turning, the rotor rings by some 1e-3 rad/s.
        assert two.y == pytest.approx(one[0], abs=1e-5)
        assert two.v == pytest.approx(one[1], abs=2e-3)


def reference(s: Any, now: TwoMasses, u: float, load_u: float, duration: float) -> tuple[Any, int]:
    """The motion with friction by scipy's integrator and events; and its events."""
    matrix, rotor = derivative_matrix(s), s["rotor"][0]
    coulomb, stiction = float(rotor["coulomb"]), float(rotor["stiction"])
    x, t, events = np.array(now), 0.0, 0

    def pull(x: Any) -> float:
        return float(u + ROTOR * (matrix[1] @ x))

    while t < duration:
        direction = np.sign(x[1])
        if direction == 0.0 and abs(pull(x)) > stiction * (1.0 - 1e-12):
            direction = np.sign(pull(x))

        def derivative(_: float, x: Any, direction: float = direction) -> Any:
            change = matrix @ x
            change[1] += (u - direction * coulomb) / ROTOR
            change[3] += load_u / float(s["load_mass"])
            if direction == 0.0:
                change[0] = change[1] = 0.0
            return change

        begin = t

        def event(t: float, x: Any, direction: float = direction, begin: float = begin) -> float:
            if direction == 0.0:
                return stiction - abs(pull(x))
            return float(direction * x[1]) if t > begin + 1e-9 else 1.0

        event.terminal, event.direction = True, -1.0  # type: ignore[attr-defined]
        piece = solve_ivp(
            derivative, (t, duration), x, "DOP853", rtol=1e-11, atol=1e-14, events=event,
            max_step=2e-5,
        )  # fmt: skip
        x, t = piece.y[:, -1], float(piece.t[-1])
        if piece.status == 1:
            events += 1
            if direction != 0.0:
                x[1] = 0.0
    return x, events


@pytest.mark.parametrize("stiction", [0.02, 0.03])
def test_friction_on_the_rotor_is_as_scipy_has_it(stiction: float) -> None:
    (s,) = shaft(0.02, stiction, 5e-4, load=(1.6e-4, 0.03, 3.2))
    now, events = TwoMasses(0.0, 0.0, 0.004, -0.5), 0
    for u, load_u in ((0.0, 0.0), (0.06, 0.0), (0.0, -0.05), (0.015, 0.1), (-0.03, 0.0)):
        expected, found = reference(s, now, u, load_u, 4e-3)
        events += found
        now = advance_shaft(s, now, Force(u, 0.0, 0.0, 0.0), Force(load_u, 0.0, 0.0, 0.0), 4e-3)
        np.testing.assert_allclose(now, expected, rtol=1e-6, atol=1e-8)
    assert events > 12


@pytest.mark.parametrize("stiction", [0.0, 5e-3])
def test_it_comes_to_rest_in_balance(stiction: float) -> None:
    (s,) = shaft(0.0, stiction, 5e-4, 3e-3, load=(2e-4, 0.02, 1.0))
    draw = np.random.default_rng(1)
    for _ in range(30):
        u, w = float(draw.normal(0.0, 0.03)), float(draw.normal(0.0, 0.03))
        motor, script = Force(u, 0.0, 0.0, 0.0), Force(w, 0.0, 0.0, 0.0)
        now = TwoMasses(0.0, 0.0, 0.0, 0.0)
        for _ in range(1000):
            # A period of the SYNC, which the drive's own cycle divides.
            now = advance_shaft(s, now, motor, script, 8.34e-4)
            now = advance_shaft(s, now, motor, script, 1.66e-4)
        assert max(abs(now.v), abs(now.load_v)) < 1e-9
        twist = now.load_y - now.y
        assert w - s["stiffness"] * twist - now.load_y == pytest.approx(0.0, abs=1e-9)


@settings(derandomize=True, deadline=None, max_examples=40)
@given(st.integers(0, 10_000), st.floats(1.0, 3.0), st.sampled_from([0.0, 3e-3]))
def test_dividing_a_motion_changes_nothing_and_no_energy_comes_of_it(
    seed: int, ratio: float, cogging: float
) -> None:
    draw = np.random.default_rng(seed)
    (s,) = shaft(0.01, 0.01 * ratio, 5e-4, cogging, (1.2e-4, 0.01, 1.0))
    plain = shaft(load=(1.2e-4, 0.01, 1.0))[0]
    assert cogging or plain["stiffness"] == s["stiffness"]

    def energy(x: TwoMasses) -> float:
        twist = x.y - x.load_y
        kinetic = ROTOR * x.v**2 + 1.2e-4 * x.load_v**2
        return 0.5 * (kinetic + x.load_y**2 + float(s["stiffness"]) * twist**2)

    whole = parts = TwoMasses(0.0, *(float(draw.normal(0.0, x)) for x in (1.0, 2e-3, 1.0)))
    for _ in range(8):
        u, w = float(draw.normal(0.0, 0.03)), float(draw.normal(0.0, 0.03))
        slope, lag = float(draw.normal(0.0, 10.0)), float(draw.normal(0.0, 0.02))
        cut = float(draw.uniform(0.0, 1e-3))
        motor, script = Force(u, 0.0, lag, RATE), Force(w, slope, 0.0, 0.0)
        before = whole
        whole = advance_shaft(s, whole, motor, script, 1e-3)
        gone = -math.expm1(-RATE * cut) * lag
        parts = advance_shaft(s, parts, motor, script, cut)
        parts = advance_shaft(
            s,
            parts,
            Force(u - gone, 0.0, lag - gone, RATE),
            Force(w + slope * cut, slope, 0.0, 0.0),
            1e-3 - cut,
        )
        np.testing.assert_allclose(parts, whole, rtol=1e-7, atol=1e-10)
        assert whole != before
    # Left alone it only loses.
    nothing = Force(0.0, 0.0, 0.0, 0.0)
    for _ in range(20):
        after = advance_shaft(s, whole, nothing, nothing, 1e-3)
        cogs = 2.0 * cogging * abs(after.y - whole.y)
        assert energy(after) <= energy(whole) + cogs + 1e-15
        whole = after
