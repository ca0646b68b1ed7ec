"""The position at the SYNC, of drives that latch it at ticks of their own."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from canwall.walls import ESTIMATOR, LATCH, age_at, at_sync, expect_torques, reset_latch, set_latch

PERIOD, COUNT, MASS = 1e-3, 4.8e-5, 1e-4
Array = NDArray[np.float64]


def moved(t: Array) -> Array:
    """Approach a wall, and swing."""
    return np.asarray(0.2 - 0.8 * t + 0.03 * np.sin(2.0 * math.pi * 3.0 * t))


def made(drive_cycle: float) -> tuple[NDArray[np.void], NDArray[np.void]]:
    latch, estimator = np.zeros(1, LATCH), np.zeros(1, ESTIMATOR)
    set_latch(latch[0], PERIOD, drive_cycle, COUNT)
    reset_latch(latch[0])
    estimator["mass"] = MASS
    return latch, estimator


def errors(
    drive_cycle: float,
    phase: float = 0.3,
    ppm: float = 50.0,
    lost: tuple[int, ...] = (),
    known: float | None = None,
) -> tuple[Array, Array]:
    """Return errors of the samples and of what is made of them, less their means [counts]."""
    latch, estimator = made(drive_cycle if known is None else known)
    syncs = PERIOD * np.arange(400)
    ticks = drive_cycle / (1.0 + 1e-6 * ppm)
    latched = (np.floor(syncs / ticks + phase) - phase) * ticks
    samples = COUNT * np.rint(moved(latched) / COUNT)
    found = samples.copy()
    for j in range(len(syncs)):
        if j not in lost:
            estimator["v"] = (moved(syncs[j]) - moved(syncs[j] - 1e-5)) / 1e-5
            found[j] = at_sync(latch[0], estimator[0], 0.0, j, samples[j])
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


class Handle:
    """A mass behind a drive that latches and actuates at ticks of its own, integrated exactly."""

    def __init__(self, drive_cycle: float, phase: float, v: float) -> None:
        self.cycle, self.phase = drive_cycle, phase
        self.y, self.v, self.force = 0.0, v, 0.0
        self.latched = 0.0
        self.tick = 0

    def until(self, sync: float, demand: float) -> float:
        """Go on to a SYNC, with the torque in force from the one before; return what it latches."""
        while True:
            at = (self.tick + self.phase) * self.cycle
            if at > sync:
                return self.latched
            a = self.force / MASS
            self.y += self.cycle * self.v + 0.5 * self.cycle**2 * a
            self.v += self.cycle * a
            self.latched, self.force, self.tick = self.y, demand, self.tick + 1


def ages(drive_cycle: float, phase: float, n: int) -> Array:
    """Return the ages of samples beyond their mean [periods]."""
    syncs = np.arange(n)
    ticks = drive_cycle / PERIOD
    old = syncs - (np.floor(syncs / ticks - phase) + phase) * ticks
    return np.asarray(old - old[1:].mean())


@pytest.mark.parametrize("phase", [0.1, 0.6])
def test_age_is_found_under_torques(phase: float) -> None:
    """They move the handle, and each acts as much earlier as the position was old."""
    latch, estimator = made(0.0004)
    handle = Handle(0.0004, phase, 1.0)
    true = ages(0.0004, phase, 60)
    torques = 0.15 * np.sign(np.sin(1.2 * np.arange(60)))
    sent = [0.0, 0.0]
    for j, torque in enumerate(torques.tolist()):
        position = handle.until(j * PERIOD, sent[-2])
        estimator["v"] = handle.v
        at_sync(latch[0], estimator[0], 0.05, j, COUNT * round(position / COUNT))
        if j > 30:
            assert age_at(latch[0], j) == pytest.approx(true[j], abs=0.005), j
        expect_torques(latch[0], estimator[0], 1.4, j, torque)
        estimator["in_flight"][0] = np.roll(estimator["in_flight"][0], 1)
        estimator["in_flight"][0, 0] = torque
        sent.append(torque)
    assert np.abs(true[1:]).min() > 0.09


def test_torque_that_answers_the_encoder_looks_like_no_age() -> None:
    """A stiff wall on which a handle rests between two counts."""
    latch, estimator = made(0.0004)
    rng = np.random.default_rng(1)
    samples = COUNT * rng.integers(0, 2, 2000)
    for j, sample in enumerate(samples.tolist()):
        at_sync(latch[0], estimator[0], 0.05, j, sample)
        assert age_at(latch[0], j) == 0.0
        torque = -MASS / PERIOD**2 * sample
        expect_torques(latch[0], estimator[0], 1.4, j, torque)
        estimator["in_flight"][0] = np.roll(estimator["in_flight"][0], 1)
        estimator["in_flight"][0, 0] = torque


def test_samples_at_rest_are_left_alone() -> None:
    latch, estimator = made(0.0004)
    latch["age"] = 0.1
    estimator["v"] = 1.9 * COUNT / PERIOD
    assert at_sync(latch[0], estimator[0], 0.0, 1, 0.123) == 0.123
