"""What motor, power stage and wiring are like: what no object of the dictionary says."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Hardware:
    """One installation.

    counts_per_rad: encoder increments per radian of the shaft with the handle.
    gear_ratio: revolutions of the motor per revolution of that shaft (0x6091).
    inertia_kg_m2: of drive and handle at that shaft; the velocity controller is tuned to it.
    peak_torque_nm: motor torque that the current limit allows; None: three times rated torque.
    overload_s: how long the I²t monitoring lets the peak torque pass before it falls back to
        rated torque [s].
    dc_link_v: voltage of the DC link [V].
    negative_limit, positive_limit: where the limit switches close, None: there are none; and
    home: between which positions the home switch is closed. In increments of the encoder.
    """

    counts_per_rad: float = 131072 / (2.0 * math.pi)
    gear_ratio: float = 1.0
    inertia_kg_m2: float = 1.0e-4
    peak_torque_nm: float | None = None
    overload_s: float = 3.0
    dc_link_v: float = 48.0
    negative_limit: float | None = None
    positive_limit: float | None = None
    home: tuple[float, float] | None = None
