"""Changes of the wall of a run in progress, requested by another process (`canwall change`).

The run leaves the address of a mailbox in its folder. A thread beside the loop judges each change
against the wall that is in force, as a whole, and offers it to the loop, which puts it into force
if that is still the wall in force. What fails is refused to the one who asked.
"""

import threading
import time
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from canwall.compiled import copied
from canwall.config import ConfigError, Wall, WallChange, absolute_law, check_values, first_error
from canwall.cycle import Offer, WallAxis, set_limits, set_wall
from canwall.errors import RunFailedError
from canwall.record import Mailbox, RecordError, RunFolder
from canwall.record.folder import reason
from canwall.walls import DEADBEAT, UnknownLawError, find_law

#: Longest wait for the loop to take a change; it takes one at a time [s].
_PATIENCE_S = 5.0
#: Interval at which the run looks for changes, and for what the loop does with them [s].
_POLL_S = 0.01
_ENDED = "the run has ended"


@contextmanager
def open_to_changes(axes: Sequence[WallAxis], folders: Sequence[RunFolder]) -> Iterator[None]:
    """Accept changes of the walls from other processes for as long as the context lasts.

    Raises RecordError if live.json, or its shared memory, cannot be written.
    """
    ended = threading.Event()
    with ExitStack() as stack:
        for axis, folder in zip(axes, folders, strict=True):
            try:
                mailbox = Mailbox.create()
            except OSError as error:
                raise RecordError(f"no shared memory for changes: {reason(error)}") from None
            stack.callback(mailbox.close)
            judge = threading.Thread(target=_judge, args=(axis, mailbox, ended), daemon=True)
            judge.start()
            stack.callback(judge.join)
            stack.callback(ended.set)
            folder.write_live(mailbox.address)
            stack.callback(folder.live.unlink, missing_ok=True)
        yield


def _judge(axis: WallAxis, mailbox: Mailbox, ended: threading.Event) -> None:
    """Judge the changes that are posted for an axis until the run has ended."""
    while not ended.wait(_POLL_S):
        if mailbox.waiting():
            try:
                change = WallChange.model_validate_json(mailbox.text())
                mailbox.accept(_put_in_force(axis, change, mailbox, ended))
            except ValidationError as error:
                mailbox.refuse(first_error(error, WallChange))
            except Exception as error:  # whatever it is, it must not be the end of the run
                mailbox.refuse(str(error) or type(error).__name__)
    if mailbox.waiting():
        mailbox.refuse(_ENDED)


def _put_in_force(
    axis: WallAxis, change: WallChange, mailbox: Mailbox, ended: threading.Event
) -> int:
    """Have the loop put a change into force; return the cycle from which on it is.

    Raises ConfigError for a change that is impossible, withdrawn, or too late.
    """
    offer = judged(axis, change)
    axis.offers.append(offer)
    while offer.since is None:
        if offer.outdated:
            offer = judged(axis, change)
            axis.offers.append(offer)
        elif (mailbox.withdrawn() or ended.is_set()) and axis.take_offer() is not None:
            raise ConfigError(_ENDED)
        time.sleep(_POLL_S)
    return offer.since


def judged(axis: WallAxis, change: WallChange) -> Offer:
    """Apply a change to the wall and the limits in force.

    Raises ConfigError if the loop could not put the result into force.
    """
    revision = axis.revision  # first: whatever changes from now on outdates the offer
    wall, limits = change.applied_to(axis.wall, axis.limits)
    # A requested law ends the alternation; other changes apply to all alternating walls.
    walls = [axis.wall] if change.law else axis.turns
    turns = [change.applied_to(each, limits)[0] for each in walls]
    rehearsal = copied(axis.cycle)
    for each in (*turns, wall):
        low, high = limits.position_rad
        if not low < each.position_rad < high:
            raise ConfigError(
                f"position_rad = {each.position_rad:g} lies outside the run's "
                f"limits.position_rad = [{low:g}, {high:g}]"
            )
        _check_law(axis, each)
        set_wall(rehearsal, each, axis.laws)
    set_limits(rehearsal, limits)
    return Offer(revision, wall, limits, turns)


def _check_law(axis: WallAxis, wall: Wall) -> None:
    """Raise ConfigError unless the law is one of the run's and has the options of the wall."""
    known = {law.name: law for law in axis.laws}
    name = wall.law + (DEADBEAT if wall.deadbeat else "")
    try:
        if name not in known and ":" not in name:
            find_law(wall.law, wall.deadbeat)  # says what is wrong with the name
        if name in known:
            known[name].option_values(wall.options)
    except UnknownLawError as error:
        raise ConfigError(f"law: {error}") from None
    if name not in known:
        raise ConfigError(
            f"law {name} is not one of the run's: {', '.join(known)}; list it in run.more_laws"
        )


def post_change(folder: RunFolder, assignments: Sequence[str]) -> int:
    """Post a change to the run that writes a folder.

    Args:
        folder: Folder of the run.
        assignments: KEY=VALUE, keys of `[[schedule]]` and values as in TOML.

    Returns:
        The cycle from which on the change is in force.

    Raises:
        ConfigError: If there is no such run, a key or a value is wrong, or the run refuses it.
        RunFailedError: If the run does not take the change in time.
    """
    try:
        mailbox = Mailbox.open(folder.read_live())
    except (OSError, ValueError):
        raise ConfigError(
            f"{folder.path}: no run in progress; give the folder of one that is"
        ) from None
    try:
        change = _parse_change(assignments)
        return mailbox.post(change.model_dump_json(exclude_none=True), _PATIENCE_S)
    except TimeoutError:
        raise RunFailedError(f"{folder.path}: the run does not take the change") from None
    finally:
        mailbox.close()


def _parse_change(assignments: Sequence[str]) -> WallChange:
    """Parse assignments. Raises ConfigError for an unknown key, or a value of a wrong type."""
    values: dict[str, Any] = {}
    for assignment in assignments:
        key, _, value = assignment.partition("=")
        table = values
        *path, name = key.strip().removeprefix("wall.").split(".")
        for part in path:
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                raise ConfigError(f"{key.strip()}: {part} has a value of its own; keep one of them")
        table[name] = _parse_value(value)
    check_values(values)
    if isinstance(values.get("law"), str):
        values["law"] = absolute_law(values["law"], Path())
    try:
        return WallChange.model_validate(values)
    except ValidationError as error:
        raise ConfigError(first_error(error, WallChange)) from None


def _parse_value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text.strip()  # a string without quotes
