"""Position and velocity as the bus sees them: units, polarity, and where the axis was homed."""

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.simdrive.communication.abort import AbortCode, AccessError
from canwall.simdrive.communication.dictionary import Dictionary
from canwall.simdrive.profile.hardware import Hardware
from canwall.simdrive.profile.position_unit import PositionUnit
from canwall.simdrive.state import POSITION, VELOCITY, DriveRecord, signed

_INT32 = 1 << 31

POSITION_POLARITY, VELOCITY_POLARITY, TORQUE_POLARITY = 1 << 7, 1 << 6, 1 << 5
"""Bits of 0x607E. CiA 402-2 has the first two; the one for the torque is that of Mitsubishi's
MR-J5 and its like, and reserved elsewhere."""

# SI unit (0x60A9), in the codes of CiA 303-2: power of ten, numerator, denominator.
_ANGLES_RAD = {0x10: 1.0, 0x41: math.pi / 180.0, 0xB4: 2.0 * math.pi}
_INCREMENTS = 0xB5
_TIMES_S = {0x03: 1.0, 0x47: 60.0}


@compiled
def latch(drives: NDArray[np.void], counts: int, counts_per_s: float) -> None:
    """Sample position and velocity: 0x6064 and 0x606C, in the units and directions of the bus."""
    drive: Record = drives[0]
    drive.counts = counts
    position = drive.position_sign * (counts + drive.position_shift)
    if drive.position_scale != 1.0:
        scaled = np.floor(position * drive.position_scale + 0.5)
        # Whatever the scale, the bus has the low 32 bits.
        position = int(np.fmod(scaled, 2.0 * _INT32))
    drive.values[POSITION] = signed(position, 32)
    velocity = np.rint(counts_per_s * drive.velocity_scale)
    drive.values[VELOCITY] = int(max(-float(_INT32), min(_INT32 - 1.0, velocity)))


class Motion(Protocol):
    """Motor, encoder and hand, as the drive sees them."""

    def counts(self) -> int:
        """Return the encoder position that is known, in increments; the bus has its low 32 bits."""
        ...

    def speed_counts_per_s(self) -> float:
        """Return the velocity in increments per second."""
        ...

    def torque_nm(self) -> float | None:
        """Return the torque that the drive believes to deliver; None if it follows at once."""
        ...

    def advance(self, torque_nm: float, duration_s: float) -> None:
        """Move on by ``duration_s`` under a motor torque that is demanded meanwhile."""
        ...


class Feedback:
    """Latches the measured values into 0x6064 and 0x606C."""

    def __init__(
        self, dictionary: Dictionary, state: DriveRecord, hardware: Hardware, motion: Motion
    ) -> None:
        """Serve 0x6064, 0x606C, 0x607E, 0x60A9 and the factor group of the dictionary.

        Raises:
            DictionaryError: one of them is not an integer, or 0x60A9 begins with no unit of
                velocity that is known.
        """
        self._motion = motion
        self._counts_per_rad = hardware.counts_per_rad
        self._record, self._state = state.record, state.fields
        for index in (0x6064, 0x606C):
            dictionary.number(index, absent=0)
        self._polarity = dictionary.number(0x607E, absent=0)
        self._unit = dictionary.number(0x60A9, absent=0)
        self._unit.check = self._check_unit
        self._position_unit = PositionUnit(dictionary, state, self._latch_again)
        self._polarity.react = self._unit.react = self._react
        self._state.position_shift = self._state.counts = 0
        self.rad_s_per_unit = 0.0
        """One unit of velocity at the shaft, in rad/s; accelerations are in this per second."""
        if self._rad_s(self._unit.value) is None:
            what = f"0x{self._unit.value:08X} is no unit of velocity that is known"
            raise dictionary.error(0x60A9, 0, what)
        self._settle()

    @property
    def counts(self) -> int:
        """Encoder position at the last sample, in increments."""
        return int(self._state.counts)

    def reset(self) -> None:
        """Drop the homing, and take the objects as they stand."""
        self._state.position_shift = 0
        self._position_unit.refresh()
        self._settle()
        self.sample()

    def home(self, position: int) -> None:
        """Let the present position be ``position`` (in the units of 0x6064)."""
        counts = round(position / self._position_unit.per_increment)
        self._state.position_shift = self._state.position_sign * counts - self._motion.counts()
        self.sample()

    def speed_rad_s(self) -> float:
        """Return the present velocity at the shaft, in rad/s, in the motor's direction."""
        return self._motion.speed_counts_per_s() / self._counts_per_rad

    def sample(self) -> None:
        """Latch position and velocity."""
        latch(self._record, self._motion.counts(), float(self._motion.speed_counts_per_s()))

    def _react(self, _: int) -> None:
        self._settle()
        self._latch_again()

    def _latch_again(self) -> None:
        """Show the last sample in the units and directions of now."""
        latch(self._record, self.counts, float(self._motion.speed_counts_per_s()))

    def _settle(self) -> None:
        """Follow polarity and units."""
        polarity = self._polarity.value
        state = self._state
        state.position_sign = -1 if polarity & POSITION_POLARITY else 1
        state.torque_sign = -1 if polarity & TORQUE_POLARITY else 1
        self.rad_s_per_unit = self._rad_s(self._unit.value) or 1.0 / self._counts_per_rad
        units_per_count = 1.0 / (self.rad_s_per_unit * self._counts_per_rad)
        if abs(units_per_count - 1.0) < 1e-12:
            units_per_count = 1.0
        state.velocity_scale = -units_per_count if polarity & VELOCITY_POLARITY else units_per_count

    def _rad_s(self, si_unit: int) -> float | None:
        """Return a unit of velocity in rad/s, None if it is not known; 0: increments per second."""
        if si_unit == 0:
            return 1.0 / self._counts_per_rad
        prefix = (si_unit >> 24 ^ 0x80) - 0x80
        numerator, denominator = si_unit >> 16 & 0xFF, si_unit >> 8 & 0xFF
        angle = _ANGLES_RAD.get(numerator)
        if numerator == _INCREMENTS:
            angle = 1.0 / self._counts_per_rad
        time = _TIMES_S.get(denominator)
        if angle is None or time is None or not -9 <= prefix <= 9:
            return None
        return float(10.0**prefix * angle / time)

    def _check_unit(self, si_unit: int) -> None:
        if self._rad_s(si_unit) is None:
            raise AccessError(AbortCode.INVALID_VALUE)
