"""Motor, encoder and the hand on the handle: what the simulated drive moves and measures."""

import math

from canwall.config import Simulation
from canwall.physics import advance, make_plant
from canwall.simdrive.hand import hand_force


def hand_plant(simulation: Simulation) -> dict[str, float]:
    """What moves, as keywords of `physics.make_plant`: drive, handle and hand as one."""
    hand = simulation.hand
    return {
        "mass": simulation.inertia_kg_m2 + hand.inertia_kg_m2,
        "viscous": simulation.viscous_nm_s_per_rad + hand.damping_nm_s_per_rad,
        "spring": hand.stiffness_nm_per_rad,
        "coulomb": simulation.coulomb_nm,
    }


class ServoMotion:
    """Motor, handle and hand, advanced by the drive one SYNC period at a time.

    The hand starts at rest where its script does, and the handle with it. The script is laid out
    in pieces as time goes on; after its last strike the hand rests.
    """

    _PIECE = 4096

    def __init__(self, simulation: Simulation, period_s: float, counts_per_rev: float) -> None:
        self._simulation = simulation
        self._period_s = period_s
        self._counts_per_rad = counts_per_rev / (2.0 * math.pi)
        self._plant = make_plant(**hand_plant(simulation))[0]
        self._elapsed = 0
        self.position_rad = simulation.hand.rest_rad
        self.speed_rad_s = 0.0
        self._lay_out(self._PIECE)

    def _lay_out(self, periods: int) -> None:
        constant, slope = hand_force(self._simulation.hand, self._period_s, periods)
        self._constant, self._slope = constant.tolist(), slope.tolist()

    def counts(self) -> int:
        """Encoder position [increments], the nearest one."""
        return math.floor(self.position_rad * self._counts_per_rad + 0.5)

    def speed_counts_per_s(self) -> float:
        """Speed in increments per second, as 0x606C gives it."""
        return self.speed_rad_s * self._counts_per_rad

    def advance(self, torque_nm: float, duration_s: float) -> None:
        """One period of the script under a held torque."""
        if self._elapsed >= len(self._constant):
            self._lay_out(2 * len(self._constant))
        self.position_rad, self.speed_rad_s, _ = advance(
            self._plant,
            self.position_rad,
            self.speed_rad_s,
            torque_nm + self._constant[self._elapsed],
            self._slope[self._elapsed],
            duration_s,
        )
        self._elapsed += 1
