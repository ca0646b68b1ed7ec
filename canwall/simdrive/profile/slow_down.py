"""Slowing down: the drive's own velocity controller brings the motion to a standstill.

In the torque modes the master gives the torque, so to stop the drive has to brake by itself:
Nanotec's and ESTUN's manuals have the axis decelerate until its velocity is 0 in profile torque
mode as well (statusword bit 10 in halt), Lenze's i950 brakes its quick stop in cyclic synchronous
torque with 0x6072 and 0x6073 as its limits and without 0x60E0 and 0x60E1, Elmo's Maestro brakes at
the current limit in torque mode. So a ramp here is one of the velocity. A dictionary that has no
deceleration (0x6084, 0x6085), or zero, leaves the motor free.
"""

import math

from canwall.simdrive.communication.dictionary import Dictionary
from canwall.simdrive.profile.feedback import Feedback
from canwall.simdrive.profile.hardware import Hardware
from canwall.simdrive.profile.option_codes import Ramp

STANDSTILL_RAD_S = 2.0 * math.pi / 60.0
"""Standstill: less than one revolution per minute."""

_GIVES_UP_S = 5.0
# A load beyond the limits of the drive must not keep it in its slow-down forever. Beckhoff's
# AX2000, for example, disables after 5 s (STOPMODE).

_GAIN = 0.5
"""Part of a velocity error that is corrected within one period."""

_RESET_PERIODS = 20.0
"""Integral action time of the velocity controller, in periods."""


class SlowDown:
    """A ramp of the velocity to zero, and the torque that keeps the axis on it."""

    def __init__(
        self,
        dictionary: Dictionary,
        hardware: Hardware,
        feedback: Feedback,
        period_s: float,
    ) -> None:
        """Use 0x6084 and 0x6085 of the dictionary; the controller's period is ``period_s``.

        Raises:
            DictionaryError: one of them is not an integer.
        """
        self._feedback = feedback
        self._inertia = hardware.inertia_kg_m2
        self._deceleration = {
            Ramp.SLOW_DOWN: dictionary.number(0x6084, absent=0),
            Ramp.QUICK_STOP: dictionary.number(0x6085, absent=0),
        }
        self._period_s = period_s
        self._free = True
        self.begun = False
        """True once the controller has demanded a torque."""
        self._rate = 0.0
        self._reference = 0.0
        self._integral = 0.0
        self._standing_s = 0.0
        self.done = True
        """True if the axis has come to rest, or is not waited for."""

    @property
    def braking(self) -> bool:
        """True if a torque slows the axis down."""
        return not self._free

    def begin(self, ramp: Ramp) -> None:
        """Begin to brake from the present velocity."""
        speed = self._feedback.speed_rad_s()
        self.begun = False
        self._integral = self._standing_s = 0.0
        if ramp is Ramp.CURRENT_LIMIT:
            self._rate = self._reference = 0.0
            self._free = False
        else:
            entry = self._deceleration.get(ramp)
            self._rate = entry.value * self._feedback.rad_s_per_unit if entry else 0.0
            self._reference = speed
            self._free = self._rate == 0.0
        self.done = self._free or abs(speed) < STANDSTILL_RAD_S

    def torque_nm(self, passed_s: float, limit_nm: float) -> float:
        """Return the torque at the shaft from now on, in N m.

        Args:
            passed_s: time since the last call, in seconds; with the first call it begins.
            limit_nm: magnitude of the torque at the shaft that there is.
        """
        if not self.begun:
            self.begun, passed_s = True, 0.0
        reference = self._reference = _towards_zero(self._reference, self._rate * passed_s)
        speed = self._feedback.speed_rad_s()
        if reference == 0.0:
            self._standing_s += passed_s
            if abs(speed) < STANDSTILL_RAD_S or self._standing_s > _GIVES_UP_S:
                self.done = True
        period_s = self._period_s
        feed_forward = _towards_zero(reference, self._rate * period_s) - reference
        error = reference - speed
        change = feed_forward + _GAIN * (error + self._integral / _RESET_PERIODS)
        torque = self._inertia * change / period_s
        if abs(torque) > limit_nm:
            return math.copysign(limit_nm, torque)
        self._integral += error * passed_s / period_s
        return torque


def _towards_zero(value: float, step: float) -> float:
    return math.copysign(max(0.0, abs(value) - step), value)
