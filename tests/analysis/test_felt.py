"""Felt ripple against SciPy's filters, spectra and integrals, and against Newton's other body."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import integrate, signal

from canwall.analysis.felt import band_rms, felt_band, felt_body, mean_hand_force
from canwall.physics import HandBody, advance, make_plant

Array = NDArray[np.float64]


def times(rate: float, seconds: float = 2.0) -> Array:
    return np.arange(0.0, seconds, 1.0 / rate)


@pytest.mark.parametrize("rate", [200.0, 1000.0, 2000.0, 8000.0])
def test_it_is_what_scipy_filters(rate: float) -> None:
    force = np.random.default_rng(1).standard_normal(400).cumsum() + 30.0
    sections = signal.butter(2, 20.0, "highpass", fs=rate, output="sos")
    if rate > 1000.0:
        upper = signal.butter(2, 500.0, "lowpass", fs=rate, output="sos")
        sections = np.concatenate([sections, upper])
    state = signal.sosfilt_zi(sections) * force[0]
    filtered, _ = signal.sosfilt(sections, force, zi=state)
    expected = math.sqrt(np.mean(filtered[200:350] ** 2))
    assert band_rms(felt_band(1.0 / rate), force, 200, 350) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("rate", [1000.0, 2000.0])
def test_noise_has_the_power_of_its_spectrum_in_the_band(rate: float) -> None:
    force = np.random.default_rng(2).standard_normal(200_000)
    frequency, density = signal.welch(force, rate, nperseg=8192)
    inside = (frequency >= 20.0) & (frequency <= 500.0)
    expected = math.sqrt(integrate.trapezoid(density[inside], frequency[inside]))
    found = band_rms(felt_band(1.0 / rate), force, 1000, len(force))
    # The edges of the band are those of a second-order filter.
    assert found == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("frequency", [60.0, 150.0, 262.0, 400.0])
@pytest.mark.parametrize("rate", [1000.0, 2000.0])
def test_a_ripple_on_a_press_is_its_amplitude_over_the_root_of_two(
    frequency: float, rate: float
) -> None:
    t = times(rate)
    force = -1.9 + 0.3 * np.sin(2.0 * math.pi * 1.0 * t) + 0.2 * np.sin(2 * math.pi * frequency * t)
    expected = 0.2 / math.sqrt(2.0)
    band = felt_band(1.0 / rate)
    gain = 1.0 if rate == 1000.0 else 1.0 / math.sqrt(1.0 + (frequency / 500.0) ** 4)
    found = band_rms(band, force, len(t) // 2, len(t))
    assert found == pytest.approx(expected * gain, rel=0.06)


def test_what_a_hand_does_slowly_is_no_ripple() -> None:
    t = times(1000.0)
    tremor = 0.5 * np.sin(2.0 * math.pi * 3.0 * t)
    assert band_rms(felt_band(1e-3), tremor, 1000, 2000) < 0.03 * 0.5
    assert band_rms(felt_band(1e-3), np.full(2000, -3.0), 1000, 2000) < 1e-12
    assert math.isnan(band_rms(felt_band(1e-3), tremor, 7, 7))


def test_below_40_hz_there_is_no_band() -> None:
    force = np.random.default_rng(3).standard_normal(100)
    assert band_rms(felt_band(1.0 / 40.0), force, 10, 100) == 0.0


def test_the_mean_force_is_the_integral() -> None:
    body, period, start = HandBody(3.2e-4, 0.05, 7.7, -1.0), 1e-3, 0.3
    w = 2.0 * math.pi * 262.0

    def y(t: float) -> float:
        return -0.01 + 2e-4 * math.sin(w * t)

    def v(t: float) -> float:
        return 2e-4 * w * math.cos(w * t)

    def force(t: float) -> float:
        a = -2e-4 * w * w * math.sin(w * t)
        return body.mass * a + body.viscous * v(t) + body.spring * y(t) - 0.15

    integral, _ = integrate.quad(force, start, start + period, epsabs=1e-13)
    ends = (y(start), v(start), y(start + period), v(start + period))
    found = mean_hand_force(body, *ends, 0.15, period)
    # The rule for the mean of y is of fourth order; 2e-5 N·m is 0.0002 N at the handle.
    assert found == pytest.approx(integral / period, abs=2e-5)


def test_what_the_hand_feels_is_what_the_handle_gives() -> None:
    """The same force by Newton for the handle: what of the motor's torque does not move it."""
    mass, viscous, torque, push, period = 1e-4, 5e-4, 0.4, -0.15, 1e-3
    hand = HandBody(3.2e-4, 0.0512, 7.68, -1.0)
    joined = make_plant(mass + hand.mass, viscous + hand.viscous, hand.spring)
    y, v = -0.003, -0.2
    y_next, v_next, _ = advance(joined[0], y, v, torque + push, 0.0, period)
    felt = mean_hand_force(hand, y, v, y_next, v_next, push, period)
    given = torque - (viscous * (y_next - y) + mass * (v_next - v)) / period
    assert felt == pytest.approx(given, rel=1e-6)
    assert abs(felt) > 0.1


def test_without_an_operator_the_handle_is_felt() -> None:
    nobody = HandBody(0.0, 0.0, 0.0, -1.0)
    assert felt_body(nobody, 1e-4) == HandBody(1e-4, 0.0, 0.0, -1.0)
    finger = HandBody(0.0, 0.0, 3.2, -1.0)
    assert felt_body(finger, 1e-4) == finger
