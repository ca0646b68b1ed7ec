"""Runs that the panel starts: `canwall run` in a session of its own, which outlives the panel."""

import os
import subprocess
import sys
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from canwall import config
from canwall.config import ConfigError, Settings, WallChange, first_error
from canwall.panel.messages import Start
from canwall.record import RunFolder
from canwall.record.folder import reason

#: Strikes of the hand in a simulated run without end: an hour of them.
_STRIKES = 3600
#: Part of the run's output that is searched for its last line [bytes].
_TAIL = 4096


@dataclass(frozen=True)
class Launcher:
    """Configurations that are offered, and the folder of the runs that are made of them.

    Attributes:
        folder: Folder of the runs.
        config: The configuration that is offered first, besides those that come with canwall and
            need no bench.
    """

    folder: Path
    config: Path | None = None

    @cached_property
    def offered(self) -> dict[str, Path]:
        """Files that a page may start, by name."""
        known = {name: path for name, path in config.catalogue().items() if _is_embedded(path)}
        first = "sim"
        if self.config is not None:
            path = config.located(self.config)
            first = next((name for name, each in known.items() if each == path), str(self.config))
            known[first] = path
        return {first: known.pop(first), **known}

    def listed(self) -> list[dict[str, Any]]:
        """Return name, title and kind of the configurations that are offered."""
        found = []
        for name, path in self.offered.items():
            settings = config.load(path)
            found.append(
                {
                    "name": name,
                    "title": config.title_of(path),
                    "simulated": settings.simulation is not None,
                    "real_time": settings.embedded or settings.real_time,
                }
            )
        return found

    def start(self, request: Start) -> "StartedRun":
        """Start a run. Raises ConfigError if it cannot be."""
        name = request.config or next(iter(self.offered))
        if name not in self.offered:
            raise ConfigError(f"config = {name!r}: not offered; one of {', '.join(self.offered)}")
        settings = _settings(config.load(self.offered[name]), request)
        output = self.folder / RunFolder.default_path().name
        given, said = output / "start.toml", output / "output.txt"
        try:
            output.mkdir(parents=True)
            given.write_text(settings.to_toml(), encoding="utf-8")
            with said.open("xb") as out:
                process = subprocess.Popen(
                    [sys.executable, "-m", "canwall", "run", str(given), "--output", str(output)],
                    stdin=subprocess.DEVNULL,
                    stdout=out,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                )
        except OSError as error:
            raise ConfigError(f"{output}: no run can be started: {reason(error)}") from None
        return StartedRun(output, process, said)


@dataclass(frozen=True)
class StartedRun:
    """A run that was started here."""

    folder: Path
    process: "subprocess.Popen[bytes]"
    said: Path

    def last_line(self) -> str:
        """Return the last line that the run has printed, without the name of the program."""
        try:
            with self.said.open("rb") as file:
                file.seek(max(0, os.path.getsize(self.said) - _TAIL))
                lines = file.read().decode(errors="replace").split("\n")
        except OSError:
            lines = []
        printed = [line.strip() for line in lines if line.strip()]
        return printed[-1].removeprefix("canwall: ") if printed else ""


def _is_embedded(path: Path) -> bool:
    settings = config.load(path)
    return settings.embedded and settings.drive.eds.is_file()


def _settings(settings: Settings, request: Start) -> Settings:
    """Return the settings of a run that a person at a page is to see and change.

    A simulated one goes by the clock and has no end, every law, and a hand that strikes on and on.
    """
    raw = settings.model_dump()
    if settings.embedded:
        from canwall.cycle.state import MAX_LAWS
        from canwall.walls import DEADBEAT, LAWS, law_name

        known = {
            law_name(wall.law, wall.deadbeat): None
            for stage in settings.stages
            for wall in settings.laws_in_turn(stage.wall)
        }
        known |= dict.fromkeys(settings.run.more_laws)
        known |= dict.fromkeys(name for name in LAWS if not name.endswith(DEADBEAT))
        raw["run"] |= {"duration_s": None, "more_laws": tuple(known)[:MAX_LAWS]}
        raw["simulation"] |= {"real_time": True}
        if raw["simulation"].get("hand") is not None:
            raw["simulation"]["hand"] |= {"strikes": _STRIKES}
        raw["schedule"] = ()
    if request.duration_s is not None:
        raw["run"]["duration_s"] = request.duration_s
    if request.changes is not None:
        _check_limits(request.changes, settings)
        wall, limits = request.changes.applied_to(settings.wall, settings.limits)
        raw |= {"wall": wall.model_dump(), "limits": limits.model_dump()}
    try:
        asked = Settings.model_validate(raw)
    except ValidationError as error:
        raise ConfigError(first_error(error)) from None
    if ":" not in asked.wall.law:  # a law in a file is the run's to load
        from canwall.cycle import law_of

        law_of(asked.wall)
    return asked


def _check_limits(change: WallChange, settings: Settings) -> None:
    """Raise ConfigError for a limit above that of the configuration."""
    if change.limits is None:
        return
    for key, value in change.limits.model_dump(exclude_none=True).items():
        bound = getattr(settings.limits, key)
        if bound is not None and value > bound:
            raise ConfigError(
                f"limits.{key} = {value:g}: above that of the configuration, {bound:g}; a page "
                "lowers limits only"
            )
