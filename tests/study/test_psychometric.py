"""Shares of answers and the psychometric function: against closed forms, and known observers."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from canwall.study import Staircase, balanced_trials, fit_psychometric, next_wall, share_of


@given(st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_the_interval_is_wilsons(counts: tuple[int, int]) -> None:
    chosen, trials = counts
    found = share_of(chosen, trials)
    # Wilson (1927): the shares p with |k/n - p| = z·sqrt(p·(1 - p)/n).
    z = norm.ppf(0.975)
    roots = np.roots([1 + z**2 / trials, -(2 * found.share + z**2 / trials), found.share**2])
    assert found.share == chosen / trials
    np.testing.assert_allclose([found.low, found.high], np.sort(roots.real), atol=1e-6)
    assert 0.0 < found.p <= 1.0


def test_the_p_value_is_that_of_the_sign_test() -> None:
    # 9 of 10: 2·(C(10,9) + C(10,10))/2**10.
    assert share_of(9, 10).p == pytest.approx(2 * 11 / 1024)
    assert share_of(5, 10).p == 1.0


@settings(max_examples=30)
@given(st.integers(1, 99), st.integers(1, 99), st.floats(0.2, 0.9), st.floats(1.1, 5.0))
def test_two_ratios_are_met_exactly(one: int, other: int, low: float, high: float) -> None:
    fit = fit_psychometric([low, high], [one, other], [100, 100])
    a, b = norm.ppf(one / 100), norm.ppf(other / 100)
    if one == other:
        assert fit is None
        return
    assert fit is not None
    slope = (b - a) / (math.log(high) - math.log(low))
    assert math.log(fit.equal) == pytest.approx(math.log(low) - a / slope, rel=1e-3, abs=1e-3)
    assert math.log(fit.noticed) == pytest.approx(norm.ppf(0.75) / slope, rel=1e-3, abs=1e-6)


@pytest.mark.parametrize(
    "chosen", [[0, 0, 0], [10, 10, 10], [0, 0, 10], [10, 10, 0], [0, 4, 10]], ids=str
)
def test_answers_that_do_not_overlap_have_no_function(chosen: list[int]) -> None:
    assert fit_psychometric([0.5, 1.0, 2.0], chosen, [10, 10, 10]) is None


@pytest.mark.parametrize("chosen", [[0, 1, 1, 1, 1, 0], [3, 3, 4, 2, 2, 4]])
def test_answers_that_do_not_depend_on_the_ratio_have_no_function(chosen: list[int]) -> None:
    # These ratios are no mirror images to the last digit: there is a slope, of some 1e-4.
    assert fit_psychometric([0.5, 0.71, 0.84, 1.19, 1.41, 2.0], chosen, [6] * 6) is None


def test_an_observer_is_found_again() -> None:
    random = np.random.default_rng(1)
    ratios = [0.5, 0.7, 0.9, 1.1, 1.4, 2.0]
    trials = [4000] * len(ratios)
    chance = norm.cdf(np.log(np.array(ratios) / 1.1) / 0.25)
    fit = fit_psychometric(ratios, random.binomial(trials, chance).tolist(), trials)
    assert fit is not None
    assert fit.equal == pytest.approx(1.1, rel=0.02)
    assert fit.noticed == pytest.approx(math.exp(0.6745 * 0.25), rel=0.02)


@given(st.integers(1, 6), st.integers(1, 9), st.integers(0, 2**32 - 1))
def test_trials_are_balanced(pairs: int, repeats: int, seed: int) -> None:
    trials = balanced_trials(pairs, repeats, np.random.default_rng(seed))
    for block in range(repeats):
        of_block = trials[block * pairs : (block + 1) * pairs]
        assert sorted(trial.pair for trial in of_block) == list(range(pairs))
    for pair in range(pairs):
        first = sum(trial.reference_first for trial in trials if trial.pair == pair)
        assert abs(first - repeats / 2) <= 0.5 * (repeats % 2)


@given(st.lists(st.booleans(), min_size=60, max_size=60), st.floats(1.01, 2.0))
def test_a_staircase_step_by_step_is_the_one_that_calls(answers: list[bool], finest: float) -> None:
    stairs = Staircase(5.0, 500.0, finest)
    called: list[float] = []

    def is_free(stiffness: float) -> bool:
        called.append(stiffness)
        return answers[len(called) % 60]

    stairs.climb(is_free)
    walls = stairs.walls()
    stepped: list[float] = []
    stiffness: float | None = next(walls)
    while stiffness is not None:
        stepped.append(stiffness)
        stiffness = next_wall(walls, answers[len(stepped) % 60])
    assert stepped == called
