"""The delay D: by the fit alone, and as the loop measures it on the simulated drive."""

import math
import threading
import time

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rig import SIM_CONFIG, Loop, RigFactory, settings_with

from canwall import config
from canwall.config import Mechanics, Settings
from canwall.cycle.delay import Delay, DelayTest, agreed_delay, excitation, measured_delay
from canwall.physics import zoh
from canwall.record import Phase
from canwall.walls import MAX_DELAY
from canwall.walls.estimator import kalman_model

COUNT = 2.0 * np.pi / 131072
PERIOD = 1e-3
#: The master's model of the handle.
KNOWN = Mechanics(inertia_kg_m2=2e-4, viscous_nm_s_per_rad=1e-3)


def response(
    torque: np.ndarray, delay: float, mass: float, viscous: float, period: float
) -> np.ndarray:
    """Positions at each SYNC under torques that take effect `delay` periods after them.

    By the zero-order-hold equivalent over the two parts of each period (docs/laws.md).
    """
    n = int(delay)
    share = delay - n
    parts = [zoh(mass, viscous, 0.0, part * period) for part in (share, 1.0 - share)]
    held = np.concatenate([np.zeros(n + 1), torque])
    state = np.zeros(2)
    position = np.zeros(len(torque))
    for j in range(len(torque)):
        position[j] = state[0]
        for (phi, gamma), force in zip(parts, (held[j], held[j + 1]), strict=True):
            state = phi @ state + gamma * force
    return position


@pytest.mark.slow
@settings(deadline=None, max_examples=60)
@example(delay=0.8046875, mass=5e-5, viscous=0.0)  # a fit that stops where sticking begins
@given(
    delay=st.floats(0.0, 3.0),
    mass=st.floats(5e-5, 1e-3),
    viscous=st.floats(0.0, 0.03),
)
def test_fit_finds_the_delay(delay: float, mass: float, viscous: float) -> None:
    torque = 0.15 * excitation(400, 2)
    position = response(torque, delay, mass, viscous, PERIOD)
    found = measured_delay(position, torque, PERIOD, KNOWN)
    assert found.value == pytest.approx(delay, abs=1e-3)


def test_encoder_hides_little_of_the_delay() -> None:
    torque = 0.15 * excitation(400, 3)
    for delay in (0.0, 0.35, 1.0, 1.5, 2.0):
        position = response(torque, delay, 1.64e-4, 5e-4, PERIOD)
        counts = np.round(position / COUNT) * COUNT
        found = measured_delay(counts, torque, PERIOD, KNOWN)
        assert found.value == pytest.approx(delay, abs=0.02)
        assert found.half < 0.02


def test_missing_positions_are_left_out() -> None:
    torque = 0.15 * excitation(400, 3)
    position = response(torque, 1.0, 1.64e-4, 5e-4, PERIOD)
    position[::37] = np.nan
    assert measured_delay(position, torque, PERIOD, KNOWN).value == pytest.approx(1.0, abs=0.02)


def test_handle_that_does_not_follow_tells_nothing() -> None:
    torque = 0.15 * excitation(400, 3)
    noise = np.random.default_rng(1).normal(size=400) * COUNT
    for position in (np.zeros(400), noise):
        with pytest.raises(ValueError, match="the delay cannot be measured"):
            measured_delay(position, torque, PERIOD, KNOWN)


def pushed(torque: np.ndarray, push: np.ndarray, seed: int) -> np.ndarray:
    """Counts under torques that act a period later, and under a hand that pushes as well."""
    noise = np.random.default_rng(seed).normal(size=len(torque)) * COUNT / 4.0
    position = response(torque, 1.0, 1.64e-4, 5e-4, PERIOD)
    position += response(push, 0.0, 1.64e-4, 5e-4, PERIOD)
    return np.round((position + noise) / COUNT) * COUNT


@pytest.mark.slow
def test_hand_is_refused_or_does_no_harm() -> None:
    """Rubbing and shaking up to 200 Hz, from a hundredth of the test's torque to most of it."""
    refused = 0
    for seed in range(16):
        draw = np.random.default_rng(seed)
        steps = draw.normal(size=400)
        smooth = np.convolve(steps, np.hanning(draw.integers(5, 150)), "same")
        push = 10.0 ** draw.uniform(-3.0, -1.0) * smooth / np.abs(smooth).max()
        found = []
        try:
            for k in range(2):
                torque = 0.15 * excitation(400, 3, 402 + k)
                position = pushed(torque, np.roll(push, 200 * k), seed)
                found.append(measured_delay(position, torque, PERIOD, KNOWN))
            delay = agreed_delay(found)
        except ValueError:
            refused += 1
        else:
            assert delay.value == pytest.approx(1.0, abs=delay.half + 0.02)
    assert 0 < refused < 16


def test_measurements_that_differ_tell_nothing() -> None:
    found = agreed_delay([Delay(1.09, 0.01), Delay(1.11, 0.01)])
    assert found.value == pytest.approx(1.10)
    assert found.half >= 0.01
    with pytest.raises(ValueError, match=r"1\.099 and 1\.273 cycles"):
        agreed_delay([Delay(1.099, 0.01), Delay(1.273, 0.05)])


def test_excitation_gives_the_handle_no_lasting_speed() -> None:
    for length in (1, 3, 8):
        signs = excitation(401, length)
        assert signs.shape == (401,)
        assert set(signs.tolist()) == {-1, 0, 1}
        assert np.abs(np.cumsum(signs)).max() == length
        assert np.cumsum(signs)[-1] == 0


def ticked(torque: np.ndarray, phase: float, every: float) -> np.ndarray:
    """Positions that a drive latches at ticks of its own, at which it takes torques over.

    Times in periods; the torques are those of the SYNC before.
    """
    steps = 1000
    tick = round(every * steps)
    now = np.arange(len(torque) * steps)
    last = np.maximum((now - round(phase * tick)) // tick * tick + round(phase * tick), 0)
    force = np.concatenate([[0.0], torque])[last // steps]
    h = PERIOD / steps
    v = np.concatenate([[0.0], np.cumsum(force)[:-1]]) * h / 2e-4
    position = np.cumsum(v + 0.5 * h * force / 2e-4) * h
    return np.concatenate([[0.0], position])[last[::steps]]


@pytest.mark.parametrize("phase", [0.05, 0.55])
@pytest.mark.parametrize("length", [2, 4])
def test_ticks_of_the_drive_do_not_keep_step_with_the_torques(length: int, phase: float) -> None:
    """A tick every 0.4 ms has one of two phases against the SYNC, in turn."""
    torque = 0.15 * excitation(400, length)
    found = measured_delay(ticked(torque, phase, 0.4), torque, PERIOD, KNOWN)
    assert found.value == pytest.approx(1.4, abs=0.04)


def with_hand_at_rest(settings: Settings) -> Settings:
    """Let the first strike come after the measurement."""
    assert settings.simulation is not None
    at_rest = settings.simulation.hand.model_copy(update={"first_strike_s": 1.0})
    simulation = settings.simulation.model_copy(update={"hand": at_rest})
    return settings.model_copy(update={"simulation": simulation})


@pytest.mark.parametrize("given", [0.0, 0.35, 1.0, 2.0])
def test_loop_measures_the_delay_that_the_drive_was_given(
    make_rig: RigFactory, given: float
) -> None:
    asynchronous = given < 1.0
    extra = given if asynchronous else given - 1.0
    settings = settings_with(
        {
            "estimator.measure_delay": True,
            "simulation.ideal": True,
            "simulation.torque_delay_cycles": extra,
        }
    )
    rig = make_rig(with_hand_at_rest(settings))
    loop = Loop(rig)
    if asynchronous:
        rig.node.write(0x1400, 2, 255)
    outcome = loop.run(870)
    assert outcome.trips == []
    # Never less; within 2 %, and of a period where there is no delay.
    assert loop.axis.delay == pytest.approx(given, rel=0.02, abs=0.02 if given == 0.0 else 0.0)
    assert loop.axis.delay > given - 1e-3
    rows = loop.rows()
    measuring = rows[rows["phase"] == Phase.MEASURING]
    assert len(measuring) == 850 + MAX_DELAY + 1
    assert np.ptp(measuring["position_rad"]) < 0.05


def test_run_that_is_over_before_its_wall_says_so(make_rig: RigFactory) -> None:
    settings = settings_with({"estimator.measure_delay": True})
    (trip,) = Loop(make_rig(with_hand_at_rest(settings))).run(500).trips
    assert "run.duration_s was over before the wall began" in trip
    assert "took 0.8" in trip


def test_syncs_that_were_left_out_are_in_the_record(make_rig: RigFactory) -> None:
    """The torque in force stayed in force, and the positions are not known."""
    test = DelayTest(Loop(make_rig(settings_with({"estimator.measure_delay": True}))).axis)
    row, cycle = test.axis.row, test.axis.cycle
    row["received"] = True
    for j, torque in enumerate((1.0, 2.0, 3.0)):
        cycle["skipped_sync"] += 2 if j == 2 else 0
        row["position_rad"], row["torque_cmd"] = 0.1 * j, torque
        test.excite()
        test.note()
    np.testing.assert_allclose(test._positions, [0.0, 0.1, np.nan, np.nan, 0.2])
    assert test._forces == [1.0, 1.0, 1.0, 2.0, 3.0]


@pytest.mark.parametrize(("first_s", "told"), [(0.2, True), (2.0, False)])
def test_strike_during_the_measurement_is_told(
    make_rig: RigFactory, first_s: float, told: bool
) -> None:
    settings = {
        "estimator.measure_delay": True,
        "simulation.coulomb_nm": 0.5,  # which the torques do not move
        "simulation.hand.first_strike_s": first_s,
    }
    rig = make_rig(config.with_overrides(settings_with(), settings))
    (trip,) = Loop(rig).run(870).trips
    assert "the delay cannot be measured" in trip
    assert (" at 0.2 s: without simulation.hand.first_strike_s" in trip) is told


@pytest.mark.parametrize(
    ("known", "law", "measures"),
    [
        ({}, "mean_force", True),
        ({}, "standard", False),
        ({"drive.current_bandwidth_hz": 1600.0}, "mean_force", False),
        ({"estimator.delay_cycles": 1.4}, "mean_force", False),
        ({"estimator.measure_delay": False}, "mean_force", False),
        ({"drive.torque_pdo": "immediate"}, "standard", True),
        ({"drive.torque_pdo": "immediate", "estimator.delay_cycles": 0.4}, "mean_force", False),
    ],
)
def test_it_is_measured_where_nothing_tells_it(
    make_rig: RigFactory, known: dict[str, object], law: str, measures: bool
) -> None:
    unknown = {"drive.current_bandwidth_hz": 0.0, "estimator.measure_delay": "auto"}
    settings = config.load(SIM_CONFIG, {**unknown, "wall.law": law, **known})
    settings = settings.model_copy(update={"schedule": ()})
    assert Loop(make_rig(settings)).axis.measures_delay is measures


def test_lag_of_a_servo_that_nothing_tells(make_rig: RigFactory) -> None:
    unknown = {"drive.current_bandwidth_hz": 0.0, "drive.drive_cycle_s": 0.0}
    settings = config.load(SIM_CONFIG, unknown)
    loop = Loop(make_rig(with_hand_at_rest(settings)))
    assert loop.run(870).trips == []
    lag_s = 1.0 / (2.0 * math.pi * 1600.0)
    assert loop.axis.delay == pytest.approx(1.0 + (0.00025 + lag_s) / PERIOD, abs=0.03)


def test_syncs_go_on_during_the_fit(make_rig: RigFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the clock, no watchdog waits for the fit and its gains; in simulated time none has to."""
    fitting = threading.Event()

    def measured(test: DelayTest) -> Delay:
        assert fitting.wait(10.0)
        return Delay(1.4, 0.0371)

    monkeypatch.setattr(DelayTest, "measured", measured)
    adapting = {"bus.pace": "real_time", "operator.adapt": True}
    axis = Loop(make_rig(settings_with(adapting))).axis
    test = DelayTest(axis)
    kalman_model.cache_clear()
    for _ in range(test.cycles + 3):
        assert test.excite()
        test.note()
    assert axis.cycle["test_per_mille"] == 0
    fitting.set()
    deadline = time.monotonic() + 10.0
    while test.excite():
        assert time.monotonic() < deadline
    computed = kalman_model.cache_info().misses
    test.conclude()
    assert axis.delay == pytest.approx(1.4371)
    assert kalman_model.cache_info().misses == computed > 0
