"""Effective impedance of known systems, against their transfer functions."""

import numpy as np
import pytest
from scipy.signal import StateSpace, dlsim, lsim

from canwall.analysis.impedance import effective_impedance, impedance_at_lines, multisine

K, B, M, PERIOD = 120.0, 0.15, 3.3e-4, 1e-3
WALL = StateSpace([[0.0, 1.0], [-K / M, -B / M]], [[0.0], [1.0 / M]], [[1.0, 0.0]], [[0.0]])


def expected(frequency: np.ndarray) -> np.ndarray:
    omega = 2.0 * np.pi * frequency
    return K - M * omega**2 + 1j * omega * B


def test_multisine_has_its_lines_alone_and_low_peaks() -> None:
    lines = np.arange(3, 200, 4)
    push = multisine(lines, 1000, 2)
    spectrum = np.abs(np.fft.rfft(push[1000:]))
    others = np.setdiff1d(np.arange(len(spectrum)), lines)
    assert spectrum[others].max() < 1e-9 * spectrum[lines].max()
    assert np.ptp(spectrum[lines]) < 1e-9 * spectrum[lines].max()
    # A crest factor near that of a sine, √2; with equal phases it would be 9.9.
    assert np.abs(push).max() / push.std() < 1.9


def test_mass_spring_and_damper_of_a_wall_at_the_lines_of_a_multisine() -> None:
    lines = np.array([2, 5, 11, 23, 47, 95, 150])
    # Held over 1/16 of the SYNC's period, so that the hold's own lag is small.
    push = multisine(lines, 16_000, 4)
    t = np.arange(len(push)) * PERIOD / 16.0
    y = lsim(WALL, push, t)[1]
    found = impedance_at_lines(push.reshape(4, -1)[2:], y.reshape(4, -1)[2:], PERIOD / 16.0, lines)
    np.testing.assert_allclose(found.impedance, expected(found.frequency), rtol=2e-3)
    assert found.coherence.min() > 1.0 - 1e-9
    low, high = found.frequency < 90.0, found.frequency > 100.0
    np.testing.assert_allclose(
        found.stiffness[low], K - M * (2.0 * np.pi * found.frequency[low]) ** 2, rtol=5e-3
    )
    assert not found.stiffness[high].any()
    assert not found.mass[low].any()
    np.testing.assert_allclose(found.damping, B, rtol=0.02)
    np.testing.assert_allclose(
        found.mass[high], M - K / (2.0 * np.pi * found.frequency[high]) ** 2, rtol=5e-3
    )


def test_noise_and_quantisation_average_out_over_segments() -> None:
    random = np.random.default_rng(1)
    push = random.normal(size=200_000)
    y = lsim(WALL, push, np.arange(len(push)) * PERIOD, interp=False)[1]
    count = np.ptp(y) / 50.0
    found = effective_impedance(push, np.round(y / count) * count, PERIOD, 1000)
    band = (found.frequency > 5.0) & (found.frequency < 80.0)
    # The held force lags by half a period, and so does G.
    lag = np.exp(-1j * np.pi * found.frequency * PERIOD)
    error = found.impedance * lag / expected(found.frequency) - 1.0
    assert np.abs(error[band]).max() < 0.05
    assert found.coherence[band].min() > 0.9


def test_active_wall_has_negative_damping() -> None:
    lines = np.array([4, 8, 16])
    push = multisine(lines, 1000, 3)
    active = StateSpace([[0.0, 1.0], [-K / M, -B / M]], [[0.0], [1.0 / M]], [[1.0, 0.0]], [[0.0]])
    discrete = active.to_discrete(PERIOD)
    y = dlsim(discrete, push)[1][:, 0]
    found = impedance_at_lines(push.reshape(3, -1)[1:], y.reshape(3, -1)[1:], PERIOD, lines)
    late = impedance_at_lines(
        push.reshape(3, -1)[1:], np.roll(y, -3).reshape(3, -1)[1:], PERIOD, lines
    )
    assert (found.damping > 0.0).all()
    assert (late.damping < 0.0).all()


def test_too_short_signals_are_refused() -> None:
    with pytest.raises(ValueError, match="150 cycles are less than two segments of 100"):
        effective_impedance(np.ones(150), np.ones(150), PERIOD, 100)
