"""Experiments: what a loop does with an enabled drive besides rendering its wall."""

from collections.abc import Sequence
from typing import Protocol

from canwall.cycle.axis import WallAxis
from canwall.errors import RunFailedError


class Experiment(Protocol):
    """Torques for one axis, and what is noted of its motion.

    The cycle watches all limits meanwhile, and every way out is that of a wall.
    """

    def excite(self) -> bool:
        """Set `test_per_mille` of the next cycle; return False, with zero torque, at the end.

        Raises ExperimentError.
        """
        ...

    def note(self) -> None:
        """Note position and torque of the last cycle."""
        ...

    def conclude(self) -> None:
        """Conclude, with the drive still enabled. Raises ExperimentError."""
        ...


def torques_in_force(last: Sequence[float], left_out: int, synchronous: bool) -> list[float]:
    """Return the torques in force from the last cycle noted up to the end of a gap.

    In the SYNCs that the master left out, the torque that was in force stayed in force.

    Args:
        last: Torques commanded in the last cycles, the latest one last; at least one.
        left_out: SYNCs that were left out, at least one.
        synchronous: True if a torque waits for the next SYNC.

    Returns:
        Torques of the last cycle and of those left out, 1 + left_out of them.
    """
    held = last[-2] if synchronous and len(last) > 1 else last[-1]
    return [held] * left_out + [last[-1]]


class ExperimentError(RunFailedError):
    """Experiment that tells nothing, or that cannot go on; it ends the run."""

    def __init__(self, axis: WallAxis, text: str) -> None:
        super().__init__(text)
        self.axis = axis
