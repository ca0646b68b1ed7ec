"""From target torque to motor torque: limits, units, display."""

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.simdrive.communication.dictionary import Dictionary
from canwall.simdrive.profile.hardware import Hardware
from canwall.simdrive.profile.inputs import NEGATIVE_LIMIT, POSITIVE_LIMIT
from canwall.simdrive.profile.overload import Overload, covered
from canwall.simdrive.state import (
    CURRENT,
    MAX_CURRENT,
    MAX_TORQUE,
    RATED_TORQUE,
    TORQUE,
    TORQUE_DEMAND,
    DriveRecord,
)
from canwall.simdrive.state import NEGATIVE_LIMIT as NEGATIVE_TORQUE_LIMIT
from canwall.simdrive.state import POSITIVE_LIMIT as POSITIVE_TORQUE_LIMIT

_NO_LIMIT = 1 << 31
_RATED = 1000
_PEAK = 3000.0
"""Peak torque in per mille of the rated one, where the hardware does not say."""
_LARGEST = 0x7FFF
"""Limit of an INTEGER16, which torques are on the bus."""


@compiled
def nm_per_mille(drives: NDArray[np.void]) -> float:
    """Return one unit of torque on the bus, at the shaft and in the motor's direction [N·m]."""
    drive: Record = drives[0]
    scale = drive.values[RATED_TORQUE] * drive.nm_per_rated * drive.gear_ratio
    return scale * drive.torque_sign


@compiled
def demanded_nm(drives: NDArray[np.void]) -> float:
    """Return the torque demanded of the motor, at the shaft and in its direction [N·m]."""
    return drives[0].values[TORQUE_DEMAND] * nm_per_mille(drives)


@compiled
def limited(drives: NDArray[np.void], used: float, wanted: int) -> int:
    """Return the torque wanted within all limits, `used` of the I²t budget being used."""
    drive: Record = drives[0]
    values = drive.values
    limit = min(values[MAX_TORQUE], values[MAX_CURRENT], int(drive.peak))
    highest = min(limit, values[POSITIVE_TORQUE_LIMIT])
    lowest = -min(limit, values[NEGATIVE_TORQUE_LIMIT])
    # A limit switch lets the axis go away from it only.
    closed = drive.inputs
    if closed & (NEGATIVE_LIMIT if drive.torque_sign > 0 else POSITIVE_LIMIT):
        lowest = max(lowest, 0)
    if closed & (POSITIVE_LIMIT if drive.torque_sign > 0 else NEGATIVE_LIMIT):
        highest = min(highest, 0)
    torque = max(lowest, min(highest, wanted))
    if not -_RATED <= torque <= _RATED:
        most = covered(drives, used)
        torque = max(-most, min(most, torque))
    return torque


@compiled
def show_torque(drives: NDArray[np.void], torque_nm: float) -> None:
    """Show a torque that is not the one demanded, in 0x6077 and 0x6078."""
    values = drives[0].values
    scale = nm_per_mille(drives)
    shown = int(np.rint(torque_nm / scale)) if scale != 0.0 else 0
    values[TORQUE] = values[CURRENT] = max(-_LARGEST, min(_LARGEST, shown))


class TorquePath:
    """Torque in per mille of the rated one (0x6076), as the bus counts it.

    The current is proportional to the torque and the rated current belongs to the rated torque,
    so 0x6073 and 0x6078 (per mille of 0x6075) are the same numbers.
    """

    def __init__(self, dictionary: Dictionary, state: DriveRecord, hardware: Hardware) -> None:
        """Serve 0x6072 to 0x6074, 0x6076 to 0x6078, 0x60E0 and 0x60E1 of the dictionary.

        Raises:
            DictionaryError: one of them is not an integer.
        """
        self._record, self._state = state.record, state.fields
        number = dictionary.number
        self._max_torque = number(0x6072, absent=_NO_LIMIT)
        self._max_current = number(0x6073, absent=_NO_LIMIT)
        for index in (0x60E0, 0x60E1):
            number(index, absent=_NO_LIMIT)
        self._demand = number(0x6074, absent=0)
        self._actual = number(0x6077, absent=0)
        self._current = number(0x6078, absent=0)
        self._rated = number(0x6076, absent=0)
        self._rated.react = lambda _: self._set_peak()
        rated_nm = self._rated.default * hardware.rated_torque_unit_nm
        peak = hardware.peak_torque_nm
        self._peak = 1e3 * peak / rated_nm if peak and rated_nm else _PEAK
        self.overload = Overload(state, hardware.overload_s)
        self.reset()
        self._state.gear_ratio = hardware.gear_ratio
        self._state.nm_per_rated = hardware.rated_torque_unit_nm / 1e3
        self._state.held = 0
        self._state.limited = False

    def reset(self) -> None:
        """Begin with a cold motor and the rated torque as it stands."""
        self._set_peak()
        self.overload.reset()

    def _set_peak(self) -> None:
        # What the hardware can do stays the same when the bus changes the unit (0x6076).
        power_on, rated = self._rated.default, self._rated.value
        scale = power_on / rated if power_on and rated else 1.0
        self.overload.set_peak(min(self._peak * scale, _LARGEST))

    @property
    def limited(self) -> bool:
        """True if a limit reduces the torque."""
        return bool(self._state.limited)

    @property
    def torque_nm(self) -> float:
        """Torque demanded of the motor, at the shaft and in the motor's direction, in N m."""
        return demanded_nm(self._record)

    @property
    def largest_nm(self) -> float:
        """Limit of both directions in the coming period, at the shaft, in N m."""
        limit = min(self._max_torque.value, self._max_current.value, self.overload.limit)
        largest: float = limit * abs(nm_per_mille(self._record))
        return largest

    def off(self) -> None:
        """Demand no torque from now on."""
        self._show(0)
        self._state.limited = False

    def pass_time(self, passed_s: float) -> None:
        """Account for the torque that has held for ``passed_s`` seconds (I²t)."""
        self.overload.pass_time(passed_s)
        self._state.held = self._demand.value

    def give(self, wanted: int) -> None:
        """Demand a torque from now on, within all limits."""
        actual = limited(self._record, self._state.used, wanted)
        self._state.held = actual
        self._show(actual)
        self._state.limited = actual != wanted

    def brake(self, torque_nm: float) -> None:
        """Demand a torque that is within ``largest_nm``; no other limit holds for a brake."""
        scale = nm_per_mille(self._record)
        self._state.held = round(torque_nm / scale) if scale else 0
        self._show(self._state.held)
        self._state.limited = abs(torque_nm) >= self.largest_nm

    def show_actual(self, torque_nm: float) -> None:
        """Let 0x6077 and 0x6078 show a torque that is not the one demanded."""
        show_torque(self._record, torque_nm)

    def _show(self, demand: int) -> None:
        self._demand.value = self._actual.value = self._current.value = demand
