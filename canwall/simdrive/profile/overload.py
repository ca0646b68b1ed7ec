"""I²t monitoring: limit of the time for which the motor may exceed its rated torque.

The budget is the integral of the squared torque (or current) above the rated one. Once it is used
up, the torque falls back to the rated one; a lower torque restores the budget. Torques are in per
mille of the rated torque.
"""

import math

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.simdrive.state import DriveRecord

_RATED = 1000
_WARNING = 0.8
"""Part of the budget whose use is a warning (statusword bit 7)."""


@compiled
def used_after(drives: NDArray[np.void], passed: float) -> float:
    """Return what is used of the budget once the torque has held for `passed` seconds more."""
    drive: Record = drives[0]
    return max(0.0, drive.used + (drive.held**2 - _RATED**2) * passed)


@compiled
def covered(drives: NDArray[np.void], used: float) -> int:
    """Return the largest torque that the rest of the budget covers for a period."""
    drive: Record = drives[0]
    left = max(0.0, (drive.budget - used) / drive.period)
    return math.floor(min(drive.peak, math.sqrt(_RATED**2 + left) + 1e-9))


@compiled
def warns(drives: NDArray[np.void], used: float) -> bool:
    """Return True if so much of the budget is used that the drive warns."""
    drive: Record = drives[0]
    return used > _WARNING * drive.budget


class Overload:
    """The budget of a motor."""

    def __init__(self, state: DriveRecord, overload_s: float) -> None:
        """Take the time that the budget lasts at the peak torque."""
        self._record, self._state = state.record, state.fields
        self._overload_s = overload_s

    def set_peak(self, peak: float) -> None:
        """Set the peak torque, and with it the budget."""
        self._state.peak = peak
        self._state.budget = max(0.0, peak**2 - _RATED**2) * self._overload_s

    @property
    def warning(self) -> bool:
        """True if four fifths of it are used up."""
        return warns(self._record, self._state.used)

    @property
    def limit(self) -> int:
        """The largest torque that it covers for a period."""
        return covered(self._record, self._state.used)

    def reset(self) -> None:
        """Begin cold."""
        self._state.used = 0.0

    def pass_time(self, passed_s: float) -> None:
        """Account for the torque that has held for ``passed_s`` seconds."""
        self._state.used = used_after(self._record, passed_s)
