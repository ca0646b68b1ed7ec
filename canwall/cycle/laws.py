"""The laws that one run may render its wall by."""

from pathlib import Path
from typing import Any

from canwall.config import ConfigError, Settings, absolute_law
from canwall.cycle.state import MAX_LAWS
from canwall.walls import DEADBEAT, Law, UnknownLawError, find_law


def run_laws(settings: Settings) -> list[Law]:
    """The laws of the run, each once, in the order in which they are first used.

    Raises ConfigError for a law that is not there or has not the options that it is given.
    """
    laws: dict[str, Law] = {}
    walls = [wall for stage in settings.stages for wall in settings.laws_in_turn(stage.wall)]
    for wall in walls:
        try:
            law = find_law(wall.law, wall.deadbeat)
            law.option_values(wall.options)
        except UnknownLawError as error:
            raise ConfigError(f"wall.law: {error}") from None
        laws[law.name] = law
    for name in settings.run.more_laws:
        try:
            laws[name] = find_law(name)
        except UnknownLawError as error:
            raise ConfigError(f"run.more_laws: {error}") from None
    if len(laws) > MAX_LAWS:
        raise ConfigError(f"schedule: {len(laws)} laws; a run may change among {MAX_LAWS}")
    return list(laws.values())


def with_law(settings: Settings, law: str) -> Settings:
    """The wall rendered by that law, +deadbeat where it is compensated."""
    name = absolute_law(law, Path())
    deadbeat = name.endswith(DEADBEAT)
    wall: dict[str, Any] = {"law": name.removesuffix(DEADBEAT), "deadbeat": deadbeat}
    if name != named_law(settings):
        wall["options"] = {}  # they were the other law's
    return settings.model_copy(update={"wall": settings.wall.model_copy(update=wall)})


def named_law(settings: Settings) -> str:
    """The configuration's law as a value of the axis."""
    return settings.wall.law + (DEADBEAT if settings.wall.deadbeat else "")
