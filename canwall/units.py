"""Conversion between the units of the drive and those of the wall.

CiA 402 drives report positions in encoder increments and take torques in per mille of the rated
torque; the wall has radians and newton metres. The rounding that the bus imposes is applied only
here, so the torque that the laws assume is the torque on the bus.
"""

import math
from dataclasses import dataclass

from canwall.compiled import compiled

#: 0x6071 and 0x6077 are INTEGER16.
MAX_PER_MILLE = 32767


@dataclass(frozen=True)
class DriveUnits:
    """Scales of one drive.

    Attributes:
        counts_per_rev: Increments of 0x6064 per revolution of the shaft that carries the handle.
        rated_torque_nm: Torque at that shaft for 1000 in 0x6071 [N·m].

    Raises:
        ValueError: Unless both are finite and positive.
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
        """Return the scales at the shaft behind a gear.

        Args:
            counts_per_motor_rev: Increments per revolution of the motor (0x608F).
            motor_rated_torque_nm: Rated torque of the motor (0x6076) [N·m].
            gear_ratio: Revolutions of the motor per revolution of the shaft (0x6091).
        """
        return cls(counts_per_motor_rev * gear_ratio, motor_rated_torque_nm * gear_ratio)


@compiled
def to_per_mille(torque_nm: float, nm_per_mille: float, limit_nm: float) -> int:
    """Return a torque as 0x6071 carries it: the nearest step within ±limit_nm; 0 for NaN."""
    if not math.isfinite(torque_nm):
        return 0
    # Limited before it is rounded, so that a torque beyond the range of an integer keeps its sign.
    largest = math.floor(min(limit_nm / nm_per_mille + 1e-9, float(MAX_PER_MILLE)))
    steps = min(max(torque_nm / nm_per_mille, -float(largest)), float(largest))
    return math.floor(steps + 0.5)
