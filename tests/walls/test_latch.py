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


def send(
    latch: NDArray[np.void], estimator: NDArray[np.void], drive_cycle: float, torque: float
) -> None:
    """Put a torque in flight, at the end of a cycle."""
    expect_torques(latch[0], estimator[0], 1.0 + drive_cycle / PERIOD, torque)
    estimator["in_flight"][0] = np.roll(estimator["in_flight"][0], 1)
    estimator["in_flight"][0, 0] = torque


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize("phase", [0.0, 0.2, 0.55, 0.9])
def test_age_that_alternates_is_found(phase: float) -> None:
    """At 2.5 ticks a period; what is left is the encoder's step."""
    raw, found = errors(0.0004, phase)
    assert rms(raw) > 1.3
    assert rms(found) < 0.4


@pytest.mark.parametrize("phase", [0.05, 0.3, 0.62])
@pytest.mark.parametrize("drive_cycle", [0.0003, 0.00045, 0.0006, 0.0007, 0.0013])
def test_any_age_is_found(drive_cycle: float, phase: float) -> None:
    """Of a tick next to a SYNC it is open on which side it was."""
    raw, found = errors(drive_cycle, phase)
    assert np.median(np.abs(found)) < 0.8
    assert rms(found) < 0.6 * rms(raw)


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


@pytest.mark.parametrize("drive_cycle", [0.0004, 0.00045, 0.0007])
@pytest.mark.parametrize("phase", [0.1, 0.6])
def test_age_is_found_under_torques(drive_cycle: float, phase: float) -> None:
    """They move the handle, and each acts as much earlier as the position was old.

    A later SYNC would make all of them as much older, and be seen in none.
    """
    latch, estimator = made(drive_cycle)
    handle = Handle(drive_cycle, phase, 1.0)
    true, found = ages(drive_cycle, phase, 60), np.zeros(60)
    torques = 0.15 * np.sign(np.sin(1.2 * np.arange(60)))
    sent = [0.0, 0.0]
    for j, torque in enumerate(torques.tolist()):
        position = handle.until(j * PERIOD, sent[-2])
        estimator["v"] = handle.v
        at_sync(latch[0], estimator[0], 0.05, j, COUNT * round(position / COUNT))
        found[j] = age_at(latch[0], j)
        send(latch, estimator, drive_cycle, torque)
        sent.append(torque)
    missed = (found - true)[31:]
    assert np.abs(missed - missed.mean()).max() < 0.025
    assert np.ptp(true[1:]) > 0.19


def test_torque_that_answers_the_encoder_looks_like_no_age() -> None:
    """A stiff wall on which a handle rests between two counts."""
    latch, estimator = made(0.0004)
    rng = np.random.default_rng(1)
    samples = COUNT * rng.integers(0, 2, 2000)
    for j, sample in enumerate(samples.tolist()):
        at_sync(latch[0], estimator[0], 0.05, j, sample)
        assert abs(age_at(latch[0], j)) < 1e-12
        torque = -MASS / PERIOD**2 * sample
        send(latch, estimator, 0.0004, torque)


def test_samples_at_rest_are_left_alone() -> None:
    latch, estimator = made(0.0004)
    latch["weight"] = 0.0
    latch["weight"][0, 3] = 1.0
    estimator["v"] = 1.9 * COUNT / PERIOD
    assert age_at(latch[0], 1) != 0.0
    assert at_sync(latch[0], estimator[0], 0.0, 1, 0.123) == 0.123


@pytest.mark.parametrize("phase", [0.1, 0.6, 0.8])
def test_push_that_the_model_does_not_know_looks_like_no_age(phase: float) -> None:
    """It bends the way of a light handle from rest by more than an age does."""
    drive_cycle, acceleration = 0.00045, 900.0
    latch, estimator = made(drive_cycle)
    true, found = ages(drive_cycle, phase, 10), np.zeros(10)
    for j in range(10):
        latched = j * PERIOD - true[j] * PERIOD
        estimator["v"] = acceleration * j * PERIOD
        sample = COUNT * round(0.5 * acceleration * latched**2 / COUNT)
        at_sync(latch[0], estimator[0], 0.0, j, sample)
        found[j] = age_at(latch[0], j)
        send(latch, estimator, drive_cycle, 0.0)
    assert np.abs((found - true)[4:]).mean() < 0.045
