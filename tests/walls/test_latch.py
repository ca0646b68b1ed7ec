"""The position at the SYNC, of drives that latch it at ticks of their own."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from canwall.walls import ESTIMATOR, LATCH, at_sync, reset_latch, set_latch

PERIOD, COUNT, FREE = 1e-3, 4.8e-5, 0.01
Array = NDArray[np.float64]


def moved(t: Array) -> Array:
    """Approach a wall, and swing."""
    return np.asarray(0.2 - 0.8 * t + 0.03 * np.sin(2.0 * math.pi * 3.0 * t))


def errors(
    drive_cycle: float,
    phase: float = 0.3,
    ppm: float = 50.0,
    torque: float = 0.0,
    lost: tuple[int, ...] = (),
    known: float | None = None,
) -> tuple[Array, Array]:
    """Return errors of the samples and of what is made of them, less their means [counts]."""
    latch, estimator = np.zeros(1, LATCH), np.zeros(1, ESTIMATOR)
    set_latch(latch[0], PERIOD, drive_cycle if known is None else known, COUNT, FREE)
    reset_latch(latch[0])
    estimator["in_flight"] = torque
    syncs = PERIOD * np.arange(400)
    ticks = drive_cycle / (1.0 + 1e-6 * ppm)
    latched = (np.floor(syncs / ticks + phase) - phase) * ticks
    samples = COUNT * np.rint(moved(latched) / COUNT)
    found = samples.copy()
    for j in range(len(syncs)):
        if j not in lost:
            estimator["v"] = (moved(syncs[j]) - moved(syncs[j] - 1e-5)) / 1e-5
            found[j] = at_sync(latch[0], estimator[0], j, samples[j])
    kept = [j for j in range(60, len(syncs)) if j not in lost]
    # At a constant age there would be none but that of the encoder.
    late = moved(syncs - np.mean(syncs - latched))
    return (samples - late)[kept] / COUNT, (found - late)[kept] / COUNT


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize("phase", [0.0, 0.2, 0.55, 0.9])
def test_age_that_alternates_is_found(phase: float) -> None:
    """At 2.5 ticks a period; what is left is the encoder's step."""
    raw, found = errors(0.0004, phase)
    assert rms(raw) > 1.3
    assert rms(found) < 0.4


@pytest.mark.parametrize("drive_cycle", [0.0003, 0.0006, 0.0007])
def test_first_harmonic_of_any_age_is_found(drive_cycle: float) -> None:
    raw, found = errors(drive_cycle)
    assert rms(found) < 0.75 * rms(raw)


def test_lost_samples_do_not_turn_the_ticks() -> None:
    raw, found = errors(0.0004, lost=(100, 101, 102, 200, 301))
    assert rms(found) < 0.3 * rms(raw)


@pytest.mark.parametrize("drive_cycle", [0.00025, 0.001])
def test_ticks_that_go_with_the_sync_leave_samples_alone(drive_cycle: float) -> None:
    raw, found = errors(drive_cycle)
    np.testing.assert_array_equal(raw, found)


def test_drive_without_a_known_cycle_leaves_samples_alone() -> None:
    raw, found = errors(0.0004, known=0.0)
    np.testing.assert_array_equal(raw, found)


def test_nothing_is_learned_under_a_torque() -> None:
    raw, found = errors(0.0004, torque=2.0 * FREE)
    np.testing.assert_array_equal(raw, found)


def test_samples_at_rest_are_left_alone() -> None:
    latch, estimator = np.zeros(1, LATCH), np.zeros(1, ESTIMATOR)
    set_latch(latch[0], PERIOD, 0.0004, COUNT, FREE)
    reset_latch(latch[0])
    latch["age"] = 0.1
    estimator["v"] = 1.9 * COUNT / PERIOD
    assert at_sync(latch[0], estimator[0], 1, 0.123) == 0.123
