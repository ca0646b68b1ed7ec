"""Counts, per mille and what the bus makes of a torque."""

import math
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canwall.units import MAX_PER_MILLE, DriveUnits, to_per_mille

BOUNDED = settings(derandomize=True, deadline=None, max_examples=300)

RATED_NM = 1.27
STEP_NM = RATED_NM / 1000.0


def test_scales_of_a_drive() -> None:
    units = DriveUnits(counts_per_rev=131072.0, rated_torque_nm=1.27)
    assert units.rad_per_count == pytest.approx(2.0 * math.pi / 2**17, rel=1e-15)
    assert units.nm_per_mille == pytest.approx(1.27e-3, rel=1e-15)


def test_behind_a_gear_the_shaft_turns_slower_and_stronger() -> None:
    units = DriveUnits.behind_gear(
        counts_per_motor_rev=4096.0, motor_rated_torque_nm=0.5, gear_ratio=12.5
    )
    assert units == DriveUnits(counts_per_rev=51200.0, rated_torque_nm=6.25)
    # One turn of the motor is 1/12.5 of a turn of the shaft.
    assert 4096 * units.rad_per_count == pytest.approx(2.0 * math.pi / 12.5)


def test_a_gear_of_one_changes_nothing() -> None:
    assert DriveUnits.behind_gear(4096.0, 0.5, 1.0) == DriveUnits(4096.0, 0.5)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_impossible_scales_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="counts_per_rev has to be positive"):
        DriveUnits(bad, 1.0)
    with pytest.raises(ValueError, match="rated_torque_nm has to be positive"):
        DriveUnits(1.0, bad)
    with pytest.raises(ValueError, match="has to be positive"):
        DriveUnits.behind_gear(4096.0, 0.5, bad)


@pytest.mark.parametrize(
    ("torque", "per_mille"),
    [
        (0.0, 0),
        (0.49 * STEP_NM, 0),
        (0.51 * STEP_NM, 1),
        (-0.49 * STEP_NM, 0),
        (-0.51 * STEP_NM, -1),
        (0.5, 394),
        (-0.5, -394),
        (RATED_NM, 1000),
        (-RATED_NM, -1000),
    ],
)
def test_nearest_step(torque: float, per_mille: int) -> None:
    assert to_per_mille(torque, STEP_NM, 3.8) == per_mille


@BOUNDED
@given(st.floats(-40.0, 40.0), st.floats(1e-4, 1e-2))
def test_rounding_is_off_by_half_a_step_at_the_most(torque: float, step: float) -> None:
    per_mille = to_per_mille(torque, step, 1e6)
    if abs(torque / step) < MAX_PER_MILLE:
        error = abs(Fraction(per_mille) * Fraction(step) - Fraction(torque))
        assert error <= Fraction(step) * Fraction(0.5 + 1e-9)
    else:
        assert per_mille == math.copysign(MAX_PER_MILLE, torque)


@BOUNDED
@given(st.floats(), st.floats(1e-6, 1.0), st.floats(0.0, 100.0))
def test_never_beyond_the_limit_nor_an_integer16(torque: float, step: float, limit: float) -> None:
    per_mille = to_per_mille(torque, step, limit)
    assert abs(per_mille) <= MAX_PER_MILLE
    assert abs(per_mille) * step <= limit + 1e-8 * step
    if math.isfinite(torque):
        assert per_mille * torque >= 0.0
        nearest = abs(torque) / step - 0.5
        assert abs(per_mille) >= min(nearest, limit / step - 1.0, MAX_PER_MILLE) - 1e-6
    else:
        assert per_mille == 0


@pytest.mark.parametrize("sense", [-1, 1])
def test_a_limit_between_two_steps_is_kept(sense: int) -> None:
    assert to_per_mille(sense * 5.0, STEP_NM, 10.9 * STEP_NM) == sense * 10
    assert to_per_mille(sense * 10.8 * STEP_NM, STEP_NM, 10.9 * STEP_NM) == sense * 10
    # A limit written as a multiple of the step is not lost to the last bit of a division.
    for steps in range(1, 2000):
        assert to_per_mille(sense * 5.0, STEP_NM, steps * STEP_NM) == sense * steps


@pytest.mark.parametrize("sense", [-1.0, 1.0])
def test_a_torque_beyond_every_integer_keeps_its_sign(sense: float) -> None:
    for torque in (1e5, 1e17, 1e300):
        assert to_per_mille(sense * torque, STEP_NM, 1.27) == sense * 1000
        assert to_per_mille(sense * torque, STEP_NM, 1e300) == sense * MAX_PER_MILLE


@pytest.mark.parametrize("torque", [math.nan, math.inf, -math.inf])
def test_what_is_no_torque_is_none(torque: float) -> None:
    assert to_per_mille(torque, STEP_NM, 1.9) == 0


def test_a_limit_below_one_step_allows_nothing() -> None:
    assert to_per_mille(1.0, STEP_NM, 0.9 * STEP_NM) == 0
    assert to_per_mille(-1.0, STEP_NM, 0.0) == 0
