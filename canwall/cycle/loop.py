"""Loop of a run: enable, render, leave.

Every exit goes through the ladder of `way_out`. With several axes, the end of one ends all.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress

from canwall.cycle.axis import WallAxis, WallStage
from canwall.cycle.exchange import Exchange
from canwall.cycle.experiment import Experiment, ExperimentError
from canwall.cycle.state import (
    fade_in,
    fade_over,
    set_limits,
    set_wall,
    set_watching,
    start_at,
)
from canwall.cycle.trip_text import latest_emergency, shown_state, suspected, trip_text
from canwall.cycle.trips import Trip
from canwall.drive import (
    Controlword,
    DriveState,
    Enabling,
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


class WallGivenUpError(RunFailedError):
    """End of a wall before its time; the text gives the reason."""


class Loop:
    """Parts of a run: enable, render, leave. A caller that enables has to leave."""

    def __init__(
        self,
        exchange: Exchange,
        stop: Callable[[], bool] = lambda: False,
        progress: Callable[[int], None] = lambda j: None,
    ) -> None:
        self.exchange = exchange
        self._axes = exchange.axes
        self._link = exchange.link
        self._stop = stop
        self._progress = progress
        self._interrupted = False
        #: True once the drives have confirmed that they are disabled, to the cycle that leaves.
        self.is_down = False
        self._period = float(self._axes[0].cycle["period"][0])
        self._progress_every = max(1, round(0.1 / self._period))
        self._delay_tests: list[Experiment] = []
        if any(axis.measures_delay for axis in self._axes):
            # SciPy's optimizer takes some tenths of a second to load, so load it before any SYNC.
            from canwall.cycle.delay import DelayTest

            self._delay_tests = [DelayTest(axis) for axis in self._axes if axis.measures_delay]

    @property
    def j(self) -> int:
        """Number of cycles so far."""
        return int(self._axes[0].cycle["j"][0])

    @property
    def trip_cycle(self) -> int:
        """The first cycle without the wall after a trip: the next one if it came after the RPDO."""
        return self.j - (not any(axis.row["torque_cmd_per_mille"][0] for axis in self._axes))

    @property
    def real_time(self) -> bool:
        """True if the SYNCs follow the clock."""
        return self._axes[0].settings.real_time

    @property
    def progress(self) -> tuple[int, ...]:
        """A value that changes as long as the loop gets on."""
        return (*self.exchange.progress, self._link.turns)

    def interrupt(self) -> None:
        """End the wall as `stop` would; another thread may call this."""
        self._interrupted = True
        self.exchange.attend()

    def stops(self) -> bool:
        """Return True if the run is to end."""
        return self._interrupted or self._stop()

    @property
    def period_s(self) -> float:
        """Period of the SYNC [s]."""
        return self._period

    def law_at_work(self) -> str:
        """Return cycle and law that is being evaluated; empty if none is."""
        for axis in self._axes:
            if evaluated := int(axis.cycle["evaluated"][0]):
                name, at = axis.laws[evaluated - 1].name, self.j * self._period
                return self._say(axis, f"cycle {self.j} ({at:.3f} s): law {name}")
        return ""

    def change_link(self) -> None:
        """Leave the present link to a call that does not come back, and use another one."""
        self.exchange.retire()
        self._link = self._link.beside()
        for axis in self._axes:
            axis.node = axis.node.over(self._link)

    def warm_up(self) -> None:
        """Have the laws loaded."""
        self.exchange.warm_up()

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
            if self.stops():
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
                    raise WallGivenUpError(self._say(axis, silent + suspected(axis)))
            self.exchange.cycle()
            self._check()
        for axis, way in zip(self._axes, ways, strict=True):
            if not _advance_enabling(axis, way):
                stays = f"the drive stays in {shown_state(axis)}{latest_emergency(axis)}"
                stays += suspected(axis)
                raise WallGivenUpError(self._say(axis, stays))

    def _first_positions(self) -> None:
        waiting = list(self._axes)
        patience = _FIRST_CYCLES
        if self._axes[0].settings.real_time:
            patience = max(patience, round(_FIRST_S / self._period))
        for _ in range(patience):
            self.exchange.cycle()
            waiting = [axis for axis in waiting if not axis.row["received"][0]]
            if not waiting:
                break
        else:
            silent = f"no TPDO within {patience} SYNCs{suspected(waiting[0])}"
            raise WallGivenUpError(self._say(waiting[0], silent))
        for axis in self._axes:
            start_at(axis.cycle, int(axis.cycle["counts"][0]))

    def render(self, cycles: int | None) -> bool:
        """Render the walls up to the given cycle of the run; return True if stopped before.

        Raises WallGivenUpError at a trip, or if nothing is left for the walls.
        """
        if self.measure(self._delay_tests):
            return True
        if cycles is not None and self.j >= cycles:
            raise WallGivenUpError(
                f"run.duration_s was over before the wall began: enabling and measuring the delay "
                f"took {self.j * self._period:.3g} s; make it longer"
            )
        for axis in self._axes:
            # The handle may be inside the wall, so the force fades in.
            fade_in(axis.cycle, round(axis.settings.run.ramp_in_s / self._period))
        self._enter(Phase.RENDERING)
        pending = [(axis, list(axis.changes)) for axis in self._axes]
        while cycles is None or self.j < cycles:
            if self.stops():
                return True
            for axis, changes in pending:
                _change(axis, changes, self._period)
            self.exchange.cycle(self._most(cycles, pending))
            self._check()
            if self.j % self._progress_every == 0:
                self._progress(self.j)
        return False

    def _most(self, cycles: int | None, pending: list[tuple[WallAxis, list[WallStage]]]) -> int:
        """Return the number of cycles to the end, the next progress report or the next change."""
        ends = [self.j + self.exchange.ahead]
        ends.append((self.j // self._progress_every + 1) * self._progress_every)
        if cycles is not None:
            ends.append(cycles)
        for axis, changes in pending:
            ends += [change.j for change in changes[:1]]
            # A change waits until the previous one is complete.
            if fading := int(axis.cycle["fade_left"][0]):
                ends.append(self.j + fading)
        return max(1, min(ends) - self.j)

    def measure(self, experiments: Sequence[Experiment]) -> bool:
        """Make experiments together; return True if stopped before the end.

        Raises WallGivenUpError at a trip, and where an experiment cannot go on.
        """
        if not experiments:
            return False
        self._enter(Phase.MEASURING)
        try:
            while running := [each for each in experiments if each.excite()]:
                if self.stops():
                    return True
                self.exchange.cycle()
                self._check()
                for experiment in running:
                    experiment.note()
                if self.j % self._progress_every == 0:
                    self._progress(self.j)
            for experiment in experiments:
                experiment.conclude()
        except ExperimentError as error:
            raise WallGivenUpError(self._say(error.axis, str(error))) from None
        return False

    def _check(self) -> None:
        for axis in self._axes:
            axis.look_at_beat()
            if axis.cycle["trip"][0]:
                raise WallGivenUpError(self._say(axis, trip_text(axis, self.exchange)))

    def leave(self) -> bool:
        """Take the state machines down with zero torque; return True if the drives confirm it."""
        self.is_down = self._leave()
        return self.is_down

    def _leave(self) -> bool:
        self._enter(Phase.LEAVING)
        if any(axis.cycle["trip"][0] == Trip.MISSED_TPDO for axis in self._axes):
            # A silent drive may still receive: command a quick stop, whatever its state.
            for axis in self._axes:
                axis.cycle["controlword"] = Controlword.QUICK_STOP
            self.exchange.cycle()
        unheard = any(axis.cycle["trip"][0] == Trip.TORQUE for axis in self._axes)
        # By way of SWITCHED ON a drive may slow the handle down first, with a torque of its own
        # (0x605C).
        for axis in self._axes:
            axis.cycle["controlword"] = Controlword.DISABLE_VOLTAGE
        patience = max(_LEAVE_CYCLES, round(_LEAVE_S / self._period))
        for _ in range(_LAST_RPDOS if unheard else patience):
            if all(_is_down(axis) for axis in self._axes):
                return True
            if all(_is_down(axis) or _is_silent(axis) for axis in self._axes):
                return False
            self.exchange.cycle()
        return False

    def send_zero(self) -> None:
        """Disable the drives by RPDOs without a cycle. Raises can.CanError."""
        for _ in range(_LAST_RPDOS):
            self.exchange.send_zero(self._link)

    def disable_over_sdo(self) -> None:
        """Disable the drives over SDO.

        Raises:
            BaseException: What failed last, after an attempt with each of them.
        """
        _for_each(self._axes, _disable_over_sdo)

    def reset(self) -> None:
        """Send NMT RESET NODE, which ends any torque of the drives.

        Raises:
            BaseException: What failed last, after an attempt with each of them.
        """
        _for_each(self._axes, lambda axis: axis.node.command("RESET"))

    def disarm(self) -> list[str]:
        """Switch the watchdogs off; return one line for each drive that refuses."""
        refused = []
        for axis in self._axes:
            try:
                disarm(axis.node, axis.setup.rpdo, axis.setup.watchdog)
            except Exception as error:
                stays = f"the drive's watchdog ({axis.setup.watchdog.kind}) stays set: {error}"
                refused.append(self._say(axis, stays))
        return refused


def _for_each(axes: Sequence[WallAxis], action: Callable[[WallAxis], None]) -> None:
    """Act on each axis, whatever that raises for the others; raise the last error in the end."""
    failed: BaseException | None = None
    for axis in axes:
        try:
            action(axis)
        except BaseException as error:
            failed = error
    if failed is not None:
        raise failed


def _disable_over_sdo(axis: WallAxis) -> None:
    try:
        disable(axis.node)
    except BaseException:
        with suppress(BaseException):
            axis.node.write(od.TARGET_TORQUE, 0, 0)
        raise
    axis.node.write(od.TARGET_TORQUE, 0, 0)


def _change(axis: WallAxis, changes: list[WallStage], period: float) -> None:
    """Apply the changes of wall and limits that are due, each after the previous is complete."""
    cycle = axis.cycle
    if cycle["fade_left"][0]:
        return
    j = int(cycle["j"][0])
    due = bool(changes) and changes[0].j <= j
    turns = len(axis.turns) > 1 and cycle["strikes"][0] >= axis.next_turn
    if turns:
        axis.wall = axis.turns[(axis.next_turn - axis.turns_since) % len(axis.turns)]
        axis.next_turn += 1
    while changes and changes[0].j <= j:
        change = changes.pop(0)
        axis.wall, axis.limits = change.wall, change.limits
        axis.guard = change.guard or axis.guard
        axis.operator = change.operator or axis.operator
        axis.turns = axis.settings.laws_in_turn(change.wall)
    if not (due or turns) and not _accept_offer(axis, j):
        return
    axis.revision += 1
    fade_over(cycle, round(axis.settings.run.blend_s / period))
    set_wall(cycle, axis.wall, axis.laws)
    set_limits(cycle, axis.limits)
    set_watching(cycle, axis.guard, axis.operator)


def _accept_offer(axis: WallAxis, j: int) -> bool:
    """Take a requested change over if it was judged against what is in force."""
    offer = axis.take_offer()
    if offer is None:
        return False
    if offer.revision != axis.revision:
        offer.outdated = True
        return False
    axis.wall, axis.limits, axis.turns = offer.wall, offer.limits, offer.turns
    axis.guard, axis.operator = offer.guard, offer.operator
    if offer.begins_turns:
        axis.turns_since = int(axis.cycle["strikes"][0])
        axis.next_turn = axis.turns_since + 1
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
