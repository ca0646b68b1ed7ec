"""Arguments and options that several commands have, and the settings that they lead to."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from canwall.config import Settings

ConfigArgument = Annotated[
    Path | None, typer.Argument(metavar="CONFIG", help="A TOML file; without: config/sim.toml.")
]
EdsOption = Annotated[
    Path | None, typer.Option("--eds", metavar="PATH", help="The drive's EDS or DCF.")
]
NoWatchdogOption = Annotated[
    bool,
    typer.Option("--accept-no-watchdog", help="Go on with a drive that has no watchdog."),
]


def settings_from(path: Path | None, **overrides: Any) -> "Settings":
    """The settings of a file, with what was given on the command line instead."""
    from canwall import config  # pydantic takes long to import: not for --help

    dotted = {
        key.replace("__", "."): value for key, value in overrides.items() if value is not None
    }
    return config.load(path or config.shipped("config/sim.toml"), dotted)


def absolute(path: Path | None) -> Path | None:
    """What is given on the command line is relative to where one is, not to the configuration."""
    return path and path.resolve()
