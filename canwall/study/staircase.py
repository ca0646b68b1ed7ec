"""Order in which a person meets stiffer and softer walls."""

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Protocol

from canwall.errors import InputError
from canwall.study.session import Session


class Judged(Protocol):
    """A wall, and what a person said of it."""

    @property
    def law(self) -> str:
        """Law of the wall."""
        ...

    @property
    def stiffness_nm_per_rad(self) -> float:
        """Stiffness of the wall [N·m/rad]."""
        ...

    @property
    def free_of_chatter(self) -> bool:
        """True if the person said so."""
        ...


@dataclass(frozen=True)
class Staircase:
    """Adaptive procedure: up while a wall is free of chatter, down while it is not.

    Steps are factors: 2 at first, the square root of the last one after each reversal. The first
    reversal with a factor of `finest` or less ends the staircase: the limit lies between the last
    two walls. The steps after a wrong answer correct it. The staircase also ends at the ceiling,
    and after a wall that chatters below 1/64 of the start or of the last wall that was free.

    Attributes:
        start: Stiffness of the first wall [N·m/rad].
        ceiling: Largest stiffness [N·m/rad].
        finest: Factor of the last steps, greater than 1.

    Raises:
        InputError: If a value is out of range.
    """

    start: float
    ceiling: float
    finest: float

    def __post_init__(self) -> None:
        if not 0.0 < self.ceiling < math.inf:
            raise InputError(f"--ceiling {self.ceiling:g}: has to be a finite number above 0")
        if not 0.0 < self.start <= self.ceiling:
            raise InputError(
                f"--start {self.start:g}: has to be above 0 and at most the ceiling, "
                f"{self.ceiling:g}"
            )
        if not self.finest > 1.0:
            raise InputError(f"--finest {self.finest:g}: has to be a factor above 1")

    def walls(self) -> Generator[float, bool, None]:
        """Yield the stiffness of one wall after another; each is sent if it was free of chatter."""
        stiffness, factor = self.start, 2.0
        free = yield stiffness
        floor = stiffness / 64.0
        while stiffness < self.ceiling if free else stiffness >= floor:
            before = free
            stiffness = min(stiffness * factor, self.ceiling) if free else stiffness / factor
            free = yield stiffness
            if free:
                floor = stiffness / 64.0
            if free != before:
                if factor <= self.finest:
                    return
                factor = math.sqrt(factor)

    def climb(self, is_free: Callable[[float], bool]) -> None:
        """Present one wall after another; `is_free` takes a stiffness and tells if it is free."""
        walls = self.walls()
        stiffness: float | None = next(walls)
        while stiffness is not None:
            stiffness = next_wall(walls, is_free(stiffness))


def next_wall(walls: Generator[float, bool, None], free: bool) -> float | None:
    """Send if a wall was free of chatter; return the stiffness of the next, None at the end."""
    try:
        return walls.send(free)
    except StopIteration:
        return None


def run_staircases(session: Session, staircase: Staircase) -> None:
    """Run the staircase of each law of the session."""
    for law in session.laws:

        def is_free(stiffness: float, law: str = law) -> bool:
            return session.step([law], stiffness)[law]

        staircase.climb(is_free)


def run_alternating(session: Session, stiffnesses: Sequence[float]) -> None:
    """Render walls of rising stiffness, the laws of the session taking turns on each.

    A law that was found to chatter takes no part in the walls after it (source text, 5.5).
    """
    laws = session.laws
    for stiffness in sorted(stiffnesses):
        free = session.step(laws, stiffness)
        laws = [law for law in laws if free.get(law, True)]
        if not laws:
            return


def stiffness_limits(verdicts: Sequence[Judged]) -> dict[str, tuple[float, float]]:
    """Return the stiffest wall free of chatter and the softest that chatters, for each law.

    In N·m/rad; 0 and infinity if there is none. If the answers contradict each other, the first
    may be above the second.
    """
    limits: dict[str, tuple[float, float]] = {}
    for verdict in verdicts:
        free, chatters = limits.get(verdict.law, (0.0, math.inf))
        if verdict.free_of_chatter:
            free = max(free, verdict.stiffness_nm_per_rad)
        else:
            chatters = min(chatters, verdict.stiffness_nm_per_rad)
        limits[verdict.law] = free, chatters
    return limits
