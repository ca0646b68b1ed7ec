"""Motor, encoder and the hand on the handle: what the simulated drive moves and measures."""

import math

from canwall.config import Simulation
from canwall.physics import Force, Grasp, advance, advance_grasp, make_plant
from canwall.physics import Hand as Body
from canwall.simdrive.hand import hand_force

_REACHED = 1.0 - 1e-9
"""Share of a period after which it is over: its parts may miss the whole by a rounding."""


def handle_plant(simulation: Simulation) -> dict[str, float]:
    """The handle without the hand, as keywords of `physics.make_plant`: rotor and what turns."""
    return {
        "mass": simulation.inertia_kg_m2,
        "viscous": simulation.viscous_nm_s_per_rad,
        "coulomb": simulation.coulomb_nm,
        "cogging": simulation.cogging_nm,
        "cog_pitch": 2.0 * math.pi / simulation.cogs_per_rev,
    }


def hand_plant(simulation: Simulation) -> dict[str, float]:
    """What moves, as keywords of `physics.make_plant`: drive, handle and hand as one."""
    hand, handle = simulation.hand, handle_plant(simulation)
    return handle | {
        "mass": handle["mass"] + hand.inertia_kg_m2,
        "viscous": handle["viscous"] + hand.damping_nm_s_per_rad,
        "spring": hand.stiffness_nm_per_rad,
    }


def hand_body(simulation: Simulation) -> Body:
    """The hand as a body of its own, for a hand that can lose the handle."""
    hand = simulation.hand
    return Body(hand.inertia_kg_m2, hand.damping_nm_s_per_rad, hand.stiffness_nm_per_rad, hand.side)


class ServoMotion:
    """Motor, handle and hand, advanced by the drive as time passes for it.

    The hand starts at rest where its script does, and the handle with it. The script is laid out
    in pieces as time goes on; after its last move the hand rests. It is a function of time:
    however a period is divided, the hand is at the same place at its end.
    """

    _PIECE = 4096

    def __init__(self, simulation: Simulation, period_s: float, counts_per_rev: float) -> None:
        self._simulation = simulation
        self._period_s = period_s
        self._counts_per_rad = counts_per_rev / (2.0 * math.pi)
        self._joined = make_plant(**hand_plant(simulation))[0]
        self._handle = make_plant(**handle_plant(simulation))[0]
        self._hand = hand_body(simulation)
        bandwidth = simulation.current_bandwidth_hz
        self._lag_rate = 2.0 * math.pi * bandwidth if bandwidth else 0.0
        self._torque_nm = 0.0
        filtered = simulation.velocity_filter_hz
        self._smoothing = -math.expm1(-2.0 * math.pi * filtered * period_s) if filtered else 1.0
        self._elapsed = 0
        self._share_s = 0.0
        rest = simulation.hand.rest_rad
        self._grasp = Grasp(rest, 0.0, rest, 0.0, True)
        self._counts_before = self.counts()
        self._speed_counts_per_s = 0.0
        self._lay_out()

    def _lay_out(self) -> None:
        """Lay out the next piece; what is over is forgotten, however long the drive lives."""
        self._first = self._elapsed
        hand = self._simulation.hand
        constant, slope = hand_force(hand, self._period_s, self._PIECE, self._first)
        self._constant, self._slope = constant.tolist(), slope.tolist()

    @property
    def position_rad(self) -> float:
        """Where the handle is."""
        return self._grasp.y

    @property
    def speed_rad_s(self) -> float:
        """How fast the handle moves."""
        return self._grasp.v

    @property
    def touching(self) -> bool:
        """Whether the hand is at the handle."""
        return self._grasp.touching

    def counts(self) -> int:
        """Encoder position [increments], the nearest one."""
        return math.floor(self._grasp.y * self._counts_per_rad + 0.5)

    def speed_counts_per_s(self) -> float:
        """Velocity in increments per second, as the drive computes it.

        The difference of the encoder over the last SYNC period, through a low-pass filter of
        first order (`velocity_filter_hz`).
        """
        return self._speed_counts_per_s

    def torque_nm(self) -> float | None:
        """Torque that the current loop delivers now [N·m]; None where it follows at once."""
        return self._torque_nm if self._lag_rate else None

    def advance(self, torque_nm: float, duration_s: float) -> None:
        """Move on by any time under a torque that is demanded meanwhile."""
        step = self._simulation.torque_step_nm
        demand = round(torque_nm / step) * step if step else torque_nm
        left_s = duration_s
        while left_s > 0.0:
            rest_s = self._period_s - self._share_s
            # What is over to the last bits is over: no sliver of a period is left to follow.
            if left_s < rest_s * _REACHED:
                self._move(demand, left_s)
                self._share_s += left_s
                return
            self._move(demand, min(left_s, rest_s))
            left_s -= rest_s
            self._share_s = 0.0
            self._elapsed += 1
            self._measure_speed()
            if left_s < self._period_s * (1.0 - _REACHED):
                return

    def _move(self, demand_nm: float, duration_s: float) -> None:
        """Move on within a period of the script."""
        if self._elapsed - self._first >= self._PIECE:
            self._lay_out()
        slope = self._slope[self._elapsed - self._first]
        push = self._constant[self._elapsed - self._first]
        if self._share_s:
            push += slope * self._share_s
        rate = self._lag_rate
        start = self._torque_nm if rate else demand_nm
        excess = start - demand_nm
        if self._simulation.hand.grip:
            y, v = self._grasp.y, self._grasp.v
            if excess:
                y, v, _ = advance(self._joined, y, v, start + push, slope, duration_s, excess, rate)
            else:
                y, v, _ = advance(self._joined, y, v, start + push, slope, duration_s)
            self._grasp = Grasp(y, v, y, v, True)
        else:
            motor, script = Force(start, 0.0, excess, rate), Force(push, slope, 0.0, 0.0)
            now = advance_grasp(
                self._handle, self._joined, self._hand, self._grasp, motor, script, duration_s
            )
            self._grasp = Grasp(*now)
        self._torque_nm = demand_nm + (excess * math.exp(-rate * duration_s) if excess else 0.0)

    def _measure_speed(self) -> None:
        counts = self.counts()
        quotient = (counts - self._counts_before) / self._period_s
        self._counts_before = counts
        self._speed_counts_per_s += self._smoothing * (quotient - self._speed_counts_per_s)
