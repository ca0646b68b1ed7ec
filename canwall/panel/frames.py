"""Signals on their way to a page: least and largest values over time, in binary."""

import struct

import numpy as np
from numpy.typing import NDArray

#: Columns of the record that a page plots, in the order of a frame.
SIGNALS = (
    "y",
    "force",
    "torque_cmd",
    "torque_actual",
    "v_est",
    "wall_position_rad",
    "stiffness_in_force",
)

#: Kind, version, columns, points, reserved.
_HEADER = struct.Struct("<BBHId")
_OF_SIGNALS, _OF_CONTACT = 1, 2
_VERSION = 1


def signals_frame(
    time_s: NDArray[np.float64], low: NDArray[np.float32], high: NDArray[np.float32]
) -> bytes:
    """Return signals as a binary frame.

    It has the header; the times as 64-bit floats; then, for each column, its least and its largest
    values as 32-bit floats; all little-endian.

    Args:
        time_s: Times of N points [s], shape (N,).
        low: Least values of C columns at each point, shape (C, N).
        high: Largest values, shape (C, N).
    """
    columns, points = low.shape
    values = np.stack([low, high], axis=1).astype("<f4", copy=False)
    header = _HEADER.pack(_OF_SIGNALS, _VERSION, columns, points, 0.0)
    return header + np.asarray(time_s, "<f8").tobytes() + values.tobytes()


def contact_frame(
    stiffness: float,
    time_s: NDArray[np.float64],
    y: NDArray[np.float64],
    force: NDArray[np.float64],
) -> bytes:
    """Return the next points of the running contact as a binary frame; without points it begins.

    Args:
        stiffness: Slope of the referent line, NaN if it is hidden.
        time_s: Times [s], shape (N,).
        y: Positions relative to the wall, shape (N,).
        force: Forces of the wall, shape (N,).
    """
    header = _HEADER.pack(_OF_CONTACT, _VERSION, 2, len(time_s), stiffness)
    values = np.stack([y, force]).astype("<f4")
    return header + np.asarray(time_s, "<f8").tobytes() + values.tobytes()


class Buckets:
    """Rows of a run on their way to least and largest values over equal times.

    Attributes:
        cycles: Cycles in a bucket.
    """

    def __init__(self, cycles: int) -> None:
        self.cycles = cycles
        self._rest: NDArray[np.void] | None = None

    def take(
        self, rows: NDArray[np.void]
    ) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
        """Return the buckets that are complete with these rows; keep the others for the next call.

        NaN is left out, unless a bucket has nothing else.

        Args:
            rows: Rows of the record, dtype ROW, shape (n,), rising in j; some may be missing.

        Returns:
            Times of the first rows of the buckets [s], shape (N,), and the least and the largest
            values of SIGNALS, shape (C, N).
        """
        if self._rest is not None:
            rows = np.concatenate([self._rest, rows])
        bucket = rows["j"] // self.cycles
        whole = int(np.searchsorted(bucket, bucket[-1])) if len(rows) else 0
        self._rest = rows[whole:]
        starts = np.flatnonzero(np.diff(bucket[:whole], prepend=-1))
        values = np.stack([rows[name][:whole] for name in SIGNALS]).astype(np.float32)
        if not len(starts):
            values = values[:, :0]
            return rows["t_s"][:0], values, values
        low = np.fmin.reduceat(values, starts, axis=1)
        return rows["t_s"][starts], low, np.fmax.reduceat(values, starts, axis=1)
