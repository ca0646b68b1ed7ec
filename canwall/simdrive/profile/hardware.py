"""Motor, power stage and wiring: the properties that no object of the dictionary has."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Hardware:
    """One installation.

    Attributes:
        counts_per_rad: encoder increments per radian of the shaft with the handle.
        gear_ratio: revolutions of the motor per revolution of that shaft (0x6091).
        rated_torque_unit_nm: unit of 0x6076 [N·m].
        inertia_kg_m2: of drive and handle at that shaft; the velocity controller is tuned to it.
        peak_torque_nm: motor torque that the current limit allows; None: three times the rated one.
        overload_s: time that the I²t monitoring allows the peak torque [s].
        dc_link_v: voltage of the DC link [V].
        negative_limit: position where the limit switch closes [increments]; None: there is none.
        positive_limit: likewise.
        home: positions between which the home switch is closed [increments]; None: there is none.
    """

    counts_per_rad: float = 131072 / (2.0 * math.pi)
    gear_ratio: float = 1.0
    rated_torque_unit_nm: float = 1e-3
    inertia_kg_m2: float = 1.0e-4
    peak_torque_nm: float | None = None
    overload_s: float = 3.0
    dc_link_v: float = 48.0
    negative_limit: float | None = None
    positive_limit: float | None = None
    home: tuple[float, float] | None = None
