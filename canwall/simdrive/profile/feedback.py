"""Position and velocity as the bus sees them: units, polarity, and where the axis was homed."""

import math
from typing import Protocol

from canwall.simdrive.communication.abort import AbortCode, AccessError
from canwall.simdrive.communication.dictionary import Dictionary
from canwall.simdrive.profile.hardware import Hardware
from canwall.simdrive.profile.position_unit import PositionUnit

_INT32 = 1 << 31

POSITION_POLARITY, VELOCITY_POLARITY, TORQUE_POLARITY = 1 << 7, 1 << 6, 1 << 5
"""Bits of 0x607E. CiA 402-2 has the first two; the one for the torque is that of Mitsubishi's
MR-J5 and its like, and reserved elsewhere."""

# SI unit (0x60A9), in the codes of CiA 303-2: power of ten, numerator, denominator.
_ANGLES_RAD = {0x10: 1.0, 0x41: math.pi / 180.0, 0xB4: 2.0 * math.pi}
_INCREMENTS = 0xB5
_TIMES_S = {0x03: 1.0, 0x47: 60.0}


class Motion(Protocol):
    """What motor, encoder and hand present to the drive."""

    def counts(self) -> int:
        """Return the encoder position in increments; the drive shows its low 32 bits."""
        ...

    def speed_counts_per_s(self) -> float:
        """Return the velocity in increments per second."""
        ...

    def torque_nm(self) -> float | None:
        """Return the torque that the current loop delivers now; None if it follows at once."""
        ...

    def advance(self, torque_nm: float, duration_s: float) -> None:
        """Move on by ``duration_s`` under a motor torque that is demanded meanwhile."""
        ...


class Feedback:
    """Latches the measured values into 0x6064 and 0x606C."""

    def __init__(self, dictionary: Dictionary, hardware: Hardware, motion: Motion) -> None:
        """Serve 0x6064, 0x606C, 0x607E, 0x60A9 and the factor group of the dictionary.

        Raises:
            DictionaryError: one of them is not an integer, or 0x60A9 begins with no unit of
                velocity that is known.
        """
        self._motion = motion
        self._counts_per_rad = hardware.counts_per_rad
        self._position = dictionary.number(0x6064, absent=0)
        self._velocity = dictionary.number(0x606C, absent=0)
        self._polarity = dictionary.number(0x607E, absent=0)
        self._unit = dictionary.number(0x60A9, absent=0)
        self._unit.check = self._check_unit
        self._position_unit = PositionUnit(dictionary)
        self._polarity.react = self._unit.react = lambda _: self._settle()
        self._shift = 0
        self.counts = 0
        """Encoder position at the last sample, in increments."""
        self.torque_sign = 1
        """-1 where the bus counts torque the other way round than the motor."""
        self.rad_s_per_unit = 0.0
        """One unit of velocity at the shaft, in rad/s; accelerations are in this per second."""
        if self._rad_s(self._unit.value) is None:
            what = f"0x{self._unit.value:08X} is no unit of velocity that is known"
            raise dictionary.error(0x60A9, 0, what)
        self._settle()

    def reset(self) -> None:
        """Forget the homing, and take the objects as they stand."""
        self._shift = 0
        self._position_unit.refresh()
        self._settle()
        self.sample()

    def home(self, position: int) -> None:
        """Let the present position be ``position`` (in the units of 0x6064)."""
        counts = round(position / self._position_unit.per_increment)
        self._shift = self._position_sign * counts - self._motion.counts()
        self.sample()

    def speed_rad_s(self) -> float:
        """Return the present velocity at the shaft, in rad/s, in the motor's direction."""
        return self._motion.speed_counts_per_s() / self._counts_per_rad

    def sample(self) -> None:
        """Latch position and velocity."""
        self.counts = counts = self._motion.counts()
        position = self._position_sign * (counts + self._shift)
        scale = self._position_unit.per_increment
        if scale != 1.0:
            position = math.floor(position * scale + 0.5)
        self._position.value = (position + _INT32) % (2 * _INT32) - _INT32
        speed = round(self._motion.speed_counts_per_s() * self._units_per_count)
        self._velocity.value = max(-_INT32, min(_INT32 - 1, speed))

    def _settle(self) -> None:
        """Follow polarity and units."""
        polarity = self._polarity.value
        self._position_sign = -1 if polarity & POSITION_POLARITY else 1
        self.torque_sign = -1 if polarity & TORQUE_POLARITY else 1
        self.rad_s_per_unit = self._rad_s(self._unit.value) or 1.0 / self._counts_per_rad
        units_per_count = 1.0 / (self.rad_s_per_unit * self._counts_per_rad)
        if abs(units_per_count - 1.0) < 1e-12:
            units_per_count = 1.0
        self._units_per_count = (
            -units_per_count if polarity & VELOCITY_POLARITY else units_per_count
        )

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
