"""The bank of filters that identifies the operator."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rig import settings_with
from scipy.linalg import expm, solve_discrete_are
from scipy.signal import cont2discrete

from canwall.config import ConfigError
from canwall.cycle.state import modelled_delay
from canwall.walls import (
    BANK,
    ESTIMATOR,
    MAX_DELAY,
    ElasticShaft,
    correct,
    correct_bank,
    doubt,
    end_lag,
    force_walk_of,
    hand_damping,
    may_lag,
    note_missing_sample,
    predict,
    predict_bank,
    reset_bank,
    reset_estimator,
    set_bank,
    set_estimator,
    set_model,
    set_pace,
    stand_still,
    start_lagging,
    stiffest_walls,
    take_over,
)
from canwall.walls.estimator import gain_with_trend, set_model_delay
from canwall.walls.regression import _torque_steps

PERIOD, COUNT, WALK, DELAY = 1e-3, 4.8e-5, 0.02, 1.35
MASSES = np.geomspace(1e-4, 4.5e-3, 16)
VISCOUS = 5e-4 + np.array([hand_damping(m - 1e-4, 0.04) for m in MASSES.tolist()])


def bank_at(y: float) -> tuple[NDArray[np.void], NDArray[np.void]]:
    bank, estimator = np.zeros(1, BANK), np.zeros(1, ESTIMATOR)
    set_bank(bank, MASSES, VISCOUS, 0.0, PERIOD, COUNT, WALK, DELAY)
    set_estimator(estimator, MASSES[0], VISCOUS[0], 0.0, 0.0, PERIOD, COUNT, WALK, DELAY)
    reset_estimator(estimator, y)
    reset_bank(bank, y)
    set_pace(bank[0], 1e9)
    return bank, estimator


def discrete(mass: float, viscous: float, duration: float) -> tuple[Any, Any]:
    a = np.array([[0.0, 1.0], [0.0, -viscous / mass]])
    b = np.array([[0.0], [1.0 / mass]])
    phi, gamma, *_ = cont2discrete((a, b, np.eye(2), np.zeros((2, 1))), duration)
    return phi, gamma[:, 0]


def play(
    bank: NDArray[np.void] | None,
    estimator: NDArray[np.void],
    mass: float,
    torques: NDArray[np.float64],
    lost: tuple[int, ...] = (),
    stuck: bool = False,
) -> NDArray[np.float64]:
    """Return the mass in force in each period of a handle of this mass under these torques."""
    viscous = 5e-4 + hand_damping(mass - 1e-4, 0.04)
    (phi1, gamma1), (phi2, gamma2) = (discrete(mass, viscous, s * PERIOD) for s in (0.35, 0.65))
    x = np.array([0.0, -0.5 if not stuck else 0.0])
    before = older = 0.0
    found = np.empty(len(torques))
    for j, torque in enumerate(torques.tolist()):
        sample = COUNT * np.rint(x[0] / COUNT)
        if j in lost:
            note_missing_sample(estimator[0])
        else:
            correct(estimator[0], sample)
            if bank is not None:
                correct_bank(bank[0], estimator[0], sample)
        found[j] = estimator["mass"][0]
        if bank is not None:
            predict_bank(bank[0], estimator[0], torque)
        predict(estimator[0], torque)
        # D = 1.35: the torque before the last one acts for 0.35 T, the last one for the rest.
        if not stuck:
            x = phi2 @ (phi1 @ x + gamma1 * older) + gamma2 * before
        older, before = before, torque
    return found


def pulses(size: float) -> NDArray[np.float64]:
    torques = np.zeros(120)
    torques[60:90] = size * np.repeat([1.0, -0.4, 0.7], 10)
    return torques


@pytest.mark.parametrize("age", [0.1, -0.2])
def test_torque_after_an_old_sample_acts_earlier(age: float) -> None:
    states = []
    for delay, beyond in ((DELAY, age), (DELAY - age, 0.0)):
        bank, estimator = bank_at(0.0)
        set_bank(bank, MASSES, VISCOUS, 0.0, PERIOD, COUNT, WALK, delay)
        reset_bank(bank, 0.0)
        set_pace(bank[0], 1e9)
        set_estimator(estimator, MASSES[0], VISCOUS[0], 0.0, 0.0, PERIOD, COUNT, WALK, delay)
        estimator["in_flight"][0, :3] = 0.3, -0.1, 0.2
        correct_bank(bank[0], estimator[0], 0.0)
        for j in range(3):
            predict_bank(bank[0], estimator[0], 0.1 * j, beyond)
        states.append(bank["state"][0])
    assert states[0][1, 0] != 0.0
    np.testing.assert_allclose(states[0], states[1], rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("mass", [1.3e-4, 4.2e-4, 1.4e-3, 3.6e-3])
def test_mass_is_found_within_samples_of_the_first_torque(mass: float) -> None:
    found = play(*bank_at(0.0), mass, pulses(max(0.4, 300.0 * mass)))
    # The lightest until a torque has acted, which takes two periods and a sample.
    np.testing.assert_allclose(found[:62], MASSES[0], rtol=1e-12)
    np.testing.assert_allclose(found[72:], mass, rtol=0.15)


@pytest.mark.parametrize("known", [False, True])
def test_mass_that_was_known_grows_slowly_in_doubt(known: bool) -> None:
    """A hand that withdraws within milliseconds looks heavy for as long."""
    bank, estimator = bank_at(0.0)
    play(bank, estimator, 2.5e-4, pulses(0.3))
    assert bank["known"][0]
    bank["known"] = known
    # It moves by up to 60 counts a sample: on a calm one, pulses to and fro would be a swing.
    bank["moved"] = 0
    before = bank["mass"][0]
    # It is forgotten, and the next torques move the handle as they would a tenfold mass.
    bank["regression"]["information"] = 0.0
    masses = play(bank, estimator, 2.5e-3, pulses(0.75))[59:]
    growth = np.diff(np.log([before, *masses]))
    assert (growth.max() <= 0.1001) == known
    assert masses[-1] == pytest.approx(2.5e-3, rel=0.2)


@pytest.mark.parametrize("known", [False, True])
def test_mass_in_doubt_does_not_grow_while_the_torque_falls(known: bool) -> None:
    """A wall that gives way to a hand that withdraws moves nothing: it looks heavy."""
    bank, estimator = bank_at(0.0)
    play(bank, estimator, 2.5e-4, pulses(0.3))
    bank["known"] = known
    bank["regression"]["information"] = 0.0
    torques = np.zeros(120)
    torques[60:90] = np.linspace(0.75, 0.0, 30)
    masses = play(bank, estimator, 2.5e-3, torques)
    # The observer has seen the first torque, a step, after 12 periods.
    assert np.any(np.diff(np.log(masses[72:90])) > 0.0) != known


def test_doubt_is_the_deviation_of_the_mass() -> None:
    bank, estimator = bank_at(0.0)
    assert doubt(bank[0]) == 1.0
    play(bank, estimator, 4.2e-4, pulses(0.3))
    assert doubt(bank[0]) == bank["spread"][0] < 0.2
    bank["spread"] = 3.0
    assert doubt(bank[0]) == 1.0
    # Of a mass that is held it stays, and one that is told has little.
    bank["holds"], bank["spread"] = True, 0.3
    assert doubt(bank[0]) == 0.3
    bank["count"] = 1
    assert doubt(bank[0]) == 0.01


@pytest.mark.parametrize("mass", [4.2e-4, 3.5e-3])
@pytest.mark.parametrize("excess", [-0.2, 0.0, 0.15])
def test_known_hand_keeps_its_mass_and_tells_the_delay(mass: float, excess: float) -> None:
    bank, estimator = np.zeros(1, BANK), np.zeros(1, ESTIMATOR)
    told = DELAY - excess
    set_bank(bank, np.array([mass]), np.array([0.04]), 0.0, PERIOD, COUNT, WALK, told)
    set_estimator(estimator, mass, 0.04, 0.0, 0.0, PERIOD, COUNT, WALK, told)
    reset_estimator(estimator, 0.0)
    reset_bank(bank, 0.0)
    set_pace(bank[0], 1e9)
    masses = play(bank, estimator, mass, np.tile(pulses(1000.0 * mass), 3))
    np.testing.assert_allclose(masses, mass, rtol=1e-12)
    found, spread = (bank["regression"][name][0, 0] for name in ("excess", "excess_spread"))
    assert spread < (0.2 if mass < 1e-3 else 0.03)
    assert found == pytest.approx(excess, abs=max(spread, 0.02))
    assert bank["delay_in_force"][0] == pytest.approx(told + found)


@pytest.mark.parametrize(("mass", "share"), [(1e-4, 0.0), (10**-3.5, 0.5), (1e-3, 1.0), (3e-3, 1)])
def test_delay_in_doubt_counts_for_a_heavy_hand_that_moves(mass: float, share: float) -> None:
    bank, _ = bank_at(0.0)
    bank["place"] = np.interp(np.log(mass), np.log(MASSES), np.arange(len(MASSES)))
    bank["spread"], bank["regression"]["excess_spread"] = 0.1, 0.2
    assert doubt(bank[0]) == 0.1
    bank["moved"] = bank["lively"] - 1
    assert doubt(bank[0]) == pytest.approx(0.1 + share * 0.2, abs=2e-3)
    # To the digit it is interpolated between two filters.
    counts = np.clip(np.log10(MASSES / MASSES[0]), 0.0, 1.0)
    counted = np.interp(bank["place"][0], np.arange(len(MASSES)), counts)
    assert doubt(bank[0]) == pytest.approx(0.1 + counted * 0.2)
    bank["spread"] = 0.9
    assert doubt(bank[0]) == pytest.approx(min(0.9 + counted * 0.2, 1.0))


def relative_bandwidths(
    i: int, period: float = PERIOD, count: float = COUNT, radius: float = 0.08
) -> tuple[float, float]:
    """Return those of filter i at its steadiest and at its quickest, over that of WALK.

    0.54/T where a count in a period takes 0.18 N, and with that force to the power of -0.52; but no
    quicker than that of WALK, and at rest than 0.75 of it and up to a quarter more, at b/m = 60/s.
    """
    lightest = (12.0 * WALK**2 / (MASSES[0] * count) ** 2 / period) ** (1.0 / 6.0)
    force = MASSES[i] * count / period**2 / radius
    calm = 0.75 + 0.25 * min(VISCOUS[i] / MASSES[i] / 60.0, 1.0)
    slower = min(calm, 0.54 / (lightest * period) * (0.18 / force) ** 0.52)
    return slower, max(min(1.0, (2.2 / force) ** 0.52), slower)


def walk_of(i: int, quicker: float = 1.0) -> float:
    slower, _ = relative_bandwidths(i)
    return WALK * float(MASSES[i] / MASSES[0]) * (slower * quicker) ** 3


def gain_of(
    i: int, quicker: float, period: float = PERIOD, count: float = COUNT, radius: float = 0.08
) -> NDArray[np.float64]:
    alone = np.zeros(1, ESTIMATOR)
    slower, _ = relative_bandwidths(i, period, count, radius)
    walk = WALK * float(MASSES[i] / MASSES[0]) * (slower * quicker) ** 3
    set_estimator(alone, MASSES[i], VISCOUS[i], 0.0, 0.0, period, count, walk, DELAY)
    gain: NDArray[np.float64] = alone["steady_gain"][0]
    return gain


@pytest.mark.parametrize("i", [3, 8])
def test_state_is_that_of_the_matching_filter_alone(i: int) -> None:
    bank, estimator = bank_at(0.0)
    bank["within"], bank["far"], bank["untimely"] = 0.0, np.inf, 0.0
    # With the delay as told, and what torques do then.
    bank["regression"]["excess_before"] = 1e18, 0.0
    phi_after, newer = discrete(MASSES[i], VISCOUS[i], 0.65 * PERIOD)
    bank["older_by_share"], bank["newer_by_share"] = 0.0, 0.0
    bank["older_by_share"][0, 0, :, i] = (
        phi_after @ discrete(MASSES[i], VISCOUS[i], 0.35 * PERIOD)[1]
    )
    bank["newer_by_share"][0, 0, :, i] = newer
    play(bank, estimator, float(MASSES[i]), pulses(0.3))
    alone = np.zeros(1, ESTIMATOR)
    set_estimator(alone, MASSES[i], VISCOUS[i], 0.0, 0.0, PERIOD, COUNT, walk_of(i), DELAY)
    reset_estimator(alone, 0.0)
    play(None, alone, float(MASSES[i]), pulses(0.3))
    np.testing.assert_allclose(bank["state"][0, :, i], [alone[n][0] for n in "yvd"], rtol=1e-9)
    np.testing.assert_allclose(bank["gain"][0, :, i], alone["steady_gain"][0], rtol=1e-12)


def test_filters_are_quicker_on_softer_walls() -> None:
    """By K^(-1/6) below K·T²/m = 1, up to the lightest one's; gains as by their own Riccati."""
    bank, _ = bank_at(0.0)
    stiffest = MASSES[15] / PERIOD**2
    for softer, i in ((1.0, 15), (4.0, 15), (64.0, 15), (16.0, 9), (64.0, 2), (64.0, 0)):
        set_pace(bank[0], 0.99 * stiffest / softer)
        of_its_own = softer * MASSES[i] / MASSES[15]
        slower, lively = relative_bandwidths(i)
        quicker = min(min(max(of_its_own, 1.0), 16.0) ** (1.0 / 6.0), lively / slower)
        np.testing.assert_allclose(bank["gain"][0, :, i], gain_of(i, quicker), rtol=0.1)


@pytest.mark.parametrize(
    ("period", "count", "radius"),
    [
        (PERIOD, 6.3e-4, 0.08),
        (PERIOD, 6e-6, 0.08),
        (2e-3, COUNT, 0.08),
        (5e-4, COUNT, 0.08),
        (PERIOD, COUNT, 0.03),
    ],
)
def test_filters_are_as_quick_as_the_encoder_allows(
    period: float, count: float, radius: float
) -> None:
    """By the force of a count in a period at the handle, whatever makes it small or large."""
    bank = np.zeros(1, BANK)
    set_bank(bank, MASSES, VISCOUS, 0.0, period, count, WALK, DELAY, radius=radius)
    reset_bank(bank, 0.0)
    set_pace(bank[0], 1e9)
    steadiest = bank["gain"][0].copy()
    bank["regression"]["way"] = 0.3 * period
    set_pace(bank[0], 1e9)
    for i in (0, 3, 8, 15):
        slower, lively = relative_bandwidths(i, period, count, radius)
        np.testing.assert_allclose(steadiest[:, i], gain_of(i, 1.0, period, count, radius))
        quickest = gain_of(i, lively / slower, period, count, radius)
        np.testing.assert_allclose(bank["gain"][0, :, i], quickest)


def test_stiffest_walls_of_long_delays_and_coarse_encoders() -> None:
    """0.83·m/T² at D = 1.85 periods, with D^-5 beyond, and 2.2 N a count at the handle."""
    masses = np.array([1e-4, 3.5e-3])
    at_185 = stiffest_walls(masses, 1.85, PERIOD, 1e-9, 0.08)
    np.testing.assert_allclose(at_185, 0.83 * masses / PERIOD**2)
    twice = stiffest_walls(masses, 3.7, PERIOD, 1e-9, 0.08)
    np.testing.assert_allclose(twice, at_185 / 2.0**5)
    assert np.all(stiffest_walls(masses, 1.7, PERIOD, 1e-9, 0.08) > masses / PERIOD**2)
    coarse = stiffest_walls(masses, 1.85, PERIOD, 6.3e-4, 0.04)
    np.testing.assert_allclose(coarse, [83.0, 2.2 * 0.04 / 6.3e-4])


@pytest.mark.parametrize(
    ("excess", "quicker"),
    [(-0.35, 1.0), (-0.2, 1.0), (0.1, 1.0), (0.3, 1.45 / 1.65), (0.4, 1.45 / 1.75)],
)
def test_filters_are_as_slow_as_the_delay_that_is_found(excess: float, quicker: float) -> None:
    """But no quicker than for 1.45 periods."""
    bank, estimator = bank_at(0.0)
    bank["regression"]["excess"] = excess
    correct_bank(bank[0], estimator[0], 0.0)
    set_pace(bank[0], 1e9)
    for i in (0, 3, 12):
        expected = gain_of(i, quicker)
        np.testing.assert_allclose(bank["gain"][0, :, i], expected, rtol=0.02)


def largest_pole(gain: NDArray[np.float64], delay: float, found: float, damping: float) -> float:
    """Return the largest pole of a wall of K·T²/m = 0.8 for the lightest mass, but for slow ones.

    The filter has this gain and takes the delay for `found`; damping is what friction adds.
    """
    mass, viscous = MASSES[0], VISCOUS[0]
    stiffness = 0.8 * mass / PERIOD**2
    damped = viscous + math.sqrt(stiffness * mass)
    free = np.array([[0.0, 1.0, 0.0], [0.0, -viscous / mass, 1.0 / mass], [0.0, 0.0, 0.0]])
    wall = free.copy()
    wall[1, :2] = -stiffness / mass, -damped / mass
    over, within = expm(free * PERIOD), expm(wall * PERIOD)
    law = (within[1] - over[1]) / over[1, 2]
    real = np.array([[0.0, 1.0, 0.0], [0.0, -(viscous + damping) / mass, 0.0]])
    # The state: [y, ẏ] of the handle, [y, ẏ, d] of the filter, the last two forces.
    size = 7
    x = np.eye(size)
    known = x[2:5] + np.outer(gain, x[0] - x[2])

    def held(rates: NDArray[np.float64], share: float, state: Any, force: Any) -> Any:
        square = np.zeros((4, 4))
        square[: len(rates), :3] = rates
        square[1, 3] = 1.0 / mass
        step = expm(square * share * PERIOD)
        n = len(rates)
        return step[:n, :n] @ state + np.outer(step[:n, 3], force)

    # 1 < D < 2: the older force acts for D − 1 of the period, the newer one for the rest.
    at_actuation = held(free, found - 1.0, known, x[6])
    force = law @ held(free, 1.0, at_actuation, x[5])
    over_period = np.zeros((size, size))
    over_period[:2] = held(real, 2.0 - delay, held(real, delay - 1.0, x[:2], x[6]), x[5])
    over_period[2:5] = held(free, 2.0 - found, at_actuation, x[5])
    over_period[5], over_period[6] = force, x[5]
    poles = np.linalg.eigvals(over_period)
    return float(np.abs(poles[np.abs(np.angle(poles)) > 0.1]).max())


@pytest.mark.parametrize("settled", [True, False])
def test_estimator_beside_the_bank_takes_over_gain_and_mass(settled: bool) -> None:
    """With the gain of a heavy hand and the mass of a light one it diverges at rest."""
    bank, estimator = bank_at(0.0)

    def left_alone(takes_over: bool) -> float:
        beside = estimator.copy()
        bank["place"], bank["mass"] = 15.0, MASSES[15]
        take_over(bank[0], beside[0])
        if not settled:
            note_missing_sample(beside[0])
            predict(beside[0], 0.0)
        bank["place"], bank["mass"] = 0.0, MASSES[0]
        if takes_over:
            take_over(bank[0], beside[0])
        else:
            set_model(beside[0], MASSES[0], VISCOUS[0], 0.0)
        for j in range(300):
            correct(beside[0], COUNT * (j % 7 == 0))
            predict(beside[0], 0.0)
        return abs(float(beside["v"][0]))

    assert left_alone(True) < 0.1
    assert not left_alone(False) < 1e3


@pytest.mark.parametrize("delay", [1.35, 1.6])
def test_no_friction_keeps_up_a_swing(delay: float) -> None:
    """Coulomb friction adds a damping of 4·f_c/(π·|ẏ|): from none to any, the loop is stable."""
    bank, estimator = np.zeros(1, BANK), np.zeros(1, ESTIMATOR)
    told = delay + 0.1  # with the margin
    walk = force_walk_of(0.85 / (told * PERIOD), float(MASSES[0]), PERIOD, COUNT)
    set_bank(bank, MASSES, VISCOUS, 0.0, PERIOD, COUNT, walk, told)
    set_estimator(estimator, MASSES[0], VISCOUS[0], 0.0, 0.0, PERIOD, COUNT, walk, told)
    reset_estimator(estimator, 0.0)
    reset_bank(bank, 0.0)
    set_pace(bank[0], 0.8 * MASSES[0] / PERIOD**2)
    calm = bank["gain"][0, :, 0].copy()
    bank["regression"]["way"] = 10.0 * COUNT
    set_pace(bank[0], 0.8 * MASSES[0] / PERIOD**2)
    lively = bank["gain"][0, :, 0].copy()
    dampings = [0.0, *np.geomspace(0.01, 3.0, 12)]
    for found in (told - 0.1, told, told + 0.1):
        assert max(largest_pole(calm, delay, found, b) for b in dampings) < 0.98
    # As quick as in motion it would swing with some friction, and is stable without any.
    assert max(largest_pole(lively, delay, told + 0.1, b) for b in dampings) > 1.0
    assert largest_pole(lively, delay, told + 0.1, 0.0) < 0.9


def test_filters_are_quickest_behind_a_handle_that_moves() -> None:
    """On the stiffest wall as well, until it has moved by less than 6 counts for a time.

    For 0.05 s the filters of hands that feel the encoder's steps are, and for 0.2 s the others.
    """
    bank, _ = bank_at(0.0)
    set_pace(bank[0], 1e9)
    steadiest = bank["gain"][0].copy()
    bank["regression"]["way"] = -6.1 * COUNT
    set_pace(bank[0], 1e9)
    quickest = bank["gain"][0].copy()
    assert np.all(quickest[:, 6:16] > 1.05 * steadiest[:, 6:16])
    bank["regression"]["way"] = 5.0 * COUNT
    felt = MASSES > 3.01e-4
    for j in range(201):
        gain = bank["gain"][0, :, :16]
        for which, samples in ((felt, 50), (~felt, 200)):
            expected = (quickest if j < samples else steadiest)[:, :16]
            np.testing.assert_array_equal(gain[:, which], expected[:, which])
        set_pace(bank[0], 1e9)


def test_torques_act_at_the_delay_that_is_found() -> None:
    bank, estimator = bank_at(0.0)
    correct_bank(bank[0], estimator[0], 0.0)
    for excess in (0.0, 0.2, 0.4, 0.9, -0.5):
        bank["regression"]["excess"] = excess
        correct_bank(bank[0], estimator[0], 0.0)
        whole, share = divmod(DELAY + excess, 1.0)
        assert estimator["delay_periods"][0] == whole
        before = estimator["before"]["duration"][0, 0]
        np.testing.assert_allclose(before, share * PERIOD, atol=1e-15)
        for i in (0, 9, 15):
            phi_after, newer = discrete(MASSES[i], VISCOUS[i], (1.0 - share) * PERIOD)
            _, older = discrete(MASSES[i], VISCOUS[i], share * PERIOD)
            older = phi_after @ older
            for name, expected in (("newer", newer), ("older", older)):
                assert np.all(np.abs(bank[name][0, :, i] - expected) < 2e-3 * (newer + older))


def test_delay_that_is_found_adds_to_that_of_samples_that_lag() -> None:
    bank, estimator = bank_at(0.0)
    correct_bank(bank[0], estimator[0], 0.0)
    for turn, late in ((start_lagging, 1.0), (lambda lagging, _: end_lag(lagging), 0.0)):
        turn(estimator[0], 0.0)
        estimator["settled"] = True
        for excess in (0.1, 0.2):
            bank["regression"]["excess"] = excess
            correct_bank(bank[0], estimator[0], 0.0)
            before = estimator["before"]["duration"][0, 0] / PERIOD
            in_force = estimator["delay_periods"][0] + before
            assert in_force == pytest.approx(DELAY + excess + late)
            assert bank["regression"]["delay"][0, 0] == pytest.approx(DELAY + late)


def test_reading_that_contradicts_nothing_leaves_a_heavy_hand_alone() -> None:
    """Up to 0.325 counts for the heaviest, and nothing for those as light as a finger."""
    bank, estimator = bank_at(0.0)
    within = bank["within"][0, :16] / COUNT
    assert np.all(within[MASSES <= 3e-4] == 0.0)
    assert np.all(np.diff(within[MASSES > 3e-4]) > 0.0)
    np.testing.assert_allclose(within[15], 0.325 * (1.0 - 3.0 / 45.0), rtol=1e-9)
    gain = bank["gain"][0, 2, 15]
    for off, corrected in ((0.3, 0.0), (-0.3, 0.0), (1.0, 1.0 - within[15])):
        bank["state"] = 0.0
        correct_bank(bank[0], estimator[0], off * COUNT)
        np.testing.assert_allclose(bank["state"][0, 2, 15], gain * corrected * COUNT, atol=1e-15)


@pytest.mark.parametrize("i", [0, 6, 15])
def test_what_is_far_from_the_prediction_is_followed_more_quickly(i: int) -> None:
    """Beyond 1.5 counts, and only by the filters of hands that feel the encoder's steps."""
    bank, estimator = bank_at(0.0)
    set_pace(bank[0], 1e9)
    own = bank["gain"][0, :, i].copy()
    bank["regression"]["way"] = 6.1 * COUNT
    set_pace(bank[0], 1e9)
    quickest = bank["gain"][0, :, i].copy()
    bank["regression"]["way"] = 0.0
    for _ in range(200):
        set_pace(bank[0], 1e9)
    share = 0.38 * max(1.0 - 0.18 * 0.08 * PERIOD**2 / (MASSES[i] * COUNT), 0.0)
    assert (share > 0.0) == (i > 3)
    within = bank["within"][0, i] / COUNT
    for off in (1.4, -1.4, 5.0, -5.0):
        bank["state"] = 0.0
        correct_bank(bank[0], estimator[0], off * COUNT)
        near = np.sign(off) * (min(abs(off), 1.5) - within)
        far = off - np.clip(off, -1.5, 1.5)
        corrected = own * near + (own + share * (quickest - own)) * far
        np.testing.assert_allclose(bank["state"][0, :, i], corrected * COUNT, rtol=1e-9)


@pytest.mark.parametrize("step", [0.0, 0.05, -0.4])
@pytest.mark.parametrize("i", [0, 2, 6, 15])
def test_step_of_the_torque_may_be_untimely(i: int, step: float) -> None:
    """A Kalman filter whose force model has noise in the impulse of 0.04 of the step."""
    bank, estimator = bank_at(0.0)
    bank["within"], bank["far"] = 0.0, np.inf
    estimator["in_flight"][0, estimator["delay_periods"][0]] = step
    scale = bank["scale"][0, i]
    prior = bank["covariance"][0, i] * np.outer(scale, scale)
    share = np.clip(np.log(MASSES[i] / MASSES[0] / 1.4) / np.log(2.2 / 1.4), 0.0, 1.0)
    assert (share > 0.0) == (i > 1)
    impulse = 0.04 * share * step * PERIOD / MASSES[i]
    made = impulse * np.array([PERIOD, 1.0, 0.0])
    prior += np.outer(made, made)
    gain = prior[:, 0] / (prior[0, 0] + COUNT**2 / 12.0)
    correct_bank(bank[0], estimator[0], 2.0 * COUNT)
    np.testing.assert_allclose(bank["state"][0, :, i], 2.0 * COUNT * gain, rtol=1e-6)


def test_step_of_a_probe_is_in_time() -> None:
    """It is as small as what it shows, and its filter needs all of it."""
    bank, estimator = bank_at(0.0)
    now = estimator["delay_periods"][0]
    estimator["in_flight"][0, now] = bank["probe"]["in_flight"][0, 0, now] = 0.02
    correct_bank(bank[0], estimator[0], COUNT)
    np.testing.assert_allclose(bank["state"][0, :, 4], COUNT * bank["gain"][0, :, 4], rtol=1e-9)


def test_nothing_is_learned_in_free_motion_nor_at_rest() -> None:
    free = play(*bank_at(0.0), 3.6e-3, np.zeros(200))
    held = play(*bank_at(0.0), 3.6e-3, np.full(200, 0.01), stuck=True)
    assert np.all(free == free[0])
    assert np.all(held == held[0])


def test_hand_is_forgotten_after_the_contact() -> None:
    torques = np.concatenate([pulses(0.3), np.zeros(210)])
    found = play(*bank_at(0.0), 1.4e-3, torques)
    assert found[100] > 1e-3
    np.testing.assert_allclose(found[-1], MASSES[0], rtol=1e-12)


def test_lost_samples_do_not_change_the_mass() -> None:
    torques = np.concatenate([pulses(0.3), pulses(0.3)])
    found = play(*bank_at(0.0), 1.4e-3, torques, lost=(75, 76, 77))
    assert np.all(found[75:78] == found[74])
    np.testing.assert_allclose(found[88:], 1.4e-3, rtol=0.15)
    assert found[-1] != found[88]  # learned from the second pulses, too


def test_found_delay_is_none_of_the_bus() -> None:
    """What waits for a SYNC, and how many more periods may be missed, go by the delay as told."""
    for told, excess, lags in ((1.0, -0.2, True), (2.25, -0.4, False)):
        bank, estimator = np.zeros(1, BANK), np.zeros(1, ESTIMATOR)
        of_bank, of_filter = (0.0, PERIOD, COUNT, WALK), (0.0, 0.0, PERIOD, COUNT, WALK)
        set_bank(bank, MASSES, VISCOUS, *of_bank, told + 0.1, margin=0.1)
        set_estimator(estimator, MASSES[0], VISCOUS[0], *of_filter, told + 0.1, 0.1)
        reset_estimator(estimator, 0.0)
        reset_bank(bank, 0.0)
        set_pace(bank[0], 1e9)
        bank["regression"]["excess"] = excess
        correct(estimator[0], 0.0)
        correct_bank(bank[0], estimator[0], 0.0)
        assert estimator["delay_periods"] == int(told) - (told + 0.1 + excess < int(told))
        assert may_lag(estimator[0]) == lags
        estimator["in_flight"][0, 0] = 0.5
        stand_still(estimator[0], 5)
        assert estimator["v"] == 0.0


def test_hand_without_damping() -> None:
    assert hand_damping(0.0, 0.0) == hand_damping(1e-3, 0.0) == 0.0


def test_lost_samples_in_motion_leave_what_is_known_of_the_mass() -> None:
    """The observer begins anew at the handle's speed: at rest it would not explain the motion."""
    known = []
    for lost in ((), (100,)):
        bank, estimator = bank_at(0.0)
        play(bank, estimator, 1.4e-3, np.concatenate([pulses(0.3), np.zeros(80)]), lost)
        known.append(bank["regression"]["information"][0, 0, 1, 1])
        np.testing.assert_allclose(estimator["mass"], 1.4e-3, rtol=0.15)
    assert estimator["settled"]
    assert known[1] > 0.5 * known[0]


@pytest.mark.parametrize("delay", [0.35, 1.35, 2.35, float(MAX_DELAY)])
def test_both_last_steps_of_the_torque_are_uncertain(delay: float) -> None:
    _, estimator = bank_at(0.0)
    set_model_delay(estimator[0], delay)
    for step in (1.0, -2.0, 4.0, -8.0, 16.0, -32.0):
        predict(estimator[0], step)
    acting = [-32.0, 16.0, -8.0, 4.0, -2.0, 1.0][int(delay) :][:3]
    assert _torque_steps(estimator[0]) == np.abs(np.diff(acting)).sum()


def test_drive_cycle_and_lag_belong_to_the_delay() -> None:
    keys = {
        "simulation.ideal": False,
        "drive.drive_cycle_s": 0.00025,
        "drive.current_bandwidth_hz": 1600.0,
    }
    assert modelled_delay(settings_with({})) == 1.0
    expected = 1.0 + 0.25 + 1000.0 / (2.0 * np.pi * 1600.0)
    np.testing.assert_allclose(modelled_delay(settings_with(keys)), expected)


@pytest.mark.parametrize(
    "keys",
    [{"bus.cycle_s": 0.00015}, {"estimator.delay_cycles": 3.0}, {"drive.drive_cycle_s": 0.002}],
)
def test_drive_that_is_too_late_for_the_cycle(keys: dict[str, float]) -> None:
    drive = {"drive.drive_cycle_s": 0.00025, "drive.current_bandwidth_hz": 1600.0}
    drive["simulation.ideal"] = False
    with pytest.raises(
        ConfigError,
        match=r"acts 3\.\d+ cycles .* of drive.current_bandwidth_hz; .* longer bus.cycle_s",
    ):
        modelled_delay(settings_with(drive | keys))


def test_velocity_is_projected_with_the_covariance() -> None:
    """E[x | v = w] = x + P·e/(eᵀ·P·e)·(w − v), e the velocity's unit vector, by SciPy's Riccati."""
    bank, _ = bank_at(0.0)
    for i in range(8):
        phi, gamma = discrete(MASSES[i], VISCOUS[i], PERIOD)
        a = np.eye(3)
        a[:2, :2], a[:2, 2] = phi, gamma
        walk = walk_of(i)
        # In counts, counts per second and mN·m, for the solver's sake.
        units = np.array([COUNT, COUNT / 1e-3, 1e-3])
        a = a * units / units[:, None]
        noise = np.diag([0.0, 0.0, PERIOD * (walk / units[2]) ** 2])
        seen = np.array([[1.0, 0.0, 0.0]])
        prior = solve_discrete_are(a.T, seen.T, noise, np.array([[1.0 / 12.0]]))
        after = np.linalg.inv(np.linalg.inv(prior) + 12.0 * seen.T @ seen)
        expected = after[[0, 2], 1] / after[1, 1] * units[[0, 2]] / units[1]
        np.testing.assert_allclose(bank["with_velocity"][0, :, i], expected, rtol=1e-5)


@pytest.mark.parametrize("stiffness", [2000.0, 100.0, 30.0, 5.0, 1.0])
def test_no_filter_leaves_a_handle_at_rest(stiffness: float) -> None:
    """Bounded by the covariance of another gain, some diverge within a second."""
    bank, estimator = bank_at(0.0)
    set_pace(bank[0], stiffness)
    bank["holds_from"] = 10_000  # no wall gives these torques
    bank["state"][0, 1] = 0.05  # it has just come to rest
    for j in range(2000):
        torque = 0.1 + 0.02 * math.sin(0.05 * j)
        correct(estimator[0], 0.0)
        correct_bank(bank[0], estimator[0], 0.0)
        predict_bank(bank[0], estimator[0], torque)
        predict(estimator[0], torque)
    y, v, _ = bank["state"][0, :, : len(MASSES)]
    assert np.abs(y).max() < 2.0 * COUNT
    assert np.abs(v).max() < 0.02


def test_handle_that_sticks_is_known_to_rest() -> None:
    """A wall of 50 N·m/rad pushes it as the estimate says, which stiction holds."""
    stiffness, damping = 50.0, 0.07

    def pushed(bounded: bool) -> NDArray[np.float64]:
        bank, estimator = bank_at(-20 * COUNT)
        if not bounded:
            bank["equal_samples"] = np.inf
        bank["state"][0, 1] = estimator["v"] = 0.08  # it has just come to rest
        forces = np.empty(100)
        for j in range(len(forces)):
            correct(estimator[0], -20 * COUNT)
            correct_bank(bank[0], estimator[0], -20 * COUNT)
            forces[j] = -stiffness * estimator["y"][0] - damping * estimator["v"][0]
            predict_bank(bank[0], estimator[0], forces[j])
            predict(estimator[0], forces[j])
        return np.abs(forces - stiffness * 20 * COUNT)

    # After 24 periods it is off by less than half a count, and would have been by ten.
    assert pushed(True)[24:].max() < 0.5 * stiffness * COUNT
    assert pushed(False)[24:].max() > 10.0 * stiffness * COUNT


def test_gain_with_trend_is_that_of_its_riccati_recursion() -> None:
    mass, viscous, bandwidth = 1.5e-4, 2e-3, 570.0
    phi, gamma = discrete(mass, viscous, PERIOD)
    a = np.eye(4)
    a[:2, :2], a[:2, 2], a[:2, 3], a[2, 3] = phi, gamma, 0.5 * PERIOD * gamma, PERIOD
    # q of `kalman_model` for this bandwidth, and ω times it, with R = 1/12 of a square count.
    q = force_walk_of(bandwidth, mass, PERIOD, COUNT)
    noise = np.diag([0.0, 0.0, q**2, (bandwidth * q) ** 2]) * PERIOD
    covariance = noise.copy()
    for _ in range(3000):
        gain = covariance[:, 0] / (covariance[0, 0] + COUNT**2 / 12.0)
        covariance = a @ (covariance - np.outer(gain, covariance[0])) @ a.T + noise
    found = gain_with_trend(mass, viscous, 0.0, PERIOD, bandwidth)
    np.testing.assert_allclose(found, gain, rtol=1e-6)


def growing_push(rate: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return Φ of [y, ẏ, d] for the lightest handle, and what a push of this rate [N·m/s] adds."""
    mass, viscous = float(MASSES[0]), float(VISCOUS[0])
    a = np.zeros((4, 4))
    a[0, 1], a[1, 1], a[1, 2], a[2, 3] = 1.0, -viscous / mass, 1.0 / mass, rate
    phi = expm(a * PERIOD)
    return phi[:3, :3], phi[:3, 3]


def fly(
    bank: NDArray[np.void], estimator: NDArray[np.void], rate: float, cycles: int
) -> NDArray[np.float64]:
    """Let a push that grows at this rate [N·m/s] move the lightest handle; return [y, ẏ, d]."""
    phi, grown = growing_push(rate)
    x = np.array([0.5, -0.5, 0.0])
    reset_estimator(estimator, x[0])
    reset_bank(bank, x[0])
    for j in range(cycles):
        correct(estimator[0], x[0])
        set_pace(bank[0], 1e9)
        correct_bank(bank[0], estimator[0], x[0])
        if j < cycles - 1:
            predict_bank(bank[0], estimator[0], 0.0)
            predict(estimator[0], 0.0)
            x = phi @ x + grown
    return x


def test_filter_of_a_light_hand_in_flight_is_not_behind_a_push_that_grows() -> None:
    rate = -4.0
    bank, estimator = bank_at(0.0)
    true = fly(bank, estimator, rate, 40)
    assert not bank["flies"][0]
    phi, grown = growing_push(rate)
    left = np.eye(3) - np.outer(bank["gain"][0, :, 0], [1.0, 0.0, 0.0])
    behind = left @ np.linalg.solve(np.eye(3) - phi @ left, grown)
    np.testing.assert_allclose(true - bank["state"][0, :, 0], behind, rtol=0.01)
    true = fly(bank, estimator, rate, 120)
    assert bank["flies"][0]
    # Over a period the filter holds the push at its mean: ḋ·T²/(12·m) of the velocity remains.
    assert np.all(np.abs(true - bank["state"][0, :, 0]) < 0.05 * np.abs(behind))
    assert bank["trend"][0, 0] == pytest.approx(rate, rel=0.01)
    # The laws have the push as it will be, on the average, up to the end of their force.
    ahead = 0.5 * (1.0 + DELAY) * PERIOD
    assert estimator["d"][0] - true[2] == pytest.approx(ahead * rate, rel=0.01)


def sticks(
    bank: NDArray[np.void],
    estimator: NDArray[np.void],
    torques: NDArray[np.float64],
    speed: float = 0.0,
) -> NDArray[np.float64]:
    """Let a handle stick under these torques, between two counts; return the ḋ of the lightest.

    It goes on with this speed [rad/s] for the first two samples, until a torque has begun to act.
    """
    came = float(bank["sampled"][0])
    trends = []
    for j, torque in enumerate(torques):
        y = came + min(j + 1, 2) * speed * PERIOD + (j % 2) * COUNT
        predict_bank(bank[0], estimator[0], torque)
        predict(estimator[0], torque)
        correct(estimator[0], y)
        correct_bank(bank[0], estimator[0], y)
        trends.append(float(bank["trend"][0, 0]))
    return np.array(trends)


def test_trend_is_no_faster_than_a_hand_and_is_forgotten_in_a_blow() -> None:
    bank, estimator = bank_at(0.0)
    fly(bank, estimator, -30.0, 90)
    assert bank["trend"][0, 0] == -8.0
    heavier = MASSES / MASSES[0] > 3.0
    assert np.all(bank["trend"][0, :16][heavier] == 0.0)
    sticks(bank, estimator, np.full(1, 0.2))
    assert bank["trend"][0, 0] == 8.0  # a handle that stops at once is all that the flight sees
    # The torque begins to act at the second sample.
    fly(bank, estimator, -30.0, 90)
    trends = sticks(bank, estimator, np.full(4, 0.2), speed=-3.0)
    assert not bank["flies"][0]
    assert trends[3] / trends[1] == pytest.approx(math.exp(-2.0e-3 / 2.8e-3))
    # Out of the wall again it is no push that begins, either.
    fly(bank, estimator, -30.0, 90)
    trends = sticks(bank, estimator, np.tile([0.2, 0.2, 0.0, 0.0], 6), speed=-3.0)
    assert abs(trends[-1]) < 0.01


@pytest.mark.parametrize(("stiffness", "forgotten_s"), [(0.61, 0.007), (0.59, 0.0028)])
def test_trend_is_forgotten_more_slowly_at_a_stiff_wall_if_the_handle_came_slowly(
    stiffness: float, forgotten_s: float
) -> None:
    bank, estimator = bank_at(0.0)
    fly(bank, estimator, -0.02, 60)
    set_pace(bank[0], stiffness * MASSES[0] / PERIOD**2)
    trends = sticks(bank, estimator, np.array([0.2, 0.2, 0.2, 0.0, 0.0, 0.0]), speed=-2.6)
    assert trends[3] / trends[1] == pytest.approx(math.exp(-2.0e-3 / forgotten_s))
    # When the wall has let go again, it is as fast as ever.
    assert trends[5] / trends[4] == pytest.approx(math.exp(-1.0e-3 / 2.8e-3))


@pytest.mark.parametrize(("speed", "forgotten_s"), [(-2.6, 0.007), (-3.0, 0.0028)])
def test_trend_of_a_hand_that_begins_to_press_is_followed_for_a_while(
    speed: float, forgotten_s: float
) -> None:
    """On a handle that sticks d is minus the torque: 40 ms after the flight its lag is back."""
    rate = 4.0
    bank, estimator = bank_at(0.0)
    fly(bank, estimator, 0.0, 60)
    assert bank["flies"][0]
    torques = rate * PERIOD * np.arange(120.0)
    trends = sticks(bank, estimator, torques, speed)
    assert np.all(np.abs(trends[30:40] + rate) < 0.25 * rate)
    left = math.exp(-PERIOD / forgotten_s)
    np.testing.assert_allclose(trends[70:] / trends[69:-1], left, rtol=1e-6)
    # No flight, no trend: friction and a filter that integrates twice would hunt each other.
    bank, estimator = bank_at(0.0)
    assert np.all(sticks(bank, estimator, torques) == 0.0)


def test_handle_that_rests_does_not_fly() -> None:
    """Rest bounds the velocity, by the covariance of a filter without a trend."""
    bank, estimator = bank_at(0.0)
    play(bank, estimator, 1e-4, np.zeros(120), stuck=True)
    assert not bank["flies"][0]
    assert np.all(bank["trend"] == 0.0)


def test_no_trend_on_an_elastic_shaft() -> None:
    bank, _ = bank_at(0.0)
    light = MASSES / MASSES[0] <= 3.0
    assert np.all(bank["gain_in_flight"][0, 0, :16][light] > 0.0)
    shaft = ElasticShaft(1e-4, 0.6e-4, 400.0, 0.02, 0.0)
    set_bank(bank, MASSES, VISCOUS, 0.0, PERIOD, COUNT, WALK, DELAY, shaft)
    assert np.all(bank["gain_in_flight"] == 0.0)
    assert np.all(bank["trend_gain"] == 0.0)
