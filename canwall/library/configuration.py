"""Settings of a run, from a file, from other settings, and from what is given in their place."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

from canwall import config as settings_room
from canwall.config import Settings
from canwall.library.arguments import as_dict, as_path
from canwall.library.laws import LawLike, law_name
from canwall.walls import Law

#: A TOML file, settings that have been loaded, or None for config/sim.toml.
Config: TypeAlias = str | os.PathLike[str] | Settings | None


def load(config: Config = None, overrides: Mapping[str, Any] | None = None) -> Settings:
    """Load and validate a configuration.

    Args:
        config: Path of a TOML file, settings, or None for the simulated drive of config/sim.toml.
        overrides: Values by dotted key that replace those of the file:
            `{"wall.law": "mean_force", "simulation.hand.inertia_kg_m2": 2e-4}`. Paths in them are
            relative to the working directory. A law may be one declared with `@canwall.law`.

    Returns:
        The settings, immutable, in SI units; every path is absolute.

    Raises:
        canwall.errors.ConfigError: For a file or a value that cannot be used; one line with file,
            key, and what to do.
    """
    if isinstance(config, Settings):
        settings = config
    else:
        expected = "a path or settings (values by dotted key are overrides)"
        default = settings_room.shipped("config/sim.toml")
        path = default if config is None else as_path("config", config, expected)
        settings = settings_room.load(path)
    given = as_dict("overrides", overrides)
    if not given:
        return settings
    return settings_room.with_overrides(
        settings, {key: _from_here(key, value) for key, value in given.items()}
    )


def _from_here(key: str, value: Any) -> Any:
    """Return a value with paths resolved, and a law by its name."""
    if key == "wall.law" or isinstance(value, Law):
        return law_name(value)
    if key in ("drive.eds", "simulation.store") and isinstance(value, str | os.PathLike):
        return Path(value).resolve()
    return value


def wall_settings(
    config: Config,
    overrides: Mapping[str, Any] | None,
    law: LawLike | None,
    stiffness: float | None,
    damping: float | None,
    duration: float | None,
    options: Mapping[str, float] | None,
) -> Settings:
    """Load a configuration with what is given of its wall, as `canwall.run` takes it."""
    settings = load(config, overrides)
    given = {
        "wall.law": law,
        "wall.options": {} if law is not None and options is None else options,
        "wall.stiffness_nm_per_rad": stiffness,
        "wall.damping_nm_s_per_rad": damping,
        "run.duration_s": duration,
    }
    settings = load(settings, {key: value for key, value in given.items() if value is not None})
    return settings.without_replacements(law=law is not None)
