"""The estimator against the Riccati recursion, Butterworth poles and exactly propagated motion."""

import cmath
import math
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from canwall.physics import advance, flow, make_plant, zoh
from canwall.walls import (
    ESTIMATOR,
    MAX_DELAY,
    actuation_state,
    correct,
    note_missing_sample,
    predict,
    reset_estimator,
    set_estimator,
    stand_still,
)
from canwall.walls.estimator import kalman_model

Array = NDArray[np.float64]

PERIOD = 1e-3
COUNT = 2.0 * math.pi / 2**17
WALK = 0.2
DELAYS = (0.0, 1.0, 2.0, 0.35, 1.6, float(MAX_DELAY))


@dataclass(frozen=True)
class Model:
    """The plant, as the estimator models it."""

    mass: float = 1.64e-4
    viscous: float = 0.0
    spring: float = 0.0
    coulomb: float = 0.0


MODELS = (Model(), Model(viscous=0.0261, spring=3.2), Model(mass=0.6, viscous=6.5, spring=135.0))


def make_estimator(
    model: Model, delay: float, walk: float = WALK, period: float = PERIOD
) -> NDArray[np.void]:
    estimator = np.zeros(1, ESTIMATOR)
    set_estimator(
        estimator,
        model.mass,
        model.viscous,
        model.spring,
        model.coulomb,
        period,
        COUNT,
        walk,
        delay,
    )
    return estimator


def augmented(model: Model) -> Array:
    """Transition of [y, ẏ, d] over one period, the bias force held."""
    phi, gamma = zoh(model.mass, model.viscous, model.spring, PERIOD)
    a = np.eye(3)
    a[:2, :2], a[:2, 2] = phi, gamma
    return a


def gain_of(model: Model, walk: float = WALK) -> Array:
    return kalman_model(model.mass, model.viscous, model.spring, PERIOD, COUNT, walk).gain


def bandwidth(mass: float, walk: float) -> float:
    """ω of the continuous filter of a pure mass: ω⁶ = q²/(m²·R·T)."""
    return math.pow((walk / mass) ** 2 / (COUNT**2 / 12.0 * PERIOD), 1.0 / 6.0)


@pytest.mark.parametrize("walk", [0.01, 0.2, 5.0])
@pytest.mark.parametrize("model", MODELS)
def test_gain_is_the_limit_of_the_riccati_recursion(model: Model, walk: float) -> None:
    a, c = augmented(model), np.array([1.0, 0.0, 0.0])
    noise = np.diag([0.0, 0.0, walk**2 * PERIOD])
    covariance = np.diag([COUNT**2, 1.0, 1.0])
    for _ in range(5000):
        gain = covariance @ c / (c @ covariance @ c + COUNT**2 / 12.0)
        corrected = covariance - np.outer(gain, c @ covariance)
        covariance = a @ corrected @ a.T + noise
        covariance = 0.5 * (covariance + covariance.T)
    np.testing.assert_allclose(gain_of(model, walk), gain, rtol=1e-6)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("walk", [1e-3, 0.2, 100.0])
def test_filter_is_stable(model: Model, walk: float) -> None:
    error = augmented(model) @ (np.eye(3) - np.outer(gain_of(model, walk), [1.0, 0.0, 0.0]))
    assert np.abs(np.linalg.eigvals(error)).max() < 1.0


@pytest.mark.parametrize("mass", [1e-5, 1.64e-4, 0.6])
def test_poles_of_a_mass_are_butterworth_at_the_bandwidth(mass: float) -> None:
    model = Model(mass=mass)
    for share in (0.003, 0.03, 0.3):
        omega = share / PERIOD
        walk = mass * COUNT * math.sqrt(PERIOD / 12.0) * omega**3
        assert bandwidth(mass, walk) == pytest.approx(omega)
        error = augmented(model) @ (np.eye(3) - np.outer(gain_of(model, walk), [1.0, 0.0, 0.0]))
        poles = [cmath.log(z) / PERIOD for z in np.linalg.eigvals(error)]
        expected = [omega * cmath.exp(1j * math.radians(angle)) for angle in (120, 180, 240)]
        for pole in expected:
            # The sampled filter approaches the continuous one as its bandwidth falls.
            assert min(abs(p - pole) for p in poles) < 1.1 * share * omega


def test_gain_does_not_depend_on_units() -> None:
    model = MODELS[1]
    kilogram, metre, second = 1e3, 1e2, 1e6
    newton = kilogram * metre / second**2
    scaled = kalman_model(
        model.mass * kilogram,
        model.viscous * kilogram / second,
        model.spring * kilogram / second**2,
        PERIOD * second,
        COUNT * metre,
        WALK * newton / math.sqrt(second),
    )
    expected = gain_of(model) * np.array([1.0, 1.0 / second, newton / metre])
    np.testing.assert_allclose(scaled.gain, expected, rtol=1e-7)


class Bench:
    """The plant itself, moved by forces that take effect D periods after their sample."""

    def __init__(self, model: Model, delay: float, bias: float, y: float, v: float) -> None:
        self.model, self.delay, self.bias = model, delay, bias
        self.y, self.v = y, v
        self.whole = math.floor(delay)
        self.forces = [0.0] * (self.whole + 1)
        self.fraction = (delay - self.whole) * PERIOD

    def _state_after(self, pieces: list[tuple[float, float]]) -> tuple[float, float]:
        y, v = self.y, self.v
        m, b, k = self.model.mass, self.model.viscous, self.model.spring
        for force, duration in pieces:
            if self.model.coulomb:
                plant = make_plant(m, b, k, self.model.coulomb)[0]
                y, v, _ = advance(plant, y, v, force + self.bias, 0.0, duration)
            else:
                y, v = flow(m, b, k, y, v, force + self.bias, 0.0, duration)
        return y, v

    def at_actuation(self) -> tuple[float, float]:
        """State D periods after the sample: only the forces in flight act until then."""
        oldest, *others = self.forces[-(self.whole + 1) :]
        return self._state_after([(oldest, self.fraction), *((f, PERIOD) for f in others)])

    def step(self, force: float) -> None:
        """Advance to the next sample; `force` was computed from this one."""
        self.forces.append(force)
        before, after = self.forces[-(self.whole + 2) :][:2]
        self.y, self.v = self._state_after(
            [(before, self.fraction), (after, PERIOD - self.fraction)]
        )


def wanted(j: int) -> float:
    """A force that does not repeat within a delay."""
    return 0.3 * math.sin(0.7 * j) - 0.1 * math.cos(2.9 * j)


@pytest.mark.parametrize("delay", DELAYS)
@pytest.mark.parametrize("model", MODELS)
def test_state_at_actuation_follows_from_the_forces_in_flight(model: Model, delay: float) -> None:
    """From the true state and bias it predicts the motion of the plant without corrections."""
    bench = Bench(model, delay, bias=-0.2, y=0.01, v=-1.5)
    estimator = make_estimator(model, delay)
    reset_estimator(estimator, 0.01)
    estimator["v"], estimator["d"] = -1.5, -0.2
    for j in range(60):
        assert estimator["y"][0] == pytest.approx(bench.y, rel=0.0, abs=1e-12)
        assert estimator["v"][0] == pytest.approx(bench.v, rel=0.0, abs=1e-9)
        y, v = actuation_state(estimator[0])
        assert (y, v) == pytest.approx(bench.at_actuation(), rel=1e-10, abs=1e-10)
        predict(estimator[0], wanted(j))
        bench.step(wanted(j))


@pytest.mark.parametrize("delay", DELAYS)
@pytest.mark.parametrize("model", MODELS)
def test_converges_to_state_and_bias_with_a_true_model(model: Model, delay: float) -> None:
    bench = Bench(model, delay, bias=-0.3, y=0.02, v=1.2)
    estimator = make_estimator(model, delay)
    reset_estimator(estimator, 0.0)
    for j in range(700):
        correct(estimator[0], bench.y)
        force = wanted(j)
        predict(estimator[0], force)
        bench.step(force)
    correct(estimator[0], bench.y)
    assert estimator["y"][0] == pytest.approx(bench.y, rel=0.0, abs=1e-9)
    assert estimator["v"][0] == pytest.approx(bench.v, rel=0.0, abs=1e-6)
    assert estimator["d"][0] == pytest.approx(-0.3, rel=1e-6)
    assert actuation_state(estimator[0]) == pytest.approx(bench.at_actuation(), rel=0.0, abs=1e-6)


@settings(derandomize=True, deadline=None, max_examples=40)
@given(st.floats(0.0, float(MAX_DELAY)), st.floats(-1.0, 1.0))
def test_any_delay(delay: float, bias: float) -> None:
    model = MODELS[1]
    bench = Bench(model, delay, bias, y=0.0, v=0.0)
    estimator = make_estimator(model, delay)
    reset_estimator(estimator, 0.0)
    estimator["d"] = bias
    for j in range(12):
        predict(estimator[0], wanted(j))
        bench.step(wanted(j))
    assert actuation_state(estimator[0]) == pytest.approx(bench.at_actuation(), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("v", [20.0, -20.0])
@pytest.mark.parametrize("delay", [0.0, 1.0, 1.6])
def test_friction_of_a_sliding_handle_is_in_the_model(delay: float, v: float) -> None:
    model = Model(viscous=5e-4, coulomb=0.01)
    bench = Bench(model, delay, bias=0.004, y=0.0, v=v)
    estimator = make_estimator(model, delay)
    reset_estimator(estimator, 0.0)
    estimator["v"], estimator["d"] = v, 0.004
    for j in range(100):
        assert actuation_state(estimator[0]) == pytest.approx(bench.at_actuation(), rel=1e-9)
        predict(estimator[0], 0.1 * wanted(j))
        bench.step(0.1 * wanted(j))
    assert abs(bench.v) > 5.0


def test_friction_stops_but_does_not_push() -> None:
    model = Model(coulomb=0.01)
    estimator = make_estimator(model, 1.0)
    # Friction could take twice this momentum within one period.
    speed = 0.5 * model.coulomb / model.mass * PERIOD
    for v in (speed, -speed, 0.0):
        reset_estimator(estimator, 0.3)
        estimator["v"] = v
        _, v_end = actuation_state(estimator[0])
        assert v_end == pytest.approx(0.0, abs=1e-15)


def test_correction_is_the_gain_times_the_innovation() -> None:
    estimator = make_estimator(MODELS[1], 1.0)
    reset_estimator(estimator, 0.25)
    correct(estimator[0], 0.26)
    gain = gain_of(MODELS[1])
    assert estimator["y"][0] == pytest.approx(0.25 + 0.01 * gain[0], rel=1e-12)
    assert estimator["v"][0] == pytest.approx(0.01 * gain[1], rel=1e-10)
    assert estimator["d"][0] == pytest.approx(0.01 * gain[2], rel=1e-10)


class Riccati:
    """The covariance of [y, ẏ, d] by the textbook recursion, in extended precision."""

    def __init__(self, model: Model, period: float, walk: float) -> None:
        phi, gamma = zoh(model.mass, model.viscous, model.spring, period)
        self.a = np.eye(3, dtype=np.longdouble)
        self.a[:2, :2], self.a[:2, 2] = phi, gamma
        self.noise = np.diag(np.array([0.0, 0.0, walk**2 * period], np.longdouble))
        self.r = np.longdouble(COUNT) ** 2 / 12
        self.p = np.diag(np.array([COUNT, 1.0, 1.0], np.longdouble) ** 2)
        for _ in range(5000):
            self.step(True)

    def step(self, received: bool) -> Array:
        """Advance to the next sample; return the gain of this one."""
        gain = self.p[:, 0] / (self.p[0, 0] + self.r)
        if received:
            rest = np.eye(3) - np.outer(gain, [1.0, 0.0, 0.0])
            # Joseph's form keeps it symmetrical and positive.
            self.p = rest @ self.p @ rest.T + self.r * np.outer(gain, gain)
        self.p = self.a @ self.p @ self.a.T + self.noise
        return gain.astype(float)


def losses(seed: int, cycles: int, share: float, burst: float) -> NDArray[np.bool_]:
    """Gilbert's losses: bursts of a mean length, a share of all samples."""
    random = np.random.default_rng(seed)
    lost, now = np.zeros(cycles, bool), False
    for j, number in enumerate(random.random(cycles)):
        now = number >= 1.0 / burst if now else number < share / (1.0 - share) / burst
        lost[j] = now
    return lost


@pytest.mark.parametrize("period", [2.5e-4, 1e-3, 1e-2])
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(("share", "burst"), [(0.05, 1.2), (0.5, 2.0), (0.3, 8.0)])
def test_gain_after_missing_samples_is_that_of_the_riccati_recursion(
    model: Model, period: float, share: float, burst: float
) -> None:
    estimator = make_estimator(model, 1.0, period=period)
    reset_estimator(estimator, 0.0)
    riccati = Riccati(model, period, WALK)
    for missing in losses(1, 300, share, burst):
        if missing:
            note_missing_sample(estimator[0])
        else:
            correct(estimator[0], 0.0)
        expected = riccati.step(not missing)
        if not missing:
            np.testing.assert_allclose(estimator["gain"][0], expected, rtol=1e-4)
        predict(estimator[0], 0.0)


@pytest.mark.parametrize("period", [2.5e-4, 1e-3, 1e-2])
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("gap", [1, 5, 40, 10_000])
def test_gain_returns_to_exactly_the_steady_state(model: Model, period: float, gap: int) -> None:
    estimator = make_estimator(model, 1.0, period=period)
    reset_estimator(estimator, 0.0)
    for _ in range(gap):
        note_missing_sample(estimator[0])
        predict(estimator[0], 0.0)
    assert not estimator["settled"][0]
    for _ in range(2000):
        correct(estimator[0], 0.0)
        assert np.isfinite(estimator["gain"]).all()
        predict(estimator[0], 0.0)
    assert estimator["settled"][0]
    assert (estimator["gain"] == estimator["steady_gain"]).all()


def test_without_gaps_the_filter_never_leaves_the_steady_state() -> None:
    estimator = make_estimator(MODELS[1], 1.0)
    reset_estimator(estimator, 0.0)
    for j in range(100):
        correct(estimator[0], 1e-3 * j)
        predict(estimator[0], 0.0)
        assert estimator["settled"][0]


def test_reset_clears_state_and_forces_in_flight() -> None:
    estimator = make_estimator(MODELS[0], 1.6)
    for j in range(5):
        correct(estimator[0], 0.1 * j)
        predict(estimator[0], 1.0)
    reset_estimator(estimator, -0.7)
    assert actuation_state(estimator[0]) == (-0.7, 0.0)
    predict(estimator[0], 0.0)
    assert actuation_state(estimator[0]) == (-0.7, 0.0)


@pytest.mark.parametrize("delay", [-0.1, MAX_DELAY + 0.1, math.nan, math.inf])
def test_a_delay_out_of_range_is_refused(delay: float) -> None:
    with pytest.raises(ValueError, match=r"delay of .* is not between 0 and 3"):
        make_estimator(MODELS[0], delay)


@pytest.mark.parametrize("margin", [0.05, 0.1, 0.15, 0.3, 0.4, 0.8, 0.9])
@pytest.mark.parametrize("delay", [1.0, 2.0])
def test_torque_in_force_while_the_master_stands_still_is_that_of_the_delay(
    delay: float, margin: float
) -> None:
    """(1 + 0.15) − 0.15 is less than 1."""
    estimator = make_estimator(MODELS[0], delay)
    set_estimator(estimator, 1.0, 0.0, 0.0, 0.0, PERIOD, COUNT, WALK, delay + margin, margin)
    estimator["in_flight"][0, :4] = [1.0, 2.0, 3.0, 4.0]
    stand_still(estimator[0], 1)
    assert estimator["v"][0] == pytest.approx((1.0 + delay) * PERIOD)
