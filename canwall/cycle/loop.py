"""Loop of a run: enable, render, leave, with a single way out whatever happens in between.

Every exit (end of the run, Ctrl-C, a trip, an exception, failure of the bus) goes through `_leave`:
zero torque from the very next RPDO, then the CiA 402 state machine down to SWITCH ON DISABLED, and
only then the drive's watchdog off, which would otherwise report the loss of its master.
With several axes, the end of one ends all.
"""

import gc
from collections.abc import Callable
from dataclasses import dataclass, field

import can

from canwall.cycle.axis import WallAxis, WallStage
from canwall.cycle.exchange import Exchange
from canwall.cycle.state import fade_in, fade_over, set_delay, set_limits, set_wall, start_at
from canwall.cycle.trip_text import latest_emergency, shown_state, trip_text
from canwall.cycle.trips import Trip
from canwall.drive import (
    Controlword,
    DriveError,
    DriveState,
    Enabling,
    controlword_down,
    disable,
    disarm,
    state_of,
)
from canwall.drive import objects as od
from canwall.errors import RunFailedError
from canwall.record import Phase

#: Cycles within which a drive has to reach OPERATION ENABLED.
_ENABLE_CYCLES = 2000
#: Time for a drive to leave OPERATION ENABLED by RPDO before it is disabled by SDO [s, cycles].
_LEAVE_S, _LEAVE_CYCLES = 0.1, 20
#: Cycles without a TPDO after which a drive counts as silent while enabling and leaving.
_SILENT_CYCLES = 50
#: SYNCs with RPDOs that disable a drive although it no longer seems to follow them.
_LAST_RPDOS = 5
#: States in which a drive gives no torque until it is enabled again.
_DISABLED = (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT)
#: Cycles before enabling within which position and statusword have to arrive, and the least time
#: in real time [s], in which master or drive may be delayed.
_FIRST_CYCLES, _FIRST_S = 10, 0.2


@dataclass
class Outcome:
    """End of a run."""

    cycles: int = 0
    interrupted: bool = False
    trips: list[str] = field(default_factory=list)
    trip_cycle: int | None = None
    """Cycle at which a limit was exceeded, or a report ended the wall."""
    disabled: bool = False
    notes: list[str] = field(default_factory=list)
    """Steps of the way out that the drives refused, although they are disabled."""


class WallGivenUpError(RunFailedError):
    """End of a wall before its time; the text gives the reason."""


def run_loop(
    exchange: Exchange,
    cycles: int | None,
    stop: Callable[[], bool],
    progress: Callable[[int], None] = lambda j: None,
) -> Outcome:
    """Enable the drives, render the walls, disable the drives.

    Args:
        exchange: Exchange of frames with the drives.
        cycles: Number of SYNCs with the wall rendered, None for a run until it is stopped.
        stop: Called once a cycle; True ends the run.
        progress: Called with the cycle about every 100 ms of bus time.
    """
    outcome = Outcome()
    loop = Loop(exchange, stop, progress)
    # A collection would stop the cycle for milliseconds; the loop creates no reference cycles.
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        loop.enable()
        outcome.interrupted = loop.render(cycles)
    except WallGivenUpError as trip:
        outcome.trips.append(str(trip))
        outcome.trip_cycle = loop.j - 1
    except can.CanError as error:
        outcome.trips.append(f"the bus failed: {error}")
        outcome.trip_cycle = loop.j
    finally:
        try:
            _leave(loop, outcome)
            if outcome.disabled:
                outcome.notes = loop.disarm()
        finally:
            gc.enable()
            gc.unfreeze()
            outcome.cycles = loop.j
    return outcome


def _leave(loop: "Loop", outcome: Outcome) -> None:
    """Disable by RPDO; over SDO if that fails or a trip leaves doubt; as a last resort by NMT."""
    try:
        outcome.disabled = loop.leave()
        if outcome.disabled and not outcome.trips:
            return
        if not outcome.trips:
            outcome.trips.append("the drive does not follow its RPDOs any more; SDO disabled it")
    except can.CanError as error:
        if f"the bus failed: {error}" not in outcome.trips:
            outcome.trips.append(f"the bus failed while leaving: {error}")
    try:
        loop.disable_over_sdo()
        outcome.disabled = True
    except DriveError as error:
        outcome.disabled = False
        sent = "was sent" if loop.reset() else "could not be sent"
        outcome.trips.append(
            f"the drive did not confirm that it is disabled ({error}), NMT RESET NODE {sent}: "
            f"switch it off before you touch it"
        )


class Loop:
    """Parts of a run: enable, render, leave. A caller that enables has to leave."""

    def __init__(
        self,
        exchange: Exchange,
        stop: Callable[[], bool] = lambda: False,
        progress: Callable[[int], None] = lambda j: None,
    ) -> None:
        self._exchange = exchange
        self._axes = exchange.axes
        self._stop = stop
        self._progress = progress
        self._period = float(self._axes[0].cycle["period"][0])
        self._progress_every = max(1, round(0.1 / self._period))
        self._delay_tests = []
        if any(axis.measures_delay for axis in self._axes):
            # SciPy's optimizer takes some tenths of a second to load, so load it before any SYNC.
            from canwall.cycle.delay import DelayTest

            self._delay_tests = [DelayTest(axis) for axis in self._axes if axis.measures_delay]

    @property
    def j(self) -> int:
        """Number of cycles so far."""
        return int(self._axes[0].cycle["j"][0])

    def _enter(self, phase: Phase) -> None:
        for axis in self._axes:
            axis.cycle["phase"] = phase

    def _say(self, axis: WallAxis, text: str) -> str:
        return text if len(self._axes) == 1 else f"{axis.name}: {text}"

    def enable(self) -> None:
        """Take the state machines up to OPERATION ENABLED with zero torque.

        Raises WallGivenUpError if a drive does not follow.
        """
        self._enter(Phase.ENABLING)
        self._first_positions()
        ways = [Enabling() for _ in self._axes]
        for _ in range(_ENABLE_CYCLES):
            if self._stop():
                return
            enabled = [_advance_enabling(*pair) for pair in zip(self._axes, ways, strict=True)]
            if all(enabled):
                return
            for axis, way in zip(self._axes, ways, strict=True):
                if way.gave_up:
                    returns = f"the fault comes back after every reset{latest_emergency(axis)}"
                    raise WallGivenUpError(self._say(axis, returns))
                if _is_silent(axis):
                    silent = f"no TPDO for {_SILENT_CYCLES} cycles while enabling"
                    raise WallGivenUpError(self._say(axis, silent))
            self._exchange.cycle()
            self._check()
        for axis, way in zip(self._axes, ways, strict=True):
            if not _advance_enabling(axis, way):
                stays = f"the drive stays in {shown_state(axis)}{latest_emergency(axis)}"
                raise WallGivenUpError(self._say(axis, stays))

    def _first_positions(self) -> None:
        waiting = list(self._axes)
        patience = _FIRST_CYCLES
        if self._axes[0].settings.real_time:
            patience = max(patience, round(_FIRST_S / self._period))
        for _ in range(patience):
            self._exchange.cycle()
            waiting = [axis for axis in waiting if not axis.row["received"][0]]
            if not waiting:
                break
        else:
            raise WallGivenUpError(self._say(waiting[0], f"no TPDO within {patience} SYNCs"))
        for axis in self._axes:
            start_at(axis.cycle, int(axis.cycle["counts"][0]))

    def render(self, cycles: int | None) -> bool:
        """Render the walls for the given cycles; return True if stopped before their end.

        Raises WallGivenUpError at a trip.
        """
        if self._stop() or self._measure_delays():
            return True
        for axis in self._axes:
            # The handle may be inside the wall, so the force fades in.
            fade_in(axis.cycle, round(axis.settings.run.ramp_in_s / self._period))
        self._enter(Phase.RENDERING)
        pending = [(axis, list(axis.changes)) for axis in self._axes]
        while cycles is None or self.j < cycles:
            if self._stop():
                return True
            for axis, changes in pending:
                _change(axis, changes, self._period)
            self._exchange.cycle(self._most(cycles, pending))
            self._check()
            if self.j % self._progress_every == 0:
                self._progress(self.j)
        return False

    def _most(self, cycles: int | None, pending: list[tuple[WallAxis, list[WallStage]]]) -> int:
        """Return the number of cycles to the end, the next progress report or the next change."""
        ends = [self.j + self._exchange.ahead]
        ends.append((self.j // self._progress_every + 1) * self._progress_every)
        if cycles is not None:
            ends.append(cycles)
        for axis, changes in pending:
            ends += [change.j for change in changes[:1]]
            # A change waits until the previous one is complete.
            if fading := int(axis.cycle["fade_left"][0]):
                ends.append(self.j + fading)
        return max(1, min(ends) - self.j)

    def _measure_delays(self) -> bool:
        """Measure the delay of the axes that need it; return True if stopped before the end."""
        tests = self._delay_tests
        if not tests:
            return False
        self._enter(Phase.MEASURING)
        for _ in range(max(test.cycles for test in tests)):
            if self._stop():
                return True
            for test in tests:
                test.excite()
            self._exchange.cycle()
            self._check()
            for test in tests:
                test.note()
        for test in tests:
            try:
                axis = test.axis
                axis.delay = test.delay()
                set_delay(axis.cycle, axis.settings, axis.delay)
            except ValueError as error:
                raise WallGivenUpError(self._say(test.axis, str(error))) from None
        return False

    def _check(self) -> None:
        for axis in self._axes:
            if axis.cycle["trip"][0]:
                raise WallGivenUpError(self._say(axis, trip_text(axis, self._exchange)))

    def leave(self) -> bool:
        """Take the state machines down with zero torque; return True if the drives confirm it."""
        self._enter(Phase.LEAVING)
        if any(axis.cycle["trip"][0] == Trip.MISSED_TPDO for axis in self._axes):
            # A silent drive may still receive: command a quick stop, whatever its state.
            for axis in self._axes:
                axis.cycle["controlword"] = Controlword.QUICK_STOP
            self._exchange.cycle()
        unheard = any(axis.cycle["trip"][0] == Trip.TORQUE for axis in self._axes)
        patience = max(_LEAVE_CYCLES, round(_LEAVE_S / self._period))
        for _ in range(_LAST_RPDOS if unheard else patience):
            for axis in self._axes:
                state = state_of(int(axis.cycle["statusword"][0]))
                axis.cycle["controlword"] = controlword_down(state)
            if all(_is_down(axis) for axis in self._axes):
                return True
            if all(_is_down(axis) or _is_silent(axis) for axis in self._axes):
                return False
            self._exchange.cycle()
        return False

    def disable_over_sdo(self) -> None:
        """Disable the drives over SDO. Raises DriveError after an attempt with each of them."""
        failed: DriveError | None = None
        for axis in self._axes:
            try:
                disable(axis.node)
                axis.node.write(od.TARGET_TORQUE, 0, 0)
            except DriveError as error:
                failed = error
        if failed is not None:
            raise failed

    def disarm(self) -> list[str]:
        """Switch the watchdogs off; return one line for each drive that refuses."""
        refused = []
        for axis in self._axes:
            try:
                disarm(axis.node, axis.setup.rpdo, axis.setup.watchdog)
            except (DriveError, can.CanError) as error:
                stays = f"the drive's watchdog ({axis.setup.watchdog.kind}) stays set: {error}"
                refused.append(self._say(axis, stays))
        return refused

    def reset(self) -> bool:
        """Send NMT RESET NODE, which ends any torque of the drives; return True if it was sent."""
        try:
            for axis in self._axes:
                axis.node.command("RESET")
        except can.CanError:
            return False
        return True


def _change(axis: WallAxis, changes: list[WallStage], period: float) -> None:
    """Apply the changes of wall and limits that are due, each after the previous is complete."""
    cycle = axis.cycle
    if cycle["fade_left"][0]:
        return
    j = int(cycle["j"][0])
    due = bool(changes) and changes[0].j <= j
    turns = len(axis.turns) > 1 and cycle["strikes"][0] >= axis.next_turn
    if turns:
        axis.wall = axis.turns[axis.next_turn % len(axis.turns)]
        axis.next_turn += 1
    while changes and changes[0].j <= j:
        change = changes.pop(0)
        axis.wall, axis.limits = change.wall, change.limits
        axis.turns = axis.settings.laws_in_turn(change.wall)
    if not (due or turns) and not _accept_offer(axis, j):
        return
    axis.revision += 1
    fade_over(cycle, round(axis.settings.run.blend_s / period))
    set_wall(cycle, axis.wall, axis.laws)
    set_limits(cycle, axis.limits)


def _accept_offer(axis: WallAxis, j: int) -> bool:
    """Take a requested change over if it was judged against what is in force."""
    offer = axis.take_offer()
    if offer is None:
        return False
    if offer.revision != axis.revision:
        offer.outdated = True
        return False
    axis.wall, axis.limits, axis.turns = offer.wall, offer.limits, offer.turns
    offer.since = j
    return True


def _advance_enabling(axis: WallAxis, way: Enabling) -> bool:
    """Set the controlword towards OPERATION ENABLED; return True once the drive is in it."""
    statusword = int(axis.cycle["statusword"][0])
    axis.cycle["controlword"] = way.next(statusword)
    return state_of(statusword) is DriveState.OPERATION_ENABLED


def _is_down(axis: WallAxis) -> bool:
    """Return True if the drive, since the loop began to leave, has reported no torque."""
    state = state_of(int(axis.cycle["statusword"][0]))
    return state in _DISABLED and bool(axis.row["phase"][0] == Phase.LEAVING)


def _is_silent(axis: WallAxis) -> bool:
    return bool(axis.cycle["missed_in_a_row"][0] >= _SILENT_CYCLES)
