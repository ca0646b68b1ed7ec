"""From the torque that is wanted to the one that the motor gives: limits, units, display."""

from canwall.simdrive.communication.dictionary import Dictionary
from canwall.simdrive.profile.feedback import Feedback
from canwall.simdrive.profile.hardware import Hardware
from canwall.simdrive.profile.inputs import NEGATIVE_LIMIT, POSITIVE_LIMIT, DigitalInputs
from canwall.simdrive.profile.overload import Overload

_NO_LIMIT = 1 << 31
_PER_MILLE_MILLI = 1e-6
"""Per mille of a rated torque in mN m, to N m."""
_PEAK = 3000.0
"""Peak torque in per mille of the rated one, where the hardware does not say."""


class TorquePath:
    """Torque in per mille of the rated one (0x6076), as the bus counts it.

    The current is proportional to the torque and the rated current belongs to the rated torque,
    so 0x6073 and 0x6078 (per mille of 0x6075) are the same numbers.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        hardware: Hardware,
        feedback: Feedback,
        inputs: DigitalInputs,
        period_s: float,
    ) -> None:
        """Serve 0x6072 to 0x6074, 0x6076 to 0x6078, 0x60E0 and 0x60E1 of the dictionary.

        Raises:
            DictionaryError: one of them is not an integer.
        """
        self._feedback = feedback
        self._inputs = inputs
        self._gear_ratio = hardware.gear_ratio
        number = dictionary.number
        self._max_torque = number(0x6072, absent=_NO_LIMIT)
        self._max_current = number(0x6073, absent=_NO_LIMIT)
        self._positive_limit = number(0x60E0, absent=_NO_LIMIT)
        self._negative_limit = number(0x60E1, absent=_NO_LIMIT)
        self._rated = number(0x6076, absent=0)
        self._demand = number(0x6074, absent=0)
        self._actual = number(0x6077, absent=0)
        self._current = number(0x6078, absent=0)
        rated_nm = self._rated.value * 1e-3
        peak = hardware.peak_torque_nm
        per_mille = 1e3 * peak / rated_nm if peak and rated_nm else _PEAK
        self.overload = Overload(per_mille, hardware.overload_s)
        self._peak = int(per_mille)
        self._period_s = period_s
        self._held = 0
        self.limited = False
        """Whether the motor has less than was wanted."""

    @property
    def torque_nm(self) -> float:
        """Torque demanded of the motor, at the shaft and in the motor's direction, in N m."""
        torque: float = self._demand.value * self._nm_per_mille
        return torque

    @property
    def largest_nm(self) -> float:
        """Limit of both directions in the coming period, at the shaft, in N m."""
        limit = min(self._max_torque.value, self._max_current.value)
        largest: float = min(limit, self.overload.limit(self._period_s)) * abs(self._nm_per_mille)
        return largest

    @property
    def _nm_per_mille(self) -> float:
        """Torque at the shaft, in N m and in the motor's direction, per unit of the bus."""
        scale: float = self._rated.value * _PER_MILLE_MILLI * self._gear_ratio
        return scale * self._feedback.torque_sign

    def off(self) -> None:
        """Take the torque away at once."""
        self._show(0)
        self.limited = False

    def pass_time(self, passed_s: float) -> None:
        """Reckon with the torque that has held for ``passed_s`` seconds (I²t)."""
        if not (-1000 <= self._held <= 1000 and self.overload.idle):
            self.overload.load(self._held, passed_s)
        self._held = self._demand.value

    def give(self, wanted: int) -> None:
        """Demand the torque wanted from now on, within all limits."""
        limit = min(self._max_torque.value, self._max_current.value, self._peak)
        highest = min(limit, self._positive_limit.value)
        lowest = -min(limit, self._negative_limit.value)
        if self._inputs.at_limit:
            lowest, highest = self._away_from_the_switch(lowest, highest)
        actual = max(lowest, min(highest, wanted))
        if not -1000 <= actual <= 1000:
            covered = self.overload.limit(self._period_s)
            actual = max(-covered, min(covered, actual))
        self._held = actual
        self._show(actual)
        self.limited = actual != wanted

    def brake(self, torque_nm: float) -> None:
        """Demand a torque that is within ``largest_nm``; no other limit keeps a brake away."""
        scale = self._nm_per_mille
        self._held = round(torque_nm / scale) if scale else 0
        self._show(self._held)
        self.limited = abs(torque_nm) >= self.largest_nm

    def show_actual(self, torque_nm: float) -> None:
        """Let 0x6077 and 0x6078 show a torque that is not the one demanded."""
        scale = self._nm_per_mille
        self._actual.value = self._current.value = round(torque_nm / scale) if scale else 0

    def _away_from_the_switch(self, lowest: int, highest: int) -> tuple[int, int]:
        closed = self._inputs.closed
        positive, negative = closed & POSITIVE_LIMIT, closed & NEGATIVE_LIMIT
        if self._feedback.torque_sign < 0:
            positive, negative = negative, positive
        return max(lowest, 0) if negative else lowest, min(highest, 0) if positive else highest

    def _show(self, demand: int) -> None:
        self._demand.value = self._actual.value = self._current.value = demand
