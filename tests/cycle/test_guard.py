"""The guard: its signs on made-up motions, its factor, and walls that buzz or do not."""

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import butter, freqz_sos, sosfilt

from canwall.analysis.felt import filtered
from canwall.config import Settings, load
from canwall.cycle import guard
from canwall.run.closed_loop import simulate
from canwall.sweep.strike import OPERATORS, strike_settings

Array = NDArray[np.float64]

PERIOD, COUNT = 1e-3, 5e-5
CONFIGURATION = load(Path(__file__).parents[2] / "config/sim.toml")


def made(action: str = "act", period: float = PERIOD) -> NDArray[np.void]:
    record = np.zeros(1, guard.GUARD)
    guard.set_guard(record[0], action, period, COUNT)
    return record


def watched(record: NDArray[np.void], y: Array, force: Array) -> Array:
    """Factor after each cycle; force[j] is held from y[j] to y[j + 1]."""
    factors = np.empty(len(y))
    for j in range(len(y)):
        guard.watch(record[0], j, y[j], 0.0, force[j - 1] if j else 0.0, True)
        factors[j] = record["factor"][0]
    return factors


@pytest.mark.parametrize("period", [0.00025, 0.0005, 0.001, 0.002, 0.005, 0.01])
def test_band_pass_is_scipy_s_and_has_its_band(period: float) -> None:
    record = made(period=period)
    signal = np.random.default_rng(0).normal(size=500)
    passed = [filtered(record[0]["sections"], record[0]["states"], value) for value in signal]
    np.testing.assert_allclose(passed, sosfilt(record["sections"][0], signal), atol=1e-12)

    def gain(frequency: float) -> float:
        t = np.arange(int(1.0 / period)) * period
        out = sosfilt(record["sections"][0], np.sin(2.0 * np.pi * frequency * t))
        return float(np.abs(out[len(out) // 2 :]).max())

    assert gain(2.0) < 0.02
    assert gain(35.0) > 0.85
    if period < 0.0005:
        assert gain(1900.0) < 0.05


def ripple(frequency: float, amplitude: float, decay_s: float = math.inf) -> Array:
    t = np.arange(600) * PERIOD
    return np.asarray(0.15 + amplitude * np.exp(-t / decay_s) * np.sin(2.0 * np.pi * frequency * t))


@pytest.mark.parametrize("period", [0.025, 0.05])
def test_slow_cycle_has_no_felt_band(period: float) -> None:
    record = made(period=period)
    forces = np.random.default_rng(0).normal(size=500)
    assert (watched(record, np.full(500, -0.01), forces) == 1.0).all()


@pytest.mark.parametrize("frequency", [65.0, 120.0, 260.0, 430.0])
def test_ripple_that_stays(frequency: float) -> None:
    inside = np.full(600, -0.01)
    factors = watched(made(), inside, ripple(frequency, 0.1))
    assert int(np.flatnonzero(factors < 1.0)[0]) <= 140
    assert factors[-1] == pytest.approx(max(0.3 ** np.count_nonzero(np.diff(factors)), 0.01))
    assert (watched(made(), inside, ripple(frequency, 0.04)) == 1.0).all()
    assert (watched(made(), inside, ripple(frequency, 0.5, 0.05)) == 1.0).all()
    warned = made("warn")
    assert (watched(warned, inside, ripple(frequency, 0.1)) == 1.0).all()
    assert warned["alarms"][0] > 0
    silent = made("off")
    watched(silent, inside, ripple(frequency, 0.1))
    assert silent["alarms"][0] == 0


@pytest.mark.parametrize("frequency", [22.0, 27.0, 35.0])
def test_slow_ripple_within_200_ms(frequency: float) -> None:
    inside = np.full(600, -0.01)
    factors = watched(made(), inside, ripple(frequency, 0.15))
    assert 190 <= int(np.flatnonzero(factors < 1.0)[0]) <= 240
    assert (watched(made(), inside, ripple(frequency, 0.5, 0.1)) == 1.0).all()


def test_push_to_and_fro_is_no_ripple() -> None:
    """A hand does not push as fast as the slowest of the band."""
    assert (watched(made(), np.full(600, -0.01), ripple(12.0, 0.15)) == 1.0).all()


def test_a_step_and_a_steady_push_are_no_ripple() -> None:
    force = np.repeat([0.0, 0.5, 0.1, 1.5], 150)
    assert (watched(made(), np.full(600, -0.01), force) == 1.0).all()


def bounce(restitution: float) -> tuple[Array, Array]:
    """Free flight, half a sine inside with a force that gives e² of the energy back, flight."""
    mass, speed, contact = 2e-4, 1.0, 40
    rate = math.pi / (contact * PERIOD)
    t = np.arange(contact) * PERIOD
    depth = speed / rate * np.sin(rate * t)
    stiffness = mass * rate**2
    force = stiffness * depth * np.where(t < 0.5 * contact * PERIOD, 1.0, restitution**2)
    out = np.arange(60) * PERIOD
    y = np.concatenate([speed * out[::-1], -depth, restitution * speed * out])
    return y, np.concatenate([np.zeros(60), force, np.zeros(60)])


@pytest.mark.parametrize(
    ("restitution", "alarms"), [(0.3, 0), (0.9, 0), (1.0, 0), (1.2, 1), (2.0, 1)]
)
def test_contact_that_feeds_the_handle(restitution: float, alarms: int) -> None:
    record = made()
    factors = watched(record, *bounce(restitution))
    assert record["alarms"][0] == alarms
    assert factors[-1] == (0.1 if alarms else 1.0)
    if alarms:
        assert record["first_alarm"][0] <= 60 + 40 + 10


def test_block_after_an_alarm_begins_with_it() -> None:
    """What the force was before it was lowered does not count against it."""
    record = made()
    y, force = bounce(2.0)
    watched(record, y, force)
    alarm = int(record["first_alarm"][0])
    assert (alarm + 1) % int(record["block"][0]) != 0, "in the middle of a block"
    record = made()
    watched(record, y[: alarm + 1], force[: alarm + 1])
    assert record["alarms"][0] == 1
    assert [float(record[name][0]) for name in ("peak", "squares", "swung")] == [0.0, 0.0, 0.0]


def test_force_returns_slowly() -> None:
    record = made()
    watched(record, *bounce(2.0))
    resting = np.full(9000, 0.1)
    factors = watched(record, resting, np.zeros(9000))
    assert factors[900] == pytest.approx(0.1)
    assert factors[1000 + 2000] / factors[1000] == pytest.approx(math.e, rel=0.1)
    assert factors[-1] == 1.0
    assert record["lowest"][0] == pytest.approx(0.1)


def struck(operator: str, action: str, law: str, k: float, speed: float = 0.7) -> Settings:
    """A strike on a wall of K·T²/m = k, with the model matched."""
    simulation = CONFIGURATION.simulation
    assert simulation is not None
    hand = {key.rsplit(".")[-1]: value for key, value in OPERATORS[operator].keys.items()}
    simulation = simulation.model_copy(update={"hand": simulation.hand.model_copy(update=hand)})
    mass = simulation.inertia_kg_m2 + hand["inertia_kg_m2"]
    model = {
        "inertia_kg_m2": mass,
        "viscous_nm_s_per_rad": simulation.viscous_nm_s_per_rad + hand["damping_nm_s_per_rad"],
    }
    wall = {"law": law, "stiffness_nm_per_rad": k * mass / PERIOD**2, "damping_nm_s_per_rad": 0.0}
    settings = CONFIGURATION.model_copy(
        update={
            "simulation": simulation,
            "mechanics": CONFIGURATION.mechanics.model_copy(update=model),
            "wall": CONFIGURATION.wall.model_copy(update=wall),
            "guard": CONFIGURATION.guard.model_copy(update={"action": action}),
            "schedule": (),
        }
    )
    return strike_settings(settings, speed, 0.3, 0.02, 0.5, 0.15)


def cycles_of(settings: Settings) -> int:
    assert settings.run.duration_s is not None
    return round(settings.run.duration_s / PERIOD)


@pytest.mark.slow
def test_a_guard_that_only_warns_changes_no_bit() -> None:
    runs = [
        simulate(settings, cycles_of(settings)).rows
        for settings in (struck("grip", action, "standard", 1.5) for action in ("off", "warn"))
    ]
    assert runs[0].tobytes() == runs[1].tobytes()


#: K·T²/m at which the plain wall begins to chatter on the servo, by operator.
LIMITS = {"none": 0.006, "finger": 0.055, "grip": 0.037, "arm": 0.004}


@pytest.mark.slow
@pytest.mark.parametrize("operator", LIMITS)
def test_plain_wall_at_20_times_its_limit_is_softened_in_time(operator: str) -> None:
    def strike(action: str) -> tuple[NDArray[np.void], int]:
        settings = struck(operator, action, "standard", 20.0 * LIMITS[operator])
        rows = simulate(settings, cycles_of(settings)).rows
        return rows, int(np.flatnonzero(rows["y"] < 0.0)[0])

    (rows, first), (alone, _) = strike("act"), strike("off")
    assert int(np.flatnonzero(rows["guard"] < 1.0)[0]) - first < 50
    if operator == "none":
        return  # fed once, it has left for its speed limit before the wall could be felt again
    after = slice(first + 200, first + 400)

    def given_off(rows: NDArray[np.void]) -> float:
        return float(np.maximum(rows["force_applied"][:-1] * np.diff(rows["y"]), 0.0)[after].sum())

    assert given_off(rows) < 0.25 * given_off(alone)
    if operator in ("finger", "grip"):
        ripple = sosfilt(made()["sections"][0], rows["force_applied"])[after]
        assert math.sqrt(float((ripple**2).mean())) < 0.1 * 0.08  # 0.1 N at 80 mm


@pytest.mark.slow
@pytest.mark.parametrize("operator", LIMITS)
def test_quiet_walls_are_left_alone(operator: str) -> None:
    # An arm has less than that: half_sample at 0.2 buzzes with 0.6 N.
    known = ("half_sample", 0.02), ("mean_force", 0.1)
    for law, k in (("damped", 0.002), *known):
        for speed in (0.2, 0.5, 1.0):
            settings = struck(operator, "act", law, k, speed)
            assert (simulate(settings, cycles_of(settings)).rows["guard"] == 1.0).all()


@pytest.mark.parametrize("period", [0.00025, 0.0005, 0.001, 0.002, 0.01])
def test_sections_are_those_of_butterworth(period: float) -> None:
    low, high = 20.0, 500.0
    designed = (
        butter(2, (low, high), "bandpass", fs=1.0 / period, output="sos")
        if high < 0.45 / period
        else butter(2, low, "highpass", fs=1.0 / period, output="sos")
    )
    frequencies = np.geomspace(1.0, 0.499 / period, 200)
    _, expected = freqz_sos(designed, frequencies, fs=1.0 / period)
    _, found = freqz_sos(guard.band_pass(period), frequencies, fs=1.0 / period)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_guard_that_is_switched_on_begins_anew() -> None:
    """What it saw before it was off is no part of what it sees afterwards."""
    force = ripple(100.0, 0.3)
    record, fresh = made(), made()
    watched(record, -np.ones(99) * 1e-3, force[:99])
    assert record["alarms"][0] == 0
    guard.change_guard(record[0], "off", -1e-3)
    watched(record, -np.ones(50) * 1e-3, force[:50])
    guard.change_guard(record[0], "act", -1e-3)
    guard.change_guard(fresh[0], "act", -1e-3)
    fresh["way"], fresh["outside"] = record["way"], record["outside"]
    factors = [watched(each, -np.ones(300) * 1e-3, force[:300]) for each in (record, fresh)]
    np.testing.assert_array_equal(*factors)
    assert factors[0][50] == 1.0
    assert factors[0][-1] < 1.0


def test_force_that_was_lowered_rises_when_the_guard_is_switched_off() -> None:
    record = made()
    factors = watched(record, -np.ones(300) * 1e-3, ripple(100.0, 0.3)[:300])
    assert factors[-1] < 0.5
    guard.change_guard(record[0], "off", -1e-3)
    risen = watched(record, np.ones(12_000), np.zeros(12_000))
    assert (risen[:-1] <= risen[1:]).all()
    assert np.diff([factors[-1], *risen]).max() < 1e-3
    assert risen[-1] == 1.0
