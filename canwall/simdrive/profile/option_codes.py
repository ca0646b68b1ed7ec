"""Option codes (CiA 402-2; IEC 61800-7-201): how the drive slows down on its way out.

| value | 0x605A | 0x605B | 0x605C | 0x605D | 0x605E |
|---|---|---|---|---|---|
| 0 | motor free | motor free | motor free | - | motor free |
| 1 | slow down ramp | slow down ramp | slow down ramp | slow down ramp | slow down ramp |
| 2 | quick stop ramp | - | - | quick stop ramp | quick stop ramp |
| 3 | current limit | - | - | current limit | current limit |
| 5, 6, 7 | as 1, 2, 3, and stays in QUICK STOP ACTIVE | - | - | - | - |

Braking along the voltage limit (4, 8) is for drives without a current controller: it is refused.
"""

from enum import Enum, auto

from canwall.simdrive.communication.dictionary import Dictionary

QUICK_STOP, SHUTDOWN, DISABLE_OPERATION, HALT, FAULT_REACTION = range(0x605A, 0x605F)
"""Index of each option code."""


class Ramp(Enum):
    """Ways to end a motion."""

    MOTOR_FREE = auto()
    SLOW_DOWN = auto()
    QUICK_STOP = auto()
    CURRENT_LIMIT = auto()


_OFF_OR_SLOW_DOWN = {0: Ramp.MOTOR_FREE, 1: Ramp.SLOW_DOWN}
_RAMPS = {1: Ramp.SLOW_DOWN, 2: Ramp.QUICK_STOP, 3: Ramp.CURRENT_LIMIT}
_STAYING = {value + 4: ramp for value, ramp in _RAMPS.items()}
_VOLTAGE_LIMIT = (4, 8)
_SERVED = {
    QUICK_STOP: (2, {0: Ramp.MOTOR_FREE, **_RAMPS, **_STAYING}),
    SHUTDOWN: (0, _OFF_OR_SLOW_DOWN),
    DISABLE_OPERATION: (1, _OFF_OR_SLOW_DOWN),
    HALT: (1, _RAMPS),
    FAULT_REACTION: (2, {0: Ramp.MOTOR_FREE, **_RAMPS}),
}
"""The standard's default, and the ramp of each value."""


class OptionCode:
    """One of 0x605A to 0x605E.

    The power-on value may be one of the manufacturer (0x605D = 0, say): then the motor is free,
    and the value may be written back.
    """

    def __init__(self, dictionary: Dictionary, index: int) -> None:
        """Serve the object.

        Raises:
            DictionaryError: it is no integer, or begins with braking along the voltage limit.
        """
        default, self._ramps = _SERVED[index]
        self._entry = dictionary.number(index, absent=default)
        begins_with = self._entry.default
        if begins_with in _VOLTAGE_LIMIT:
            what = f"{begins_with}: braking along the voltage limit is not served; 1 to 3 are"
            raise dictionary.error(index, 0, what)
        self._entry.allow({*self._ramps, begins_with})

    @property
    def ramp(self) -> Ramp:
        """The ramp that it selects."""
        return self._ramps.get(self._entry.value, Ramp.MOTOR_FREE)

    @property
    def disables(self) -> bool:
        """True if a quick stop disables the drive function immediately (0)."""
        return bool(self._entry.value == 0)

    @property
    def stays(self) -> bool:
        """True if the drive stays in QUICK STOP ACTIVE after a quick stop (5 to 7)."""
        return self._entry.value in _STAYING
