"""Requests of other processes to a run in progress (`canwall change`, the panel).

The run leaves the addresses of its shared memory in its folder. A thread beside the loop publishes
how the run is, and judges each requested change against the wall that is in force, as a whole; it
offers the result to the loop, which puts it into force if that is still the wall in force. What
fails is refused to the one who asked.
"""

import json
import threading
import time
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from typing import Any, assert_never

from canwall.compiled import copied
from canwall.config import (
    ChangeWall,
    ConfigError,
    End,
    Limits,
    LimitsChange,
    Mark,
    Request,
    TakeTurns,
    Wall,
    WallChange,
    WatchBeat,
    changed,
    check_divider,
    parse_request,
)
from canwall.cycle import (
    Exchange,
    Offer,
    Outcome,
    WallAxis,
    real_time_priority,
    set_limits,
    set_wall,
)
from canwall.record import RecordError, RunFolder
from canwall.record.folder import reason
from canwall.record.live import LiveMemory, LiveRun
from canwall.run.publishing import Publisher
from canwall.walls import UnknownLawError, find_law, law_name

#: Longest wait for the loop to take a change; it takes one at a time [s].
_PATIENCE_S = 5.0
#: Interval at which the run looks for requests, and for what the loop does with them [s].
_POLL_S = 0.01
#: Interval at which it publishes how it is [s].
_PUBLISH_S = 1.0 / 30.0
_ENDED = "the run has ended"


@contextmanager
def open_to_changes(
    axes: Sequence[WallAxis],
    folders: Sequence[RunFolder],
    exchange: Exchange,
    outcome: Outcome,
    end: Callable[[], None] = lambda: None,
) -> Iterator[None]:
    """Publish the walls to other processes, and take their requests, while the context lasts.

    Args:
        axes: The walls.
        folders: Folder of the record of each.
        exchange: Exchange of frames with their drives.
        outcome: Outcome of the run, known when the context ends.
        end: Ends the run as Ctrl-C does.

    Raises:
        RecordError: If live.json, or its shared memory, cannot be written.
    """
    ended = threading.Event()
    with ExitStack() as stack:
        for axis, folder in zip(axes, folders, strict=True):
            try:
                memory = LiveMemory(axis.ring)
            except OSError as error:
                raise RecordError(f"no shared memory for changes: {reason(error)}") from None
            stack.callback(memory.close)
            axis.open_controls(memory.controls)
            publisher = Publisher(axis, exchange, outcome, folder)
            attendant = _Attendant(axis, folder, memory, publisher, end)
            attendant.publish()
            thread = threading.Thread(target=attendant.attend, args=(ended,), daemon=True)
            thread.start()
            stack.callback(thread.join, _PATIENCE_S)  # it may wait for a disk
            stack.callback(ended.set)
            folder.write_live(memory.addresses)
            stack.callback(folder.live.unlink, missing_ok=True)
        yield


class _Attendant:
    """Attends to the other processes for one axis, in a thread beside the loop."""

    def __init__(
        self,
        axis: WallAxis,
        folder: RunFolder,
        memory: LiveMemory,
        publisher: Publisher,
        end: Callable[[], None],
    ) -> None:
        self._axis = axis
        self._folder = folder
        self._memory = memory
        self._publisher = publisher
        self._end = end
        self._noted: set[str] = set()

    def attend(self, ended: threading.Event) -> None:
        """Publish, and take requests, until the run has ended.

        In real time with the priority of the loop: whoever is kept from running while it holds the
        interpreter keeps the loop from it as well.
        """
        with real_time_priority() if self._axis.settings.real_time else nullcontext():
            self._attend(ended)

    def _attend(self, ended: threading.Event) -> None:
        mailbox, published_s = self._memory.mailbox, 0.0
        while not ended.wait(_POLL_S):
            # Whatever fails here must not be the end of the run, nor of this thread.
            with suppress(Exception):
                self._axis.look_at_beat()
                if mailbox.waiting():
                    self._answer(ended)
                if time.monotonic() - published_s >= _PUBLISH_S:
                    self.publish()
                    published_s = time.monotonic()
        if mailbox.waiting():
            mailbox.refuse(_ENDED)
        with suppress(Exception):
            self.publish(ended=True)

    def publish(self, ended: bool = False) -> None:
        """Publish how the run is, and what other processes have done without asking."""
        for what, happened in (
            ("stop", self._memory.controls.stopped),
            ("beat lost", self._axis.withdrawn),
        ):
            if happened and what not in self._noted:
                self._noted.add(what)
                self._note(what)
        self._publisher.publish(self._memory, ended)

    def _answer(self, ended: threading.Event) -> None:
        """Answer the request that waits."""
        mailbox = self._memory.mailbox
        try:
            request = parse_request(_decoded(mailbox.text()))
            cycle = self._put_in_force(request, ended)
        except Exception as error:  # whatever it is, the sender waits
            mailbox.refuse(str(error) or type(error).__name__)
        else:
            with suppress(Exception):
                self.publish()  # who asked reads what is in force now
            mailbox.accept(cycle)

    def _put_in_force(self, request: Request, ended: threading.Event) -> int:
        """Do what is requested; return the cycle from which on it is in force.

        Raises ConfigError for a change that is impossible, withdrawn, or too late, and RecordError
        for a mark that cannot be written.
        """
        match request:
            case ChangeWall() | TakeTurns():
                cycle = self._offer(request, ended)
                asked = request.model_dump(exclude={"do"}, exclude_none=True)
                self._note(request.do, cycle, **asked)
            case Mark():
                cycle = self._cycle
                try:
                    self._write(request.do, cycle, text=request.text)
                except OSError as error:
                    raise RecordError(f"{self._folder.events}: {reason(error)}") from None
            case WatchBeat():
                self._axis.watch_beat(request.timeout_s)
                cycle = self._note(request.do, timeout_s=request.timeout_s)
            case End():
                self._end()
                cycle = self._note(request.do)
            case _:
                assert_never(request)
        return cycle

    def _offer(self, request: ChangeWall | TakeTurns, ended: threading.Event) -> int:
        """Have the loop put a change into force."""
        axis, mailbox = self._axis, self._memory.mailbox
        offer = judged(axis, request)
        axis.offers.append(offer)
        while offer.since is None:
            if offer.outdated:
                offer = judged(axis, request)
                axis.offers.append(offer)
            elif (mailbox.withdrawn() or ended.is_set()) and axis.take_offer() is not None:
                raise ConfigError(_ENDED)
            time.sleep(_POLL_S)
            axis.look_at_beat()
        return offer.since

    @property
    def _cycle(self) -> int:
        return int(self._axis.cycle["j"][0])

    def _note(self, what: str, cycle: int | None = None, **more: Any) -> int:
        """Note an event, as far as the disk allows; return its cycle."""
        cycle = self._cycle if cycle is None else cycle
        with suppress(OSError):
            self._write(what, cycle, **more)
        return cycle

    def _write(self, what: str, cycle: int, **more: Any) -> None:
        t_s = cycle * self._axis.settings.bus.cycle_s
        self._folder.write_event({"cycle": cycle, "t_s": t_s, "what": what} | more)


def _decoded(text: bytes) -> Any:
    """Decode a request. Raises ConfigError if it is not JSON."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        raise ConfigError("a request has to be a JSON object") from None


def judged(axis: WallAxis, request: WallChange | TakeTurns) -> Offer:
    """Apply a change to the wall, the limits and so on that are in force.

    Raises ConfigError if the loop could not put the result into force.
    """
    revision = axis.revision  # first: whatever changes from now on outdates the offer
    if isinstance(request, TakeTurns):
        offer = _judged_turns(axis, request, revision)
    else:
        offer = _judged_change(axis, request, revision)
    rehearsal = copied(axis.cycle)
    for each in (*offer.turns, offer.wall):
        low, high = offer.limits.position_rad
        if not low < each.position_rad < high:
            raise ConfigError(
                f"position_rad = {each.position_rad:g} lies outside the run's "
                f"limits.position_rad = [{low:g}, {high:g}]"
            )
        _check_law(axis, each)
        try:
            check_divider(each, axis.settings.mechanics)
        except ValueError as error:
            raise ConfigError(str(error)) from None
        set_wall(rehearsal, each, axis.laws)
    set_limits(rehearsal, offer.limits)
    return offer


def _judged_change(axis: WallAxis, change: WallChange, revision: int) -> Offer:
    wall, limits = change.applied_to(axis.wall, axis.limits)
    _check_lower(limits, axis.limits)
    operator = changed(axis.operator, change.operator)
    if operator.adapt and not axis.settings.operator.adapt:
        raise ConfigError(
            "operator.adapt: the run began without adapting, so that its [mechanics] is with the "
            "hand; begin one with operator.adapt = true"
        )
    # A requested law ends the alternation; other changes apply to all alternating walls.
    walls = [axis.wall] if change.law else axis.turns
    turns = [change.applied_to(each, limits)[0] for each in walls]
    return Offer(revision, wall, limits, changed(axis.guard, change.guard), operator, turns)


def _judged_turns(axis: WallAxis, request: TakeTurns, revision: int) -> Offer:
    for i, change in enumerate(request.walls):
        for name in ("limits", "guard", "operator"):
            if getattr(change, name) is not None:
                raise ConfigError(f"walls.{i}.{name}: does not alternate; change it by itself")
    turns = [change.applied_to(axis.wall, axis.limits)[0] for change in request.walls]
    turns = turns or [axis.wall]
    return Offer(
        revision, turns[0], axis.limits, axis.guard, axis.operator, turns, begins_turns=True
    )


def _check_lower(limits: Limits, in_force: Limits) -> None:
    """Raise ConfigError for a limit that a request would raise."""
    for name in LimitsChange.model_fields:
        new, old = getattr(limits, name), getattr(in_force, name)
        if old is not None and new is not None and new > old:
            raise ConfigError(
                f"limits.{name} = {new:g}: {old:g} is in force, and while a wall is rendered a "
                f"limit only goes down"
            )


def _check_law(axis: WallAxis, wall: Wall) -> None:
    """Raise ConfigError unless the law is one of the run's and has the options of the wall."""
    known = {law.name: law for law in axis.laws}
    name = law_name(wall.law, wall.deadbeat)
    try:
        if name not in known and ":" not in name:
            find_law(wall.law, wall.deadbeat)  # says what is wrong with the name
        if name in known:
            known[name].option_values(wall.options)
    except UnknownLawError as error:
        raise ConfigError(f"law: {error}") from None
    if name not in known:
        raise not_of_the_run(name, known)


def not_of_the_run(name: str, known: Iterable[str]) -> ConfigError:
    """Return the error for a law that is none of those that the run may change to."""
    return ConfigError(
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
    with LiveRun.open(folder) as live:
        return live.request(_parse_change(assignments), _PATIENCE_S)


def _parse_change(assignments: Sequence[str]) -> Request:
    """Parse assignments. Raises ConfigError for an unknown key, or a value of a wrong type."""
    values: dict[str, Any] = {"do": "change"}
    for assignment in assignments:
        key, equals, value = assignment.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"{assignment!r}: has to be KEY=VALUE")
        if key.strip() == "do":
            raise ConfigError("do: unknown key; `canwall change` changes the wall alone")
        table = values
        *path, name = key.strip().removeprefix("wall.").split(".")
        for part in path:
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                raise ConfigError(f"{key.strip()}: {part} has a value of its own; keep one of them")
        if name in table:
            raise ConfigError(f"{key.strip()}: is given twice; keep one of them")
        table[name] = _parse_value(value)
    return parse_request(values)


def _parse_value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text.strip()  # a string without quotes
