"""Presets: changes of the wall that have a name, in a file."""

import os
import tomllib
from pathlib import Path

import tomli_w
from pydantic import ValidationError

from canwall.config import ConfigError, WallChange, check_values, first_error
from canwall.errors import did_you_mean
from canwall.record.folder import reason, whole_file

#: Longest name [characters], and the most presets.
_LONGEST, _MOST = 60, 200


def default_path() -> Path:
    """Return the user's file of presets."""
    home = os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config"
    return Path(home) / "canwall" / "presets.toml"


class Presets:
    """Named changes of the wall, a table each in a TOML file."""

    def __init__(self, path: Path | None = None) -> None:
        """Use the file `path`, by default the user's; it need not exist."""
        self.path = path or default_path()

    def all(self) -> dict[str, WallChange]:
        """Return all presets by name. Raises ConfigError for a file that is damaged."""
        try:
            raw = tomllib.loads(self.path.read_text(encoding="utf-8"))
            check_values(raw)
        except FileNotFoundError:
            return {}
        except ConfigError as error:
            raise ConfigError(f"{self.path}: {error}") from None
        except OSError as error:
            raise ConfigError(f"{self.path}: cannot be read: {reason(error)}") from None
        except (ValueError, RecursionError) as error:
            raise ConfigError(f"{self.path}: not valid TOML: {reason(error)}") from None
        return {name: self._change(name, table) for name, table in raw.items()}

    def get(self, name: str) -> WallChange:
        """Return a preset. Raises ConfigError if there is none of this name."""
        known = self.all()
        if name not in known:
            raise ConfigError(f"{name}: no preset of this name{did_you_mean(name, known)}")
        return known[name]

    def save(self, name: str, change: WallChange) -> None:
        """Save a change under a name, in place of the one that had it.

        Raises:
            ConfigError: For a name that is empty, too long or not printable, too many presets, or
                a file that is damaged, which is left alone.
            RecordError: If the file cannot be written.
        """
        if not 0 < len(name) <= _LONGEST or not name.isprintable() or name != name.strip():
            raise ConfigError(
                f"name = {name!r}: has to have 1 to {_LONGEST} letters, none of them at the ends "
                "a blank"
            )
        known = self.all() | {name: change}
        if len(known) > _MOST:
            raise ConfigError(f"{self.path}: {_MOST} presets at most; remove one")
        self._write(known)

    def remove(self, name: str) -> None:
        """Remove a preset. Raises ConfigError if there is none, RecordError as `save`."""
        self.get(name)
        self._write({known: change for known, change in self.all().items() if known != name})

    def _change(self, name: str, table: object) -> WallChange:
        try:
            return WallChange.model_validate(table)
        except ValidationError as error:
            text = first_error(error, WallChange)
            raise ConfigError(f"{self.path}: preset {name}: {text}") from None

    def _write(self, presets: dict[str, WallChange]) -> None:
        tables = {
            name: change.model_dump(mode="json", exclude_none=True)
            for name, change in presets.items()
        }
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{self.path}: cannot be written: {reason(error)}") from None
        with whole_file(self.path) as file:
            tomli_w.dump(tables, file)
