"""Motor, encoder and the hand on the handle: what the simulated drive moves and measures."""

import math

from canwall.config import Simulation
from canwall.simdrive.mechanics.hand import hand_force
from canwall.simdrive.mechanics.servo import encoder_counts, make_servo, move_servo

_REACHED = 1.0 - 1e-9
"""Share of a period after which it is over: its parts may miss the whole by a rounding."""


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
        self._servo = make_servo(simulation, counts_per_rev)
        self._record = self._servo[0]
        self._lags = simulation.current_bandwidth_hz > 0.0
        filtered = simulation.velocity_filter_hz
        self._smoothing = -math.expm1(-2.0 * math.pi * filtered * period_s) if filtered else 1.0
        self._elapsed = 0
        self._share_s = 0.0
        self._counts = self._counts_before = int(encoder_counts(self._servo))
        self._speed_counts_per_s = 0.0
        self._lay_out()

    def _lay_out(self) -> None:
        """Lay out the next piece; what is over is forgotten, however long the drive lives."""
        self._first = self._elapsed
        hand = self._simulation.hand
        constant, slope = hand_force(hand, self._period_s, self._PIECE, self._first)
        self._script = constant, slope
        self._constant, self._slope = constant.tolist(), slope.tolist()

    @property
    def position_rad(self) -> float:
        """Where the handle is."""
        return float(self._record["y"])

    @property
    def speed_rad_s(self) -> float:
        """How fast the handle moves."""
        return float(self._record["v"])

    @property
    def touching(self) -> bool:
        """Whether the hand is at the handle."""
        return bool(self._record["touching"])

    def counts(self) -> int:
        """Encoder position [increments], the nearest one."""
        return self._counts

    def speed_counts_per_s(self) -> float:
        """Velocity in increments per second, as the drive computes it.

        The difference of the encoder over the last SYNC period, through a low-pass filter of
        first order (`velocity_filter_hz`).
        """
        return self._speed_counts_per_s

    def torque_nm(self) -> float | None:
        """Torque that the current loop delivers now [N·m]; None where it follows at once."""
        return float(self._record["torque"]) if self._lags else None

    def advance(self, torque_nm: float, duration_s: float) -> None:
        """Move on by any time under a torque that is demanded meanwhile."""
        left_s = duration_s
        while left_s > 0.0:
            rest_s = self._period_s - self._share_s
            # What is over to the last bits is over: no sliver of a period is left to follow.
            if left_s < rest_s * _REACHED:
                self._move(torque_nm, left_s)
                self._share_s += left_s
                return
            self._move(torque_nm, min(left_s, rest_s))
            left_s -= rest_s
            self._share_s = 0.0
            self._elapsed += 1
            self._measure_speed()
            if left_s < self._period_s * (1.0 - _REACHED):
                return

    def _move(self, torque_nm: float, duration_s: float) -> None:
        """Move on within a period of the script."""
        if self._elapsed - self._first >= self._PIECE:
            self._lay_out()
        slope = self._slope[self._elapsed - self._first]
        push = self._constant[self._elapsed - self._first]
        if self._share_s:
            push += slope * self._share_s
        self._counts = move_servo(self._servo, torque_nm, push, slope, duration_s)

    def _measure_speed(self) -> None:
        counts = self._counts
        quotient = (counts - self._counts_before) / self._period_s
        self._counts_before = counts
        self._speed_counts_per_s += self._smoothing * (quotient - self._speed_counts_per_s)
