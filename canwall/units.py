"""Counts and per mille of the drive ↔ radians and newton metres of the wall: the one place.

CiA 402 drives give positions in encoder increments and take torque in per mille of the rated
torque. Both scales stand in the drive's own objects; what rounding the bus imposes is applied
here and nowhere else, so the torque that the laws reckon with is the torque that the bus carries.
"""

import math
from dataclasses import dataclass

from canwall.compiled import compiled

#: 0x6071 and 0x6077 are INTEGER16.
MAX_PER_MILLE = 32767


@dataclass(frozen=True)
class DriveUnits:
    """Scales of one drive.

    counts_per_rev: increments of 0x6064 per revolution of the shaft that carries the handle.
    rated_torque_nm: torque at that shaft which 1000 of 0x6071 stands for.
    Raises ValueError unless both are finite and positive.
    """

    counts_per_rev: float
    rated_torque_nm: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} has to be positive, not {value}")

    @property
    def rad_per_count(self) -> float:
        """Size of one encoder count Δ [rad]."""
        return 2.0 * math.pi / self.counts_per_rev

    @property
    def nm_per_mille(self) -> float:
        """Size of one step of torque f_LSB [N·m]."""
        return self.rated_torque_nm / 1000.0

    @classmethod
    def behind_gear(
        cls, counts_per_motor_rev: float, motor_rated_torque_nm: float, gear_ratio: float
    ) -> "DriveUnits":
        """From the motor's scales (0x608F, 0x6076) and its turns per turn of the shaft (0x6091).

        The encoder and the rated torque are the motor's; the handle is behind the gear.
        """
        return cls(counts_per_motor_rev * gear_ratio, motor_rated_torque_nm * gear_ratio)


@compiled
def to_per_mille(torque_nm: float, nm_per_mille: float, limit_nm: float) -> int:
    """Torque as 0x6071 carries it: nearest step, none beyond ±limit, INTEGER16. NaN becomes 0."""
    if not math.isfinite(torque_nm):
        return 0
    # Limited before it is rounded: a torque far beyond what an integer holds keeps its sign.
    largest = math.floor(min(limit_nm / nm_per_mille + 1e-9, float(MAX_PER_MILLE)))
    steps = min(max(torque_nm / nm_per_mille, -float(largest)), float(largest))
    return math.floor(steps + 0.5)
