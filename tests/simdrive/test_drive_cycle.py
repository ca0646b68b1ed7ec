"""The drive's own control cycle: what it latches, and when a torque acts."""

import math
import random
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canwall.config import Hand, Simulation
from canwall.simdrive import ServoMotion

PERIOD = 1e-3
COUNTS_PER_REV = 2.0 * math.pi * 1e9
FREE = Hand(
    strikes=0, inertia_kg_m2=0.0, damping_nm_s_per_rad=0.0, stiffness_nm_per_rad=0.0, rest_rad=0.0
)


def servo(**changes: Any) -> ServoMotion:
    plain = {"viscous_nm_s_per_rad": 0.0, "coulomb_nm": 0.0, "inertia_kg_m2": 1e-4, "hand": FREE}
    simulation = Simulation(**plain).with_ideal_servo().model_copy(update=changes)
    return ServoMotion(simulation, PERIOD, COUNTS_PER_REV)


def counts_of(position: float) -> int:
    return math.floor(position * 1e9 + 0.5)


@pytest.mark.parametrize("ppm", [0.0, 50.0, -4000.0])
@pytest.mark.parametrize("cycle", [0.25e-3, 0.4e-3, 1e-3, 2.3e-3])
def test_a_free_mass_moves_as_the_ticks_have_it(cycle: float, ppm: float) -> None:
    """Position of a mass under torques that change at ticks, in closed form, seen at ticks."""
    tick = cycle / (1.0 + 1e-6 * ppm)
    motion = servo(drive_cycle_s=cycle, clock_ppm=ppm, clock_phase=0.3)
    torques = [0.05 * math.sin(1.7 * j) for j in range(60)]
    ticks = [(k + 0.3) * tick for k in range(int(60 * PERIOD / tick) + 2)]
    # In force between two ticks is what was demanded at the earlier one.
    in_force = [0.0, *(torques[min(int(t / PERIOD), 59)] for t in ticks)]

    def position(t: float) -> float:
        y = v = 0.0
        for start, end, torque in zip([0.0, *ticks], ticks, in_force, strict=False):
            dt = min(end, t) - start
            if dt <= 0.0:
                break
            y, v = y + v * dt + 0.5 * torque / 1e-4 * dt**2, v + torque / 1e-4 * dt
        return y

    for j, torque in enumerate(torques):
        motion.advance(torque, PERIOD)
        now = (j + 1) * PERIOD
        assert motion.position_rad == pytest.approx(position(now), rel=1e-9, abs=1e-15)
        past = [k for k, t in enumerate(ticks) if t <= now]
        seen = position(ticks[past[-1]]) if past else 0.0
        assert abs(motion.counts() - counts_of(seen)) <= 1
        assert motion.torque_nm() == (in_force[past[-1] + 1] if past else 0.0)


@settings(derandomize=True, deadline=None, max_examples=40)
@given(
    st.floats(0.05e-3, 3e-3),
    st.floats(0.0, 1.0),
    st.sampled_from([0.0, 1600.0]),
    st.integers(0, 1000),
)
def test_dividing_a_period_changes_nothing(
    cycle: float, phase: float, bandwidth: float, seed: int
) -> None:
    changes: dict[str, Any] = {
        "drive_cycle_s": cycle,
        "clock_ppm": 200.0,
        "clock_phase": phase,
        "current_bandwidth_hz": bandwidth,
        "coulomb_nm": 0.01,
    }
    whole, parts = servo(**changes), servo(**changes)
    draw = random.Random(seed)
    for _ in range(20):
        torque = draw.uniform(-0.1, 0.1)
        whole.advance(torque, PERIOD)
        cuts = sorted([0.0, 1.0, *(draw.random() for _ in range(3))])
        for low, high in pairwise(cuts):
            parts.advance(torque, (high - low) * PERIOD)
        assert parts.position_rad == pytest.approx(whole.position_rad, rel=0.0, abs=1e-13)
        assert parts.speed_rad_s == pytest.approx(whole.speed_rad_s, rel=0.0, abs=1e-10)


@pytest.mark.parametrize("phase", [0.0, 1.0])
@pytest.mark.parametrize("cycle", [0.125e-3, 0.2e-3, 0.1e-3, 0.05e-3])
def test_a_cycle_that_divides_the_period_ticks_with_the_sync(cycle: float, phase: float) -> None:
    """A demand acts one cycle after the SYNC, and the position is that of the SYNC, each period."""
    motion = servo(drive_cycle_s=cycle, clock_ppm=0.0, clock_phase=phase)
    motion.advance(0.0, PERIOD)
    for j in range(1, 400):
        torque = 0.1 * (-1) ** j
        before = motion.speed_rad_s
        motion.advance(torque, PERIOD)
        gained = (torque * (PERIOD - cycle) - (torque if j > 1 else 0.0) * cycle) / 1e-4
        assert motion.speed_rad_s - before == pytest.approx(gained, rel=1e-6)
        assert motion.counts() == counts_of(motion.position_rad)


def test_latch_before_and_apply_after_make_one_drive_cycle_at_any_phase() -> None:
    """The delay from position to torque, found from the motion alone."""
    cycle = 0.25e-3
    for phase in np.linspace(0.05, 1.0, 8):
        motion = servo(drive_cycle_s=cycle, clock_ppm=0.0, clock_phase=float(phase))
        motion.advance(0.1, PERIOD)  # acts from phase·cycle on
        acts = motion.speed_rad_s * 1e-4 / 0.1
        latched = math.sqrt(2.0 * motion.counts() * 1e-9 * 1e-4 / 0.1)
        assert PERIOD - acts == pytest.approx(phase * cycle, rel=1e-9)
        age = acts - latched
        assert age + phase * cycle == pytest.approx(cycle, rel=1e-4)


def test_the_motor_delivers_more_than_the_drive_believes() -> None:
    plain, strong = servo(), servo(torque_constant_error=0.2)
    lagging = servo(torque_constant_error=0.2, current_bandwidth_hz=1600.0)
    for _ in range(50):
        plain.advance(0.12, PERIOD)
        strong.advance(0.1, PERIOD)
        lagging.advance(0.1, PERIOD)
    assert strong.position_rad == pytest.approx(plain.position_rad, rel=1e-12)
    assert strong.torque_nm() is None
    assert lagging.torque_nm() == pytest.approx(0.1, rel=1e-12)
    # A lag costs the speed of its time constant.
    late = 1.2e-1 / 1e-4 / (2.0 * math.pi * 1600.0)
    assert lagging.speed_rad_s == pytest.approx(plain.speed_rad_s - late, rel=1e-9)
