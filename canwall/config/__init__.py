"""Settings of a run: one TOML file, validated, immutable, in SI units.

Every key has its unit in its name. An unknown key, a wrong type or an impossible value is a
`ConfigError` of one line: file, key, what is wrong, what to do.
"""

from canwall.config.catalogue import catalogue, located, named, portable_text, shipped, title_of
from canwall.config.drive import Drive
from canwall.config.fault import Fault
from canwall.config.hand import Hand, Move, RandomStrikes
from canwall.config.reading import (
    absolute_law,
    check_values,
    first_error,
    load,
    parse,
    short_law,
    with_overrides,
)
from canwall.config.requests import (
    ChangeWall,
    End,
    Mark,
    Request,
    TakeTurns,
    WatchBeat,
    parse_request,
)
from canwall.config.section import Section, changed
from canwall.config.settings import (
    Bus,
    Estimator,
    Guard,
    Limits,
    LimitsChange,
    Mechanics,
    Operator,
    Run,
    Scheduled,
    Settings,
    Stage,
    Wall,
    WallChange,
    check_divider,
    has_wire,
)
from canwall.config.simulation import Simulation
from canwall.errors import ConfigError

__all__ = [
    "Bus",
    "ChangeWall",
    "ConfigError",
    "Drive",
    "End",
    "Estimator",
    "Fault",
    "Guard",
    "Hand",
    "Limits",
    "LimitsChange",
    "Mark",
    "Mechanics",
    "Move",
    "Operator",
    "RandomStrikes",
    "Request",
    "Run",
    "Scheduled",
    "Section",
    "Settings",
    "Simulation",
    "Stage",
    "TakeTurns",
    "Wall",
    "WallChange",
    "WatchBeat",
    "absolute_law",
    "catalogue",
    "changed",
    "check_divider",
    "check_values",
    "first_error",
    "has_wire",
    "load",
    "located",
    "named",
    "parse",
    "parse_request",
    "portable_text",
    "shipped",
    "short_law",
    "title_of",
    "with_overrides",
]
