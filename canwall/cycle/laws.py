"""The laws that one run may render its wall by."""

from canwall.config import ConfigError, Settings
from canwall.cycle.state import MAX_LAWS
from canwall.walls import Law, UnknownLawError, find_law


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
