"""The unit of 0x6064: encoder increments, or another by the factor group.

Position = increments × feed constant / (encoder resolution × gear ratio) (CiA 402-2), where the
feed constant is 0x6092, or follows from a unit of angle in 0x60A8.
"""

import math
from collections.abc import Callable

from canwall.simdrive.communication.dictionary import Dictionary, Entry
from canwall.simdrive.state import DriveRecord

#: Codes of 0x60A8 in bits 16 to 23 (CiA 303-2): units per revolution. All others: increments.
_ANGLES = {0x10: 2.0 * math.pi, 0x41: 360.0, 0xB4: 1.0}

_RESOLUTION, _GEAR, _FEED = 0x608F, 0x6091, 0x6092


def quotient(dictionary: Dictionary, index: int) -> float:
    """Return numerator over denominator of a pair of entries; 1 where there is none.

    Raises:
        DictionaryError: it is no scale.
    """
    numerator, denominator = _pair(dictionary, index)
    if numerator.value <= 0 or denominator.value <= 0:
        raise dictionary.error(index, 1, f"{numerator.value}/{denominator.value} is no scale")
    return float(numerator.value / denominator.value)


def _pair(dictionary: Dictionary, index: int) -> tuple[Entry, Entry]:
    return (
        dictionary.number(index, 1, absent=1),
        dictionary.number(index, 2, absent=1),
    )


class PositionUnit:
    """Serves the factor group. A drive with an encoder of 1/1 shows increments."""

    def __init__(
        self,
        dictionary: Dictionary,
        state: DriveRecord,
        changed: Callable[[], None] = lambda: None,
    ) -> None:
        """Serve the objects of the dictionary; begin with increments. Writes call changed."""
        self._changed = changed
        self._state = state.fields
        self._state.position_scale = 1.0
        self._resolution, self._gear, self._feed = (
            _pair(dictionary, index) for index in (_RESOLUTION, _GEAR, _FEED)
        )
        self._si_unit = dictionary.number(0x60A8, absent=0)
        for entry in (*self._resolution, *self._gear, *self._feed):
            entry.react = self._react
        self._si_unit.react = self._react

    @property
    def per_increment(self) -> float:
        """Units per increment."""
        return float(self._state.position_scale)

    def refresh(self) -> None:
        """Take the entries as they stand."""
        self._state.position_scale = 1.0
        resolution = _ratio(self._resolution) * _ratio(self._gear)
        if _ratio(self._resolution) == 1.0:
            return
        unit = self._si_unit.value
        angle = _ANGLES.get(unit >> 16 & 0xFF)
        if angle is not None:
            exponent = int.from_bytes([unit >> 24 & 0xFF], signed=True)
            self._state.position_scale = angle / 10.0**exponent / resolution
        elif _ratio(self._feed) != 1.0:
            self._state.position_scale = _ratio(self._feed) / resolution

    def _react(self, _: int) -> None:
        self.refresh()
        self._changed()


def _ratio(pair: tuple[Entry, Entry]) -> float:
    numerator, denominator = pair
    if numerator.value <= 0 or denominator.value <= 0:
        return 1.0
    return float(numerator.value / denominator.value)
