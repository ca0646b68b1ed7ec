"""Durations of the cycle in histograms of fixed size, filled without allocation.

The width of a bucket is 1/32 of an octave's lower end, from 1 ns to 16 s.
"""

import numpy as np
from numpy.typing import NDArray

#: Buckets in an octave as a power of two, and as a number; octaves.
SUB_BITS = 5
SUB = 1 << SUB_BITS
OCTAVES = 30

#: Counts per bucket, and the exact maximum.
HISTOGRAM = np.dtype([("counts", "u8", (OCTAVES * SUB,)), ("largest_ns", "i8")], align=True)


def percentile_ns(histogram: NDArray[np.void], percent: float) -> float:
    """Return a percentile of the durations, to within 1/32; 0 for an empty histogram."""
    counts = histogram["counts"][0]
    total = int(counts.sum())
    if total == 0:
        return 0.0
    bucket = int(np.searchsorted(np.cumsum(counts), np.ceil(total * percent / 100.0)))
    return min(float(_upper_ns(bucket)), float(histogram["largest_ns"][0]))


def buckets_ns(histogram: NDArray[np.void]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the upper ends [ns], inclusive, and the counts of the buckets that are not empty."""
    used = np.flatnonzero(histogram["counts"][0])
    ends = np.array([_upper_ns(int(bucket)) for bucket in used], np.int64)
    return ends, histogram["counts"][0][used].astype(np.int64)


def _upper_ns(bucket: int) -> int:
    """Return the longest duration that is counted in a bucket."""
    octave = max(bucket // SUB - 1, 0)
    return ((bucket - octave * SUB + 1) << octave) - 1


def timing_summary(histogram: NDArray[np.void]) -> dict[str, float]:
    """Return p50, p99, p99.9 and max in microseconds."""
    summary = {
        f"p{percent:g}_us": percentile_ns(histogram, percent) / 1e3 for percent in (50, 99, 99.9)
    }
    summary["max_us"] = float(histogram["largest_ns"][0]) / 1e3
    return summary
