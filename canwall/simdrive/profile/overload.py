"""I²t: how long the motor may have more than its rated torque."""

import math

_RATED_SQUARED = 1000.0**2


class Overload:
    """A budget of the square of the torque (as of the current) above the rated one, over time.

    At the peak torque it lasts for ``overload_s``. Once it is used up the torque falls back to
    the rated one; less than that fills it again. Torques are in per mille of the rated one.
    """

    def __init__(self, peak: float, overload_s: float) -> None:
        self.peak = peak
        self._budget = max(0.0, peak**2 - _RATED_SQUARED) * overload_s
        self._used = 0.0

    @property
    def idle(self) -> bool:
        """Whether nothing of the budget is used."""
        return self._used == 0.0

    @property
    def warning(self) -> bool:
        """Whether four fifths of it are used up."""
        return self._used > 0.8 * self._budget

    def reset(self) -> None:
        """The motor is cold."""
        self._used = 0.0

    def limit(self, duration_s: float) -> int:
        """Return the largest torque that the budget covers for ``duration_s`` seconds."""
        left = (self._budget - self._used) / duration_s
        return math.floor(min(self.peak, math.sqrt(_RATED_SQUARED + max(0.0, left)) + 1e-9))

    def load(self, torque: int, duration_s: float) -> None:
        """Reckon with a torque that lasts for ``duration_s`` seconds."""
        used = self._used + (torque**2 - _RATED_SQUARED) * duration_s
        self._used = max(0.0, used)
