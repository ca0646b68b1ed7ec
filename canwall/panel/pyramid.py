"""Least and largest values of long signals at any zoom, without a look at each row."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

#: Rows in a block of the finest level that is kept.
_FINEST = 16


class Pyramid:
    """Signals with the least and largest values of their blocks of 16, 32, 64 … rows.

    A value of a single row is in every block that has it, so no peak is lost at any zoom. NaN is
    left out, unless a block has nothing else.
    """

    def __init__(self, time_s: NDArray[np.float64], columns: Floats) -> None:
        """Compute the blocks.

        Args:
            time_s: Times of the rows, rising [s], shape (n,), n > 0.
            columns: Signals, shape (c, n).
        """
        self.time_s = time_s
        self._columns = columns
        low, high = _halved(columns, columns, _FINEST)
        self._levels = [(low, high)]
        while low.shape[1] > 1:
            low, high = _halved(low, high, 2)
            self._levels.append((low, high))

    def between(
        self, start_s: float, stop_s: float, points: int
    ) -> tuple[NDArray[np.float64], Floats, Floats]:
        """Return the signals from start to stop in at most `points` + 1 blocks of equal length.

        The blocks have as few rows as that allows, a power of two; the outer ones may reach beyond
        the interval.

        Args:
            start_s: Start of the interval [s].
            stop_s: Its end [s].
            points: Largest number of blocks within the interval.

        Returns:
            Times of the first rows of the blocks [s], shape (N,), and the least and the largest
            values in each block, shape (c, N).
        """
        rows = len(self.time_s)
        first = max(int(np.searchsorted(self.time_s, start_s, "right")) - 1, 0)
        last = min(int(np.searchsorted(self.time_s, stop_s, "left")) + 1, rows)
        size = 1
        while -(-(last - first) // size) > points:
            size *= 2
        block, after = first // size, -(-last // size)
        if size < _FINEST:
            found = self._columns[:, block * size : after * size]
            low, high = _halved(found, found, size)
        else:
            level = (size // _FINEST).bit_length() - 1
            low, high = (values[:, block:after] for values in self._levels[level])
        return self.time_s[block * size : after * size : size], low, high


def _halved(low: Floats, high: Floats, size: int) -> tuple[Floats, Floats]:
    """Return the values of blocks of `size` columns, a power of two; the last may have fewer."""
    while size > 1:
        low, high = _of_pairs(np.fmin, low), _of_pairs(np.fmax, high)
        size //= 2
    return low, high


def _of_pairs(smaller_or_larger: np.ufunc, values: Floats) -> Floats:
    pairs = values.shape[1] // 2
    found = np.empty((values.shape[0], values.shape[1] - pairs), values.dtype)
    smaller_or_larger(values[:, : 2 * pairs : 2], values[:, 1 : 2 * pairs : 2], found[:, :pairs])
    found[:, pairs:] = values[:, 2 * pairs :]
    return found
