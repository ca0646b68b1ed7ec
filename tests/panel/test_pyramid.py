"""Least and largest values at any zoom: against NumPy's, block by block."""

import itertools
import warnings

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from canwall.panel.pyramid import Pyramid

PERIOD_S = 0.001


@given(
    rows=st.integers(1, 700),
    seed=st.integers(0, 2**32 - 1),
    points=st.integers(1, 40),
    ends=st.tuples(st.floats(-0.1, 0.8), st.floats(-0.1, 0.8)),
)
def test_every_block_has_the_least_and_the_largest_of_its_rows(
    rows: int, seed: int, points: int, ends: tuple[float, float]
) -> None:
    random = np.random.default_rng(seed)
    signals = random.normal(size=(3, rows)).astype(np.float32)
    signals[:, random.random(rows) < 0.1] = np.nan
    # SYNCs that were skipped leave gaps.
    time_s = PERIOD_S * np.cumsum(random.integers(1, 3, rows))
    start_s, stop_s = min(ends), max(ends)
    shown_s, low, high = Pyramid(time_s, signals).between(start_s, stop_s, points)

    inside = (start_s <= time_s) & (time_s <= stop_s)
    assert 1 <= len(shown_s) <= points + 1
    assert low.shape == high.shape == (3, len(shown_s))
    firsts = np.searchsorted(time_s, shown_s)
    assert np.array_equal(time_s[firsts], shown_s)
    sizes = np.diff(firsts)
    assert len(set(sizes.tolist())) <= 1
    after = firsts[-1] + (sizes[0] if len(sizes) else rows)
    if inside.any():
        assert shown_s[0] <= time_s[inside][0]
        assert time_s[inside][-1] <= time_s[min(after, rows) - 1]
    if len(sizes):
        bounds = [*firsts, min(after, rows)]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # blocks of NaN alone
            for i, (a, b) in enumerate(itertools.pairwise(bounds)):
                np.testing.assert_array_equal(low[:, i], np.nanmin(signals[:, a:b], axis=1))
                np.testing.assert_array_equal(high[:, i], np.nanmax(signals[:, a:b], axis=1))


@given(row=st.integers(0, 99_999), points=st.integers(1, 3000))
def test_a_peak_of_one_cycle_is_seen_at_every_zoom(row: int, points: int) -> None:
    signals = np.zeros((1, 100_000), np.float32)
    signals[0, row] = 1.0
    time_s = PERIOD_S * np.arange(100_000)
    _, low, high = Pyramid(time_s, signals).between(-np.inf, np.inf, points)
    assert high.max() == 1.0
    assert np.count_nonzero(high) == 1
    assert not low.any() or low.shape[1] == 100_000
