"""Laws by which a run may render its wall."""

from pathlib import Path
from typing import Any

from canwall.config import ConfigError, Settings, Wall, absolute_law
from canwall.cycle.state import MAX_LAWS
from canwall.walls import DEADBEAT, Law, UnknownLawError, find_law, law_name


def law_of(wall: Wall) -> Law:
    """Return the law of a wall. Raises ConfigError if there is none, or it lacks an option."""
    try:
        law = find_law(wall.law, wall.deadbeat)
        law.option_values(wall.options)
    except UnknownLawError as error:
        raise ConfigError(f"wall.law: {error}") from None
    return law


def run_laws(settings: Settings) -> list[Law]:
    """Return the laws of the run, each once, in the order in which they are first used.

    They are compiled here, so that no drive has to wait for it. Raises ConfigError for a law that
    does not exist, does not compile, or does not have the given options.
    """
    laws: dict[str, Law] = {}
    walls = [wall for stage in settings.stages for wall in settings.laws_in_turn(stage.wall)]
    for wall in walls:
        law = law_of(wall)
        laws[law.name] = law
    for name in settings.run.more_laws:
        try:
            laws[name] = find_law(name)
        except UnknownLawError as error:
            raise ConfigError(f"run.more_laws: {error}") from None
    if len(laws) > MAX_LAWS:
        raise ConfigError(f"schedule: {len(laws)} laws; a run may change among {MAX_LAWS}")
    for law in laws.values():
        law.compile()
    return list(laws.values())


def with_law(settings: Settings, law: str) -> Settings:
    """Return the settings with another law; `<law>+deadbeat` adds the deadbeat compensation."""
    name = absolute_law(law, Path())
    deadbeat = name.endswith(DEADBEAT)
    wall: dict[str, Any] = {"law": name.removesuffix(DEADBEAT), "deadbeat": deadbeat}
    if name != named_law(settings):
        wall["options"] = {}  # options belong to the previous law
    return settings.model_copy(update={"wall": settings.wall.model_copy(update=wall)})


def named_law(settings: Settings) -> str:
    """Return the configured law as `with_law` takes it."""
    return law_name(settings.wall.law, settings.wall.deadbeat)
