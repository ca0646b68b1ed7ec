"""A handle driven for a million periods: what goes in, what is there, and what friction takes."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from two_bodies import Handle

from canwall.compiled import Record, compiled
from canwall.physics import advance, make_plant

Array = NDArray[np.float64]

PERIODS = 1_000_000
PERIOD = 1e-3


@compiled
def cog_energy(plant: Record, y: float) -> float:
    half = 0.5 * plant.cog_pitch
    index = math.floor(y / half + 0.5)
    off = y - index * half
    stiffness = 2.0 * plant.cogging / half
    if index % 2 != 0:
        return stiffness * (0.25 * half * half - 0.5 * off * off)
    return 0.5 * stiffness * off * off


@compiled
def balance(plant: Record, path: Array, motor: Array, books: Array) -> None:
    """books: work, energy now, friction's least share (coulomb × way), worst gain, sticks, slips.

    The hand's spring is moved in steps: its end is where `path` says during each period, so every
    work is a force times a way, exactly.
    """
    y = v = 0.0
    for j in range(len(path)):
        force = plant.spring * path[j] + motor[j]
        before = 0.5 * plant.mass * v * v + 0.5 * plant.spring * y * y + cog_energy(plant, y)
        y_before = y
        y, v, _ = advance(plant, y, v, force, 0.0, 1e-3)
        after = 0.5 * plant.mass * v * v + 0.5 * plant.spring * y * y + cog_energy(plant, y)
        work = force * (y - y_before)
        way = plant.coulomb * abs(y - y_before)
        books[0] += work
        books[1] = after
        books[2] += way
        # What friction has taken is at least its force over the way between the two ends.
        books[3] = max(books[3], (after - before - work + way) / (before + after + abs(work)))
        books[4 if y == y_before and v == 0.0 else 5] += 1.0


def balanced(cogging: float, amplitude: float) -> Array:
    handle = Handle(1.64e-4, coulomb=0.01, cogging=cogging, cog_pitch=2.0 * math.pi / 24.0)
    plant = make_plant(
        handle.mass,
        spring=3.2,
        coulomb=handle.coulomb,
        cogging=cogging,
        cog_pitch=handle.cog_pitch,
    )
    t = np.arange(PERIODS) * PERIOD
    path = amplitude * np.sin(2.0 * math.pi * 0.3 * t) * np.sin(2.0 * math.pi * 0.0117 * t)
    motor = np.random.default_rng(5).normal(0.0, 0.004, PERIODS)
    books = np.zeros(6)
    balance(plant[0], path, motor, books)
    for y in (0.0, 0.11, -0.07, 0.3):  # the two ways of writing the energy down agree
        assert cog_energy(plant[0], y) == pytest.approx(handle.cog_energy(y), rel=1e-12)
    return books


@pytest.mark.parametrize("cogging", [0.0, 0.003])
def test_stick_and_slip_without_gain_of_energy(cogging: float) -> None:
    work, energy, least_lost, worst, sticks, slips = balanced(cogging, 0.05)
    assert sticks > 100_000
    assert slips > 100_000
    assert worst < 1e-11
    lost = work - energy
    # Most periods go one way only, where friction takes exactly its force times the way.
    assert least_lost <= lost * (1.0 + 1e-9)
    assert lost == pytest.approx(least_lost, rel=0.05)
    assert lost > 0.1


@compiled
def quadrature(
    plant: Record, demands: Array, rate: float, pieces: int, weights: Array, nodes: Array
) -> tuple[float, float, float]:
    """Work of a motor with a lag (Gauss-Legendre), energy now, coulomb × way."""
    y = v = torque = work = way = 0.0
    step = 1e-3 / pieces
    for j in range(len(demands)):
        for _ in range(pieces):
            excess = torque - demands[j]
            for i in range(len(nodes)):
                t = nodes[i] * step
                _, speed, _ = advance(plant, y, v, torque, 0.0, t, excess, rate)
                work += weights[i] * step * speed * (torque - excess * (1.0 - math.exp(-rate * t)))
            y_before = y
            y, v, _ = advance(plant, y, v, torque, 0.0, step, excess, rate)
            way += plant.coulomb * abs(y - y_before)
            torque -= excess * (1.0 - math.exp(-rate * step))
    energy = 0.5 * plant.mass * v * v + 0.5 * plant.spring * y * y + cog_energy(plant, y)
    return work, energy, way


@pytest.mark.slow
def test_a_motor_with_a_lag_pays_for_all_that_friction_takes() -> None:
    plant = make_plant(
        1.64e-4, spring=3.2, coulomb=0.01, cogging=0.003, cog_pitch=2.0 * math.pi / 24.0
    )
    demands = np.random.default_rng(6).normal(0.0, 0.1, 5_000)
    nodes, weights = np.polynomial.legendre.leggauss(4)
    rate = 2.0 * math.pi * 1600.0
    work, energy, way = quadrature(plant[0], demands, rate, 16, 0.5 * weights, 0.5 * (nodes + 1.0))
    assert work - energy == pytest.approx(way, rel=1e-4)
