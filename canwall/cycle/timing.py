"""Durations of the cycle, counted in the cycle."""

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import compiled
from canwall.record.histogram import OCTAVES, SUB


@compiled
def observe_ns(histograms: NDArray[np.void], duration_ns: int) -> None:
    """Count one duration into a HISTOGRAM array of shape (1,)."""
    histogram = histograms[0]
    value = max(duration_ns, 0)
    histogram.largest_ns = max(histogram.largest_ns, value)
    octave = 0
    while value >= 2 * SUB:
        value >>= 1
        octave += 1
    # Below 2·SUB every value has its own bucket; each octave above adds SUB.
    bucket = min(octave * SUB + value, OCTAVES * SUB - 1)
    histogram.counts[bucket] += 1
