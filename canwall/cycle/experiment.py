"""Experiments: what a loop does with an enabled drive besides rendering its wall."""

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


class ExperimentError(RunFailedError):
    """Experiment that tells nothing, or that cannot go on; it ends the run."""

    def __init__(self, axis: WallAxis, text: str) -> None:
        super().__init__(text)
        self.axis = axis
