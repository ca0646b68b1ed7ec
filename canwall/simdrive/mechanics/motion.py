"""Motor, encoder and the hand on the handle, as the simulated drive moves and measures them."""

import math
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from canwall.bus.raw_socket import elements
from canwall.compiled import Record, compiled, fields
from canwall.config import Simulation
from canwall.simdrive.mechanics.hand import hand_force
from canwall.simdrive.mechanics.servo import SERVO, make_servo, move_servo, shows_its_torque

_REACHED = 1.0 - 1e-9
"""Share of a period after which it is over: its parts may miss the whole by a rounding."""

_PIECE = 4096
"""Periods of the hand's script that are laid out at a time."""

#: The servo; force of the hand on it, push + slope·t in each period of a piece of its script
#: [N·m, N·m/s]; which period this is, and how much of it is over [s]; what the encoder shows.
MOTION = np.dtype(
    [
        ("servo", SERVO, (1,)),
        ("push", "f8", (_PIECE,)),
        ("slope", "f8", (_PIECE,)),
        ("first", "i8"),  # period with which the piece begins
        ("elapsed", "i8"),
        ("share", "f8"),
        ("period", "f8"),
        ("smoothing", "f8"),
        ("counts", "i8"),
        ("counts_before", "i8"),
        ("counts_per_s", "f8"),
    ],
    align=True,
)


@compiled
def has_script(motions: NDArray[np.void]) -> bool:
    """Return True if the piece of the script contains the present period."""
    motion: Record = motions[0]
    return motion.elapsed - motion.first < _PIECE


@compiled
def advance_motion(motions: NDArray[np.void], torque: float, duration: float) -> float:
    """Move on under a torque that is demanded meanwhile [N·m], for `duration` [s].

    motions has dtype MOTION and shape (1,). Returns the time that is left where the piece of the
    script ends, else 0. The velocity is the difference of the encoder over a period, through a
    low-pass filter of first order.
    """
    motion: Record = motions[0]
    while duration > 0.0:
        if not has_script(motions):
            return duration
        rest = motion.period - motion.share
        # A period that is over but for rounding is over, so that no tiny rest of it remains.
        over = duration >= rest * _REACHED
        moved = min(duration, rest) if over else duration
        k = motion.elapsed - motion.first
        slope = motion.slope[k]
        push = motion.push[k] + slope * motion.share if motion.share > 0.0 else motion.push[k]
        servos = elements(motion.servo.ctypes.data, 1, SERVO)
        motion.counts = move_servo(servos, torque, push, slope, moved)
        if not over:
            motion.share += moved
            break
        duration -= rest
        motion.share = 0.0
        motion.elapsed += 1
        quotient = (motion.counts - motion.counts_before) / motion.period
        motion.counts_before = motion.counts
        motion.counts_per_s += motion.smoothing * (quotient - motion.counts_per_s)
        if duration < motion.period * (1.0 - _REACHED):
            break
    return 0.0


@runtime_checkable
class RecordedMotion(Protocol):
    """A motion that compiled code can move on."""

    @property
    def record(self) -> NDArray[np.void] | None:
        """Complete state, shape (1,), dtype MOTION; None if a record cannot hold it."""
        ...


class ServoMotion:
    """Motor, handle and hand, advanced by the drive as time passes for it.

    The hand starts at rest where its script does, and the handle with it. The script is laid out
    in pieces as time goes on; after its last move the hand rests. It is a function of time:
    however a period is divided, the hand is at the same place at its end.
    """

    def __init__(self, simulation: Simulation, period_s: float, counts_per_rev: float) -> None:
        self._hand = simulation.hand
        self._period_s = period_s
        self._motion = np.zeros(1, MOTION)
        self._motion["servo"][0] = make_servo(simulation, counts_per_rev)
        self._fields: Record = fields(self._motion)
        self._servo: Record = self._fields.servo[0]
        filtered = simulation.velocity_filter_hz
        smoothing = -math.expm1(-2.0 * math.pi * filtered * period_s) if filtered else 1.0
        self._fields.period, self._fields.smoothing = period_s, smoothing
        self._shows_its_torque = bool(shows_its_torque(self._motion["servo"][0]))
        self._fields.counts = self._fields.counts_before = self._servo.latched_counts
        self._lay_out()

    def _lay_out(self) -> None:
        """Lay out the next piece and drop the previous one, so that memory stays bounded."""
        first = self._fields.first = self._fields.elapsed
        script = hand_force(self._hand, self._period_s, _PIECE, first)
        self._motion["push"][0], self._motion["slope"][0] = script

    @property
    def record(self) -> NDArray[np.void]:
        """Complete state as a record, shape (1,), dtype MOTION."""
        return self._motion

    @property
    def position_rad(self) -> float:
        """Position of the handle."""
        return float(self._servo.y)

    @property
    def speed_rad_s(self) -> float:
        """Velocity of the handle."""
        return float(self._servo.v)

    @property
    def touching(self) -> bool:
        """True while the hand is at the handle."""
        return bool(self._servo.touching)

    def counts(self) -> int:
        """Return the encoder position that the drive knows [increments]."""
        return int(self._fields.counts)

    def speed_counts_per_s(self) -> float:
        """Return the velocity as the drive computes it [increments/s].

        The difference of the encoder over the last SYNC period, through a low-pass filter of
        first order (`velocity_filter_hz`).
        """
        return float(self._fields.counts_per_s)

    def torque_nm(self) -> float | None:
        """Return the torque that the drive believes to deliver; None where it follows at once.

        That of now, or with a drive cycle that of its last tick.
        """
        return float(self._servo.latched_torque) if self._shows_its_torque else None

    def advance(self, torque_nm: float, duration_s: float) -> None:
        """Move on by any time under a torque that is demanded meanwhile."""
        left_s = advance_motion(self._motion, float(torque_nm), float(duration_s))
        while left_s > 0.0:
            self._lay_out()
            left_s = advance_motion(self._motion, float(torque_nm), left_s)
