"""The way out of a loop, whatever happens in it, and who looks at it from beside.

Every exit (end of the run, Ctrl-C, a trip, an exception, failure of the bus, a call that does not
come back) goes through `_take_down`: zero torque from the very next RPDO, then the CiA 402 state
machine down to SWITCH ON DISABLED, and only then the drive's watchdog off, which would otherwise
report the loss of its master.
"""

import gc
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial

import can

from canwall.cycle.exchange import Exchange
from canwall.cycle.loop import Loop, WallGivenUpError
from canwall.drive import DriveError
from canwall.errors import RunFailedError
from canwall.realtime import Grant, real_time_priority
from canwall.supervised import Call

#: Attempts to send NMT RESET NODE.
_RESETS = 2
#: Time without a frame, a cycle or a turn of the bus after which a call counts as one that does not
#: come back: if it waits, and if it computes, as the compiler does for long [s].
_STANDSTILL_S, _COMPUTING_S = 3.0, 60.0
#: Processor time after which a law counts as one that does not return: in real time [s, cycles],
#: and in simulated time, where nothing waits for it [s].
_LAW_S, _LAW_CYCLES, _SIMULATED_LAW_S = 0.02, 5, 0.5


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
    machine: dict[str, Grant] = field(default_factory=dict)
    """Grants of the machine to the loop."""
    error: BaseException | None = None
    """Failure of the program itself, which is raised once all else is done."""


def run_loop(
    exchange: Exchange,
    work: Callable[[Loop], bool],
    stop: Callable[[], bool] = lambda: False,
    progress: Callable[[int], None] = lambda j: None,
    prepared: AbstractContextManager[dict[str, Grant]] | None = None,
    outcome: Outcome | None = None,
) -> Outcome:
    """Enable the drives, do the work of the run, disable the drives.

    The loop has a thread of its own. The calling thread looks at its progress, and takes the drives
    down over another link if it does not get on.

    Args:
        exchange: Exchange of frames with the drives.
        work: Called by that thread with the loop once the drives are enabled; returns True if it
            was stopped before its end. `Loop.render` for one.
        stop: Called once a cycle, by the thread of the loop; True ends the run.
        progress: Called with the cycle about every 100 ms of bus time, by the same thread.
        prepared: Entered by the thread of the loop: the preparation of the machine.
        outcome: Filled with the outcome, which is there even if an exception is raised.

    Raises:
        BaseException: A failure of the program itself, or KeyboardInterrupt if the caller does not
            hold signals, once the drives have been taken down.
    """
    outcome = Outcome() if outcome is None else outcome
    loop = Loop(exchange, stop, progress)
    supervisor = _Supervisor(loop)
    # A collection would stop the cycle for milliseconds; the loop creates no reference cycles.
    gc.collect()
    gc.disable()
    try:
        supervisor.supervise(work, prepared or nullcontext({}), outcome)
    finally:
        gc.enable()
        outcome.cycles = loop.j
    error = outcome.error or supervisor.interruption
    if error is not None:
        raise error
    return outcome


def _run(
    loop: Loop,
    work: Callable[[Loop], bool],
    prepared: AbstractContextManager[dict[str, Grant]],
    outcome: Outcome,
) -> None:
    """Do what the thread of the loop has to do.

    The outcome tells of all that fails but the ladder itself. Raises what that raises.
    """
    with prepared as outcome.machine:
        try:
            loop.warm_up()
            loop.enable()
            outcome.interrupted = loop.stops() or work(loop)
        except WallGivenUpError as trip:
            outcome.trips.append(str(trip))
            outcome.trip_cycle = loop.trip_cycle
        except BaseException as error:
            _tell(outcome, error)
            outcome.trip_cycle = loop.j
        finally:
            _take_down(loop, outcome, partial(_attempt, loop), loop.leave)


def _tell(outcome: Outcome, error: BaseException) -> None:
    """Add an error to the trips; one of the program itself is kept as well."""
    text = _named(error)
    if text not in outcome.trips:
        outcome.trips.append(text)
    if not isinstance(error, (can.CanError, RunFailedError)):
        outcome.error = outcome.error or error


def _named(error: BaseException) -> str:
    if isinstance(error, can.CanError):
        return f"the bus failed: {error}"
    if isinstance(error, RunFailedError):
        return str(error)
    return f"the program failed: {type(error).__name__}: {error}"


#: Calls a rung of the ladder; returns what it raised, None if all went well.
_Attempt = Callable[[Callable[[], object]], BaseException | None]


def _attempt(loop: Loop, rung: Callable[[], object]) -> BaseException | None:
    """Try a rung of the ladder in this thread, unless another one has taken over."""
    try:
        loop.exchange.check_in_force()
        rung()
    except BaseException as error:
        return error
    return None


def _take_down(
    loop: Loop, outcome: Outcome, attempt: _Attempt, first: Callable[[], object]
) -> None:
    """Disable the drives by RPDO; over SDO if that fails or a trip leaves doubt; at last by NMT.

    Each rung is tried whatever the one before has raised.
    """
    failure = attempt(first)
    if failure is None and loop.is_down and not outcome.trips:
        outcome.disabled = True
    else:
        if failure is not None and _named(failure) not in outcome.trips:
            _tell(outcome, failure)
        elif not outcome.trips:
            outcome.trips.append("the drive does not follow its RPDOs any more; SDO disabled it")
        _take_down_without_cycle(loop, outcome, attempt)
    if outcome.disabled:
        failure = attempt(lambda: outcome.notes.extend(loop.disarm()))
        if failure is not None:
            outcome.notes.append(f"the drive's watchdog may stay set: {_named(failure)}")


def _take_down_without_cycle(loop: Loop, outcome: Outcome, attempt: _Attempt) -> None:
    failure = attempt(loop.disable_over_sdo)
    outcome.disabled = failure is None
    if failure is None:
        return
    why = str(failure) if isinstance(failure, DriveError) else _named(failure)
    was_sent = any(attempt(loop.reset) is None for _ in range(_RESETS))
    sent = "was sent" if was_sent else "could not be sent"
    outcome.trips.append(
        f"the drive did not confirm that it is disabled ({why}), NMT RESET NODE {sent}: "
        f"switch it off before you touch it"
    )


class _Supervisor:
    """Looks at the loop from another thread, and takes the drives down if it does not get on.

    Attributes:
        interruption: What was raised in this thread meanwhile, KeyboardInterrupt for one.
    """

    def __init__(self, loop: Loop) -> None:
        self._loop = loop
        self.interruption: BaseException | None = None

    def supervise(
        self,
        work: Callable[[Loop], bool],
        prepared: AbstractContextManager[dict[str, Grant]],
        outcome: Outcome,
    ) -> None:
        """Have the loop run to its end, or to that of this thread's patience."""
        loop, by_loop = self._loop, Outcome()
        with real_time_priority(above_loop=True) if loop.real_time else nullcontext():
            call = Call(
                lambda: _run(loop, work, prepared, by_loop),
                lambda: (loop.progress, loop.law_at_work()),
            )
            why = self._attend(call, partial(_hang, loop))
            # The thread of the loop may still come back, and have something to add.
            ended = replace(by_loop, trips=[*by_loop.trips], notes=[*by_loop.notes])
            vars(outcome).update(vars(ended))
            if why:
                outcome.trips.append(why)
                loop.change_link()
            elif call.error is not None:
                _tell(outcome, call.error)
            else:
                return
            if outcome.trip_cycle is None:
                outcome.trip_cycle = loop.j
            _take_down(loop, outcome, self._attempt, loop.send_zero)

    def _attend(self, call: Call, hang: Callable[[Call], str]) -> str:
        """Wait for the end of a call; return "", or why it was given up."""
        while True:
            try:
                if call.has_ended():
                    return ""
                if why := hang(call):
                    call.give_up()
                    return why
            except BaseException as interruption:
                self.interruption = self.interruption or interruption
                self._loop.interrupt()

    def _attempt(self, rung: Callable[[], object]) -> BaseException | None:
        """Try a rung of the ladder; the next one has another link if this one hangs."""
        call = Call(rung, lambda: self._loop.progress)
        why = self._attend(call, _standstill)
        if why:
            self._loop.change_link()
            return RunFailedError(why)
        return call.error


def _hang(loop: Loop, call: Call) -> str:
    """Return why the loop counts as hanging, with the law that does not return; else empty."""
    limit_s = max(_LAW_S, _LAW_CYCLES * loop.period_s) if loop.real_time else _SIMULATED_LAW_S
    # What was computed before an evaluation, as code that was compiled, is no law's.
    _, evaluating = call.seen
    if evaluating and call.computed_s >= limit_s:
        return f"{evaluating} has not returned for {call.computed_s:.2g} s"
    return _standstill(call)


def _standstill(call: Call) -> str:
    """Return why a call counts as one that does not come back, empty if it does not."""
    if call.waited_s < _STANDSTILL_S and call.computed_s < _COMPUTING_S:
        return ""
    return f"no answer from {call.place()} for {call.waited_s + call.computed_s:.2g} s"
