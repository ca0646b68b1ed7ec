"""Changes of the wall of a run in progress, posted by another process (`canwall change`).

The run leaves the address of a mailbox in its folder. A change is validated against the run's own
configuration before it is posted, so the loop can apply it without checks.
"""

import tomllib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from canwall.config import ConfigError, Settings, WallChange, absolute_law, first_error, load
from canwall.cycle import WallAxis, run_laws
from canwall.errors import RunFailedError
from canwall.record import Mailbox, RecordError, RunFolder
from canwall.record.folder import reason
from canwall.walls import UnknownLawError, find_law

#: Longest wait for the loop to take a change; it takes one at a time [s].
_PATIENCE_S = 5.0


@contextmanager
def open_to_changes(axes: Sequence[WallAxis], folders: Sequence[RunFolder]) -> Iterator[None]:
    """Accept changes of the walls from other processes for as long as the context lasts.

    Raises RecordError if live.json, or its shared memory, cannot be written.
    """
    with ExitStack() as stack:
        for axis, folder in zip(axes, folders, strict=True):
            try:
                axis.mailbox = Mailbox.create()
            except OSError as error:
                raise RecordError(f"no shared memory for changes: {reason(error)}") from None
            stack.callback(axis.mailbox.close)
            folder.write_live(axis.mailbox.address)
            stack.callback(folder.live.unlink, missing_ok=True)
        yield


def post_change(folder: RunFolder, assignments: Sequence[str]) -> int:
    """Post a change to the run that writes a folder.

    Args:
        folder: Folder of the run.
        assignments: KEY=VALUE, keys of `[[schedule]]` and values as in TOML.

    Returns:
        The cycle from which on the change is in force.

    Raises:
        ConfigError: If there is no such run, or a key or a value is wrong.
        RunFailedError: If the run does not take the change in time.
    """
    try:
        mailbox = Mailbox.open(folder.read_live())
    except (OSError, ValueError):
        raise ConfigError(
            f"{folder.path}: no run in progress; give the folder of one that is"
        ) from None
    try:
        change = _parse_change(assignments, load(folder.config))
        return mailbox.post(change.model_dump_json(exclude_none=True), _PATIENCE_S)
    except TimeoutError:
        raise RunFailedError(f"{folder.path}: the run does not take the change") from None
    finally:
        mailbox.close()


def _parse_change(assignments: Sequence[str], settings: Settings) -> WallChange:
    """Parse assignments and check that the run can apply them. Raises ConfigError."""
    values: dict[str, Any] = {}
    for assignment in assignments:
        key, _, value = assignment.partition("=")
        table = values
        *path, name = key.strip().removeprefix("wall.").split(".")
        for part in path:
            table = table.setdefault(part, {})
        table[name] = _parse_value(value)
    if isinstance(values.get("law"), str):
        values["law"] = absolute_law(values["law"], Path())
    try:
        change = WallChange.model_validate(values)
    except ValidationError as error:
        raise ConfigError(first_error(error, WallChange)) from None
    wall, _ = change.applied_to(settings.wall, settings.limits)
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
    if change.law is not None:
        known = [law.name for law in run_laws(settings)]
        if law.name not in known:
            raise ConfigError(
                f"law {law.name} is not one of the run's: {', '.join(known)}; "
                "list it in run.more_laws"
            )
    return change


def _parse_value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text.strip()  # a string without quotes
