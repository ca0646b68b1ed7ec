"""A and B: two walls, one key to switch between them, or a turn for each from strike to strike."""

from collections.abc import Callable, Sequence
from typing import Any

from canwall.config import ConfigError, Wall
from canwall.panel.walls import check_laws, completed, parse_change
from canwall.record.live import LiveLaw

#: Makes a request of the run and returns the cycle from which on it is in force.
Request = Callable[[dict[str, Any]], int]


class AB:
    """Two walls of a run in progress."""

    def __init__(self, request: Request) -> None:
        self._request = request
        self._given: dict[str, dict[str, Any]] = {}
        self._walls: dict[str, dict[str, Any]] = {}
        self._which: str | None = None
        self._auto = False

    def set(self, a: object, b: object, wall: Wall, laws: Sequence[LiveLaw]) -> None:
        """Choose the walls; none of them is in force by that.

        Args:
            a: Change that leads from `wall` to A, keys of `WallChange`.
            b: Change that leads to B.
            wall: The wall in force.
            laws: The laws of the run.

        Raises:
            ConfigError: For a change that is not valid, or one to a law that the run has not.
        """
        changes = [parse_change(one) for one in (a, b)]
        check_laws(changes, wall, laws)
        *walls, _ = completed(changes, wall)
        self.auto(False)
        self._walls = dict(zip("ab", walls, strict=True))
        self._given = {
            name: change.model_dump(mode="json", exclude_none=True)
            for name, change in zip("ab", changes, strict=True)
        }
        self._which = None

    def use(self, which: str) -> int:
        """Put A or B into force; return the cycle. Raises ConfigError, also for the run."""
        if which not in self._known():
            raise ConfigError(f"which: has to be a or b, not {which!r}")
        self.auto(False)
        cycle = self._request({"do": "change", **self._walls[which]})
        self._which = which
        return cycle

    def auto(self, on: bool) -> int | None:
        """Have A and B take turns from strike to strike, or not; return the cycle of a change.

        Raises ConfigError, also for the run.
        """
        if on == self._auto:
            return None
        walls = list(self._known().values()) if on else []
        cycle = self._request({"do": "take_turns", "walls": walls})
        self._auto, self._which = on, None
        return cycle

    def state(self) -> dict[str, Any]:
        """Return both changes, which of them is in force, and whether they take turns, as JSON."""
        given = {name: self._given.get(name) for name in "ab"}
        return {**given, "which": self._which, "auto": self._auto}

    def _known(self) -> dict[str, dict[str, Any]]:
        if not self._walls:
            raise ConfigError("there is no A and no B yet; set them first")
        return self._walls
