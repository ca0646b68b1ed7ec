"""From demanded torque to motion: the part that acts, after a pure delay."""

from collections import deque

from canwall.simdrive.profile.feedback import Motion


class Actuator:
    """Moves the motion on under the demanded torque, each change of it a delay later.

    Times are in SYNC periods, so that a delay of whole periods ends exactly with a SYNC.
    """

    def __init__(self, motion: Motion, period_s: float, delay_periods: float) -> None:
        """Begin without torque.

        Args:
            motion: motor, encoder and hand.
            period_s: length of a SYNC period in seconds.
            delay_periods: from a demand to its effect, >= 0 and not necessarily whole.
        """
        self.delayed = delay_periods > 0.0
        """True if there is a delay."""
        self._motion = motion
        self._period_s = period_s
        self._delay = delay_periods
        self.follow(1.0)
        self._coming: deque[tuple[float, float]] = deque()
        """(periods from now, torque in N·m) of the changes under way, in order."""
        self._demanded_nm = 0.0
        self._acting_nm = 0.0

    def follow(self, part: float) -> None:
        """Let a part of the torque act: 1, or another in a drive whose torque does not follow."""
        self._part = part
        self.steady = not self.delayed and part == 1.0
        """True if the motion is under the torque that is demanded."""
        self.direct = self.steady and self._motion.torque_nm() is None
        """True if that is also the torque that the current loop delivers."""

    def torque_nm(self, demand_nm: float) -> float:
        """Return the torque that acts now, in N·m, where ``demand_nm`` is demanded."""
        delivered = self._motion.torque_nm()
        if delivered is not None:
            return delivered
        return self._part * (self._acting_nm if self.delayed else demand_nm)

    def cut(self) -> None:
        """Drop what is under way: the power stage is off."""
        self._coming.clear()
        self._demanded_nm = self._acting_nm = 0.0

    def advance(self, demand_nm: float, periods: float) -> None:
        """Move on by some periods, during all of which ``demand_nm`` was demanded."""
        if not self.delayed:
            self._motion.advance(self._part * demand_nm, periods * self._period_s)
            return
        if demand_nm != self._demanded_nm:
            self._demanded_nm = demand_nm
            self._coming.append((self._delay, demand_nm))
        done = 0.0
        while self._coming and self._coming[0][0] < periods:
            at, torque_nm = self._coming.popleft()
            if at > done:
                self._move(at - done)
            self._acting_nm, done = torque_nm, at
        self._move(periods - done)
        self._coming = deque((at - periods, torque_nm) for at, torque_nm in self._coming)
        while self._coming and not self._coming[0][0]:
            self._acting_nm = self._coming.popleft()[1]

    def _move(self, periods: float) -> None:
        self._motion.advance(self._part * self._acting_nm, periods * self._period_s)
