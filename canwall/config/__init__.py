"""Settings of a run: one TOML file, validated, immutable, in SI units.

Every key has its unit in its name. An unknown key, a wrong type or an impossible value is a
`ConfigError` of one line: file, key, what is wrong, what to do.
"""

from canwall.config.drive import Drive
from canwall.config.fault import Fault
from canwall.config.hand import Hand, Move, RandomStrikes
from canwall.config.reading import (
    absolute_law,
    check_values,
    first_error,
    load,
    shipped,
    with_overrides,
)
from canwall.config.settings import (
    Bus,
    Estimator,
    Limits,
    Mechanics,
    Run,
    Scheduled,
    Settings,
    Stage,
    Wall,
    WallChange,
)
from canwall.config.simulation import Simulation
from canwall.errors import ConfigError

__all__ = [
    "Bus",
    "ConfigError",
    "Drive",
    "Estimator",
    "Fault",
    "Hand",
    "Limits",
    "Mechanics",
    "Move",
    "RandomStrikes",
    "Run",
    "Scheduled",
    "Settings",
    "Simulation",
    "Stage",
    "Wall",
    "WallChange",
    "absolute_law",
    "check_values",
    "first_error",
    "load",
    "shipped",
    "with_overrides",
]
