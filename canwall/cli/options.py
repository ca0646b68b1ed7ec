"""Arguments and options shared by several commands, and the settings made from them."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from canwall.cli.completion import complete_config, complete_law
from canwall.errors import InputError

if TYPE_CHECKING:
    from canwall.config import Settings

ConfigArgument = Annotated[
    Path | None,
    typer.Argument(
        metavar="CONFIG",
        help="A TOML file; without: config/sim.toml.",
        autocompletion=complete_config,
    ),
]
ConfigFile = Annotated[
    Path,
    typer.Argument(
        metavar="CONFIG",
        help="A TOML file, or a name of `canwall config`.",
        autocompletion=complete_config,
    ),
]
LawsOption = Annotated[
    list[str] | None,
    typer.Option("--law", help="A law; may be repeated.", autocompletion=complete_law),
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print the result as JSON on standard output.")
]
EdsOption = Annotated[
    Path | None, typer.Option("--eds", metavar="PATH", help="The drive's EDS or DCF.")
]
NoWatchdogOption = Annotated[
    bool,
    typer.Option("--accept-no-watchdog", help="Accept a drive that has no watchdog."),
]


def settings_from(path: Path | None, **overrides: Any) -> "Settings":
    """Load a configuration, by default config/sim.toml, with keys given on the command line.

    Overrides have "__" for the dot of a key; None stands for an option that was not given.
    """
    from canwall import config  # pydantic takes long to import: not for --help

    dotted = {
        key.replace("__", "."): value for key, value in overrides.items() if value is not None
    }
    return config.load(path or config.shipped("config/sim.toml"), dotted)


def folder_path(text: str) -> Path:
    """Parse --output; empty, as of a variable that is not set, it would be the working directory.

    Raises BadParameter.
    """
    return _path(text, "a folder")


def file_path(text: str) -> Path:
    """Parse --output of a file. Raises BadParameter if it is empty."""
    return _path(text, "a file")


def _path(text: str, kind: str) -> Path:
    if not text:
        raise typer.BadParameter(f"is empty; give {kind}")
    return Path(text)


def refuse_to_overwrite(output: Path) -> None:
    """Raise InputError for a file that exists."""
    if output.is_file():
        raise _taken(output)


def refuse_what_exists(output: Path) -> None:
    """Raise InputError for anything that exists, a folder as well."""
    if os.path.lexists(output):
        raise _taken(output)


def _taken(output: Path) -> InputError:
    return InputError(f"{output}: exists already; choose another --output")


def absolute_path(path: Path | None) -> Path | None:
    """Resolve a path of the command line, relative to the working directory."""
    return path and path.resolve()
