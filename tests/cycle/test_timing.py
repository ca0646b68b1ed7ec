"""Histograms of fixed size against numpy's percentiles of all values."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from canwall.cycle import HISTOGRAM, observe_ns, percentile_ns, timing_summary

LONGEST_NS = 1 << 34  # 17 s


def histogram_of(values: list[int]) -> NDArray[np.void]:
    histogram = np.zeros(1, HISTOGRAM)
    for value in values:
        observe_ns(histogram, value)
    return histogram


durations = st.one_of(
    st.integers(0, 200), st.integers(0, 2_000_000), st.integers(0, LONGEST_NS - 1)
)


@settings(deadline=None, max_examples=300)
@given(
    values=st.lists(durations, min_size=1, max_size=300),
    percent=st.sampled_from([1.0, 50.0, 90.0, 99.0, 99.9, 100.0]),
)
def test_percentile_to_the_width_of_a_bucket(values: list[int], percent: float) -> None:
    found = percentile_ns(histogram_of(values), percent)
    exact = float(np.percentile(values, percent, method="inverted_cdf"))
    assert exact <= found <= exact * (1 + 1 / 32)


def test_small_values_are_exact() -> None:
    for value in range(64):
        assert percentile_ns(histogram_of([value, 1000]), 50.0) == value


def test_every_power_of_two_has_its_bucket() -> None:
    for exponent in range(34):
        for value in (2**exponent - 1, 2**exponent):
            found = percentile_ns(histogram_of([value, LONGEST_NS]), 50.0)
            assert value <= found <= value * (1 + 1 / 32)


def test_nothing_observed() -> None:
    assert percentile_ns(histogram_of([]), 99.0) == 0.0
    assert timing_summary(histogram_of([]))["max_us"] == 0.0


def test_outside_of_the_buckets() -> None:
    assert percentile_ns(histogram_of([-5]), 50.0) == 0.0  # a clock that was set back
    longer = histogram_of([1 << 40])
    assert longer["counts"].sum() == 1
    assert timing_summary(longer)["max_us"] == pytest.approx((1 << 40) / 1e3)


def test_summary_in_microseconds() -> None:
    summary = timing_summary(histogram_of([*range(0, 1_000_000, 1000)]))
    assert list(summary) == ["p50_us", "p99_us", "p99.9_us", "max_us"]
    assert summary["p50_us"] == pytest.approx(500.0, rel=1 / 32)
    assert summary["p99_us"] == pytest.approx(990.0, rel=1 / 32)
    assert summary["max_us"] == 999.0
