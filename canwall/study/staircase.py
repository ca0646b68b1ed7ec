"""In which order a person meets stiffer and softer walls."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from canwall.errors import InputError
from canwall.study.session import Session, Verdict


@dataclass(frozen=True)
class Staircase:
    """Up while a wall is free of chatter, down while it is not, in ever smaller steps.

    Steps are factors: 2 at first, the square root of it after each reversal. The first reversal
    with a factor of `finest` or less ends it: the limit lies between the last two walls. A person
    who errs once is brought back by the steps that follow. It ends as well at the ceiling, and
    where nothing is free down to a 64th of the start, or of the last wall that was. start, ceiling
    in N·m/rad. Raises InputError.
    """

    start: float
    ceiling: float
    finest: float

    def __post_init__(self) -> None:
        if not 0.0 < self.start <= self.ceiling < math.inf:
            raise InputError(
                f"--start {self.start:g}: has to be above 0, and at most the ceiling, "
                f"{self.ceiling:g}"
            )
        if not self.finest > 1.0:
            raise InputError(f"--finest {self.finest:g}: has to be a factor above 1")

    def climb(self, is_free: Callable[[float], bool]) -> None:
        """Ask of one wall after the other."""
        stiffness, factor = self.start, 2.0
        free = is_free(stiffness)
        floor = stiffness / 64.0
        while stiffness < self.ceiling if free else stiffness >= floor:
            before = free
            stiffness = min(stiffness * factor, self.ceiling) if free else stiffness / factor
            free = is_free(stiffness)
            if free:
                floor = stiffness / 64.0
            if free != before:
                if factor <= self.finest:
                    return
                factor = math.sqrt(factor)


def staircases(session: Session, staircase: Staircase) -> None:
    """The staircase of each law, one after the other."""
    for law in session.laws:

        def is_free(stiffness: float, law: str = law) -> bool:
            return session.step([law], stiffness)[law]

        staircase.climb(is_free)


def alternating(session: Session, stiffnesses: Sequence[float]) -> None:
    """All laws on the same walls, strike by strike in turn, each wall stiffer than the last.

    A law that was found to chatter is left out of the walls after it (the source, 5.5).
    """
    left = session.laws
    for stiffness in sorted(stiffnesses):
        heard = session.step(left, stiffness)
        left = [law for law in left if heard.get(law, True)]
        if not left:
            return


def limits(verdicts: Sequence[Verdict]) -> dict[str, tuple[float, float]]:
    """For each law: the stiffest wall that was free of chatter, the softest that was not.

    [N·m/rad]; 0 and infinity where there was none. A person may contradict himself: then the
    first is above the second.
    """
    found: dict[str, tuple[float, float]] = {}
    for verdict in verdicts:
        free, chatters = found.get(verdict.law, (0.0, math.inf))
        if verdict.free_of_chatter:
            free = max(free, verdict.stiffness_nm_per_rad)
        else:
            chatters = min(chatters, verdict.stiffness_nm_per_rad)
        found[verdict.law] = free, chatters
    return found
