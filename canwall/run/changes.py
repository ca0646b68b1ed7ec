"""A run that goes on, and whoever wants to change its wall: `canwall change`.

The run leaves an address in its folder; a change is checked against the run's own configuration
before it is posted there, so that the loop need not doubt it.
"""

import json
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from canwall.config import ConfigError, Settings, WallChange, absolute_law, first_error, load
from canwall.cycle import WallAxis, run_laws
from canwall.errors import RunFailedError
from canwall.record import Mailbox, RunFolder
from canwall.walls import UnknownLawError, find_law

#: How long a loop may take to notice a change: it waits for one that is under way.
_PATIENCE_S = 5.0


@contextmanager
def open_to_changes(axes: Sequence[WallAxis], folders: Sequence[RunFolder]) -> Iterator[None]:
    """Let other processes change the walls, for as long as the context lasts."""
    with ExitStack() as stack:
        for axis, folder in zip(axes, folders, strict=True):
            axis.mailbox = Mailbox.create()
            stack.callback(axis.mailbox.close)
            folder.live.write_text(json.dumps({"mailbox": axis.mailbox.address}))
            stack.callback(folder.live.unlink, missing_ok=True)
        yield


def change(folder: RunFolder, assignments: Sequence[str]) -> int:
    """Post a change, KEY=VALUE each, to the run that writes this folder; the cycle of its effect.

    Keys are those of `[[schedule]]`, values as in TOML. Raises ConfigError where the run or a key
    is not there or a value impossible, RunFailedError where the run does not take it.
    """
    try:
        address = json.loads(folder.live.read_text())["mailbox"]
        mailbox = Mailbox.open(address)
    except (OSError, ValueError, KeyError):
        raise ConfigError(f"{folder.path}: no run goes on here; give the folder of one") from None
    try:
        wanted = _checked(assignments, load(folder.config))
        return mailbox.post(wanted.model_dump_json(exclude_none=True), _PATIENCE_S)
    except TimeoutError:
        raise RunFailedError(f"{folder.path}: the run does not take the change") from None
    finally:
        mailbox.close()


def _checked(assignments: Sequence[str], settings: Settings) -> WallChange:
    values: dict[str, Any] = {}
    for assignment in assignments:
        key, _, value = assignment.partition("=")
        table = values
        *path, name = key.strip().removeprefix("wall.").split(".")
        for part in path:
            table = table.setdefault(part, {})
        table[name] = _value(value)
    if isinstance(values.get("law"), str):
        values["law"] = absolute_law(values["law"], Path())
    try:
        wanted = WallChange.model_validate(values)
    except ValidationError as error:
        raise ConfigError(first_error(error, WallChange)) from None
    wall, _ = wanted.applied_to(settings.wall, settings.limits)
    low, high = settings.limits.position_rad
    if not low < wall.position_rad < high:
        raise ConfigError(
            f"position_rad = {wall.position_rad:g} lies outside the run's limits.position_rad = "
            f"[{low:g}, {high:g}]"
        )
    try:
        law = find_law(wall.law, wall.deadbeat)
        law.option_values(wall.options)
    except UnknownLawError as error:
        raise ConfigError(f"law: {error}") from None
    if wanted.law is not None:
        known = [law.name for law in run_laws(settings)]
        if law.name not in known:
            raise ConfigError(
                f"law {law.name} is none of the run's: {', '.join(known)}; list it in run.more_laws"
            )
    return wanted


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text.strip()  # a word without its quotes
