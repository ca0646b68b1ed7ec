"""Fit of a servo: against servos of its own integration, whose parameters are known."""

import math
import tomllib
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.signal import lsim
from servo_bench import Truth, free_settings, play
from thirty_servos import AIMS, compared, error, identified

from canwall.identify import Identified, UntellingDataError, fit_servo, toml_fragment
from canwall.identify.break_away import break_away
from canwall.identify.estimates import Estimate
from canwall.identify.excitation import Excitation
from canwall.identify.pieces import PIECE, encoder_step, steady_pieces, torque_response

PERIOD = 1e-3
COUNT = 2.0 * math.pi / 131072


def test_response_is_that_of_scipy() -> None:
    """Torques delayed by 1.3 periods, through a lag, on an inertia and on a resonance."""
    torque = np.random.default_rng(1).normal(size=20)
    lag, omega, zeta = 2e-4, 2.0 * math.pi * 300.0, 0.03
    response = torque_response(torque, PERIOD, 1.3, lag, 300.0, zeta)
    fine = 50
    held = np.concatenate([np.zeros(round(1.3 * fine)), np.repeat(torque, fine)])[: 20 * fine]
    time = np.arange(20 * fine) * PERIOD / fine
    for column, denominator in enumerate(([1.0, 0.0, 0.0], [1.0, 2.0 * zeta * omega, omega**2])):
        _, expected, _ = lsim(
            ([1.0], np.polymul([lag, 1.0], denominator)), held, time, interp=False
        )
        scale = np.abs(expected).max()
        assert response[:, column] / scale == pytest.approx(expected[::fine] / scale, abs=1e-5)


def test_pieces_keep_their_direction() -> None:
    time = np.arange(2000) * PERIOD
    position = np.sin(2.0 * np.pi * time)
    position[100] = np.nan
    first, sign = steady_pieces(position, PERIOD, COUNT)
    assert len(first) > 40
    for begin, way in zip(first, sign, strict=True):
        moved = way * np.diff(position[begin : begin + PIECE])
        assert (moved > 2.0 * COUNT).all()
        assert not begin <= 100 < begin + PIECE


def test_coarse_encoder_tells_the_direction_over_some_samples() -> None:
    """At most 2 rad/s are 1.3 of its steps a period: no single period tells the way."""
    step = 2.0 * math.pi / 4096
    time = np.arange(2000) * PERIOD
    true = np.sin(2.0 * time)
    first, sign = steady_pieces(np.floor(true / step) * step, PERIOD, step)
    assert len(first) > 20
    for begin, way in zip(first, sign, strict=True):
        assert (way * np.diff(true[begin : begin + PIECE]) > 0.0).all()


def test_handle_that_hardly_moves_tells_nothing() -> None:
    torque = 0.1 * np.random.default_rng(2).normal(size=4000)
    with pytest.raises(UntellingDataError, match="moved too little"):
        fit_servo(np.zeros(4000), torque, PERIOD, COUNT)


def test_handle_that_something_else_drives_tells_nothing() -> None:
    time = np.arange(8000) * PERIOD
    torque = 0.1 * np.random.default_rng(2).normal(size=8000)
    position = np.round(2.0 * np.sin(3.0 * time) / COUNT) * COUNT
    with pytest.raises(UntellingDataError):
        fit_servo(position, torque, PERIOD, COUNT)


@pytest.mark.parametrize("delay", [1.0, 10.0])
def test_break_away_of_a_ramp(delay: float) -> None:
    """A handle at 0.3 rad that breaks loose at 12 mN·m under 0.2 N·m/s, without other friction."""
    rate, inertia = 0.2, 1e-4
    time = np.arange(-150, 200) * PERIOD
    torque = rate * np.maximum(time, 0.0)
    free = np.maximum(time - 0.06 - delay * PERIOD, 0.0)
    position = 0.3 + np.round(rate * free**3 / (6.0 * inertia) / COUNT) * COUNT
    place, loose, uncertain = break_away(position, torque, PERIOD, COUNT, inertia, delay)
    assert place == pytest.approx([0.3])
    assert loose == pytest.approx([0.012], abs=float(uncertain[0]))
    assert uncertain[0] < 0.001


@pytest.mark.parametrize("rest", [-0.45, 0.0, 0.45])
@pytest.mark.parametrize("loose_at", [60.0, 60.3, 60.7])
def test_torque_of_break_away_is_that_of_a_held_ramp(loose_at: float, rest: float) -> None:
    """Friction that stays as it was at rest, and a handle that rests anywhere in its count."""
    rate, inertia, delay, fine = 0.05, 1e-4, 1.25, 100
    torque = rate * PERIOD * np.maximum(np.arange(-150, 200), 0)
    commanded = (np.arange(350 * fine) / fine - delay).astype(int)
    holds = rate * PERIOD * loose_at
    free = np.maximum(torque[np.maximum(commanded, 0)] - holds, 0.0)
    speed = np.cumsum(free) * PERIOD / fine / inertia
    position = 0.3 + COUNT * rest + np.cumsum(speed)[::fine] * PERIOD / fine
    position = np.round(position / COUNT) * COUNT
    _, loose, uncertain = break_away(position, torque, PERIOD, COUNT, inertia, delay)
    assert loose == pytest.approx([holds], abs=float(uncertain[0]))


def test_torque_that_passes_through_zero_is_no_ramp() -> None:
    time = np.arange(2000) * PERIOD
    torque = np.round(0.05 * np.sin(2.0 * np.pi * time), 3)
    place, _, _ = break_away(np.cumsum(torque) * 1e-2, torque, PERIOD, COUNT, 1e-4, 1.0)
    assert np.count_nonzero((torque[1:] != 0.0) & (torque[:-1] == 0.0)) >= 3
    assert len(place) == 0


def test_step_of_an_encoder_that_counts_in_fours() -> None:
    assert encoder_step(np.array([3, 7, 15, 15, 3], np.int64)) == 4


def test_interval() -> None:
    assert Estimate(1.0, 0.1).contains(1.05)
    assert not Estimate(1.0, 0.1).contains(1.2)


@pytest.mark.slow
def test_excitation_stays_within_its_bounds() -> None:
    """Also with an inertia of [mechanics] that is too large by half, and an elastic shaft."""
    settings = free_settings(1.5e-4)
    excitation = Excitation(settings, 1.9)
    truth = Truth(shaft_hz=300.0, drive_cycle=2.5e-4)
    position, torque = play(settings, truth, excitation)
    low, high = settings.limits.position_rad
    assert low < position.min() < -1.5
    assert 1.5 < position.max() < high
    assert np.abs(np.diff(position)).max() / PERIOD < settings.limits.speed_rad_s
    assert np.abs(torque).max() <= excitation.bounds.torque_nm * 1.01
    assert len(position) * PERIOD <= excitation.duration_s < 60.0


@pytest.mark.slow
@pytest.mark.parametrize(("hz", "ratio"), [(400.0, 0.02), (250.0, 0.05)])
def test_small_rotor_of_a_heavy_handle(hz: float, ratio: float) -> None:
    """Shafts of the presets: the rotor is a tenth, and rings with what moves a rigid handle."""
    settings = free_settings(1.0e-4)
    truth = Truth(shaft_hz=hz, shaft_damping=ratio, rotor_part=0.106, drive_cycle=2.5e-4)
    position, torque = play(settings, truth, Excitation(settings, 1.9))
    assert np.abs(np.diff(position)).max() / PERIOD < settings.limits.speed_rad_s
    fit = fit_servo(position, torque, PERIOD, 2.0 * math.pi / truth.counts)
    assert fit.inertia.value == pytest.approx(truth.inertia, rel=0.02)
    assert fit.total.value == pytest.approx(truth.total_delay + truth.lag / PERIOD, abs=0.02)
    assert fit.shaft is not None
    assert fit.shaft.hz.value == pytest.approx(hz, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [4, 24, 22])
def test_random_servo(seed: int) -> None:
    """Three of the thirty: a stiff shaft, an elastic one, and one whose rotor is braked."""
    truth, fit = identified(seed)
    for name, (estimate, true) in compared(truth, fit).items():
        assert error(name, estimate, true) <= AIMS[name], name
        assert estimate.contains(true), name
    assert (fit.shaft is not None) == (truth.shaft_hz > 0.0)
    found = SimpleNamespace(hand=None, servo=fit, measured=np.empty(0))
    mechanics = tomllib.loads(toml_fragment(cast(Identified, found)))["mechanics"]
    assert ("shaft_hz" in mechanics) == (truth.shaft_hz > 0.0)
    if truth.shaft_hz:
        assert mechanics["shaft_hz"] == pytest.approx(truth.shaft_hz, rel=0.05)
        rotor = truth.rotor_part * mechanics["inertia_kg_m2"]
        assert mechanics["rotor_inertia_kg_m2"] == pytest.approx(rotor, rel=0.1)
        assert mechanics["shaft_damping_ratio"] == pytest.approx(truth.shaft_damping, rel=0.1)


@pytest.mark.slow
def test_coarse_encoder_is_no_hand() -> None:
    """A tenth of the rated torque moves the handle by few counts."""
    settings, truth = free_settings(1.0e-4), Truth(counts=2048, coulomb=0.005)
    position, torque = play(settings, truth, Excitation(settings, 0.063))
    fit = fit_servo(position, torque, PERIOD, 2.0 * math.pi / truth.counts)
    assert fit.residuals.explained < 0.98
    assert fit.inertia.contains(truth.inertia)
    assert fit.inertia.value == pytest.approx(truth.inertia, rel=0.02)


@pytest.mark.slow
def test_hand_at_the_handle_is_refused() -> None:
    """A hand that holds on, and wanders."""
    settings = free_settings(1.0e-4)
    wander = np.convolve(np.random.default_rng(3).normal(size=60_000), np.hanning(300), "same")
    wander *= 0.3 / wander.std()

    def hand(k: int, y: float, v: float) -> float:
        return 0.8 * (wander[k] - y) - 0.02 * v

    def identify() -> None:
        position, torque = play(settings, Truth(), Excitation(settings, 1.9), hand)
        fit_servo(position, torque, PERIOD, COUNT)

    with pytest.raises(UntellingDataError):
        identify()
