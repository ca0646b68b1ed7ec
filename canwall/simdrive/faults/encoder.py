"""An encoder that may jump or stick, between the motion and the drive."""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from canwall.simdrive.mechanics.motion import RecordedMotion
from canwall.simdrive.profile.power_drive_system import Motion


class Advance(Protocol):
    """Signature of `Motion.advance`."""

    def __call__(self, torque_nm: float, duration_s: float) -> None:
        """Move on by ``duration_s`` under a torque."""
        ...


class FaultyEncoder:
    """Reads the motion, with an offset where the encoder has jumped, or not at all.

    Without a fault the drive calls the methods of the motion itself: nothing is slower.
    """

    counts: Callable[[], int]
    speed_counts_per_s: Callable[[], float]
    torque_nm: Callable[[], float | None]
    advance: Advance

    def __init__(self, motion: Motion) -> None:
        """Read the motion as it is."""
        self._motion = motion
        self._recorded = motion if isinstance(motion, RecordedMotion) else None
        self.advance = motion.advance
        self.torque_nm = motion.torque_nm
        self._offset = 0
        self.release()

    @property
    def motion(self) -> Motion:
        """The motion that it reads."""
        return self._motion

    @property
    def record(self) -> NDArray[np.void] | None:
        """Record of the motion (`RecordedMotion`); None while it is not read truly."""
        motion = self._motion
        true = self.counts == motion.counts and self.speed_counts_per_s == motion.speed_counts_per_s
        return self._recorded.record if self._recorded and true else None

    def jump(self, increments: int) -> None:
        """Read this many increments more from now on."""
        self._offset += increments
        if not self._stuck:
            self.counts = self._counts if self._offset else self._motion.counts

    def stick(self) -> None:
        """Read the present position from now on, and no speed."""
        stuck_at = self.counts()
        self._stuck = True
        self.counts = lambda: stuck_at
        self.speed_counts_per_s = float

    def release(self) -> None:
        """Read the motion again."""
        self._stuck = False
        self.speed_counts_per_s = self._motion.speed_counts_per_s
        self.jump(0)

    def _counts(self) -> int:
        return self._motion.counts() + self._offset
