"""The loop: enable, render, leave. One way in and one way out, whatever happens in between.

Every exit (time is up, Ctrl-C, a trip, an exception, a bus that fails) goes through `_leave`:
torque zero from the very next RPDO, then the CiA 402 state machine down to SWITCH ON DISABLED.
"""

import gc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import can
import numpy as np
from numpy.typing import NDArray

from canwall.config import Wall
from canwall.cycle.exchange import PythonCanExchange
from canwall.cycle.step import Trip, set_wall, start_at
from canwall.drive import (
    Controlword,
    DriveError,
    DriveNode,
    State,
    controlword_down,
    controlword_up,
    state_of,
)
from canwall.drive import objects as od
from canwall.record import Phase
from canwall.walls import Law

#: Cycles within which a drive has to reach OPERATION ENABLED, and to leave it.
_ENABLE_CYCLES = 2000
_LEAVE_CYCLES = 500
#: Cycles without a TPDO after which a drive is taken for gone while enabling and leaving.
_SILENT_CYCLES = 50
#: States in which a drive gives no torque until it is enabled anew.
_DISABLED = (State.SWITCH_ON_DISABLED, State.FAULT)
#: Cycles before enabling in which position and statusword have to arrive.
_FIRST_CYCLES = 10


@dataclass(frozen=True)
class Change:
    """From cycle j on, this is the wall."""

    j: int
    wall: Wall


@dataclass
class Outcome:
    """How the loop ended."""

    cycles: int = 0
    interrupted: bool = False
    trips: list[str] = field(default_factory=list)
    disabled: bool = False


class _WallGivenUpError(Exception):
    """The wall is given up; the text says why."""


def run_loop(
    exchange: PythonCanExchange,
    cycle: NDArray[np.void],
    node: DriveNode,
    laws: Sequence[Law],
    changes: Sequence[Change],
    cycles: int | None,
    stop: Callable[[], bool],
    progress: Callable[[int], None] = lambda j: None,
) -> Outcome:
    """Enable the drive, render the wall for `cycles` SYNCs (None: until stopped), disable it.

    cycle is the record that the exchange works on; changes are in the order of j; stop is asked
    once a cycle; progress is told the cycle about every 100 ms of bus time.
    """
    outcome = Outcome()
    loop = _Loop(exchange, cycle, node, laws, list(changes), stop, progress)
    # A collection would stop the cycle for milliseconds; nothing in it makes reference cycles.
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        loop.enable()
        outcome.interrupted = loop.render(cycles)
    except _WallGivenUpError as trip:
        outcome.trips.append(str(trip))
    except can.CanError as error:
        outcome.trips.append(f"the bus failed: {error}")
    finally:
        try:
            _leave(loop, outcome)
        finally:
            gc.enable()
            gc.unfreeze()
            outcome.cycles = loop.j
    if not outcome.disabled and not outcome.trips:
        outcome.trips.append("the drive did not confirm that it is disabled")
    return outcome


def _leave(loop: "_Loop", outcome: Outcome) -> None:
    try:
        outcome.disabled = loop.leave()
        return
    except can.CanError as error:
        outcome.trips.append(f"the bus failed while leaving: {error}")
    # The cycle is gone; SDO may still get through.
    try:
        outcome.disabled = loop.disable_over_sdo()
    except DriveError as error:
        outcome.trips.append(f"the drive could not be disabled: {error}")


class _Loop:
    def __init__(
        self,
        exchange: PythonCanExchange,
        cycle: NDArray[np.void],
        node: DriveNode,
        laws: Sequence[Law],
        changes: list[Change],
        stop: Callable[[], bool],
        progress: Callable[[int], None],
    ) -> None:
        self._exchange = exchange
        self._cycle = cycle
        self._record = cycle[0]
        self._node = node
        self._laws = laws
        self._changes = changes
        self._stop = stop
        self._progress = progress
        self._progress_every = max(1, round(0.1 / float(cycle["period"][0])))

    @property
    def j(self) -> int:
        return int(self._record["j"])

    def enable(self) -> None:
        """Zero torque and the state machine up; refuses to start inside the wall."""
        self._record["phase"] = Phase.ENABLING
        self._first_position()
        for _ in range(_ENABLE_CYCLES):
            if self._stop():
                return
            state = state_of(int(self._record["statusword"]))
            previous = int(self._record["controlword"])
            self._record["controlword"] = controlword_up(state, previous)
            if state is State.OPERATION_ENABLED:
                return
            if self._silent():
                raise _WallGivenUpError(f"no TPDO for {_SILENT_CYCLES} cycles while enabling")
            self._exchange.cycle()
        raise _WallGivenUpError(f"the drive stays in {self._state()}{self._emergency()}")

    def _first_position(self) -> None:
        for _ in range(_FIRST_CYCLES):
            self._exchange.cycle()
            if self._exchange.row["received"][0]:
                break
        else:
            raise _WallGivenUpError(f"no TPDO within {_FIRST_CYCLES} SYNCs")
        start_at(self._cycle, int(self._record["counts"]))
        y = float(self._exchange.row["y"][0])
        if y < 0.0:
            raise _WallGivenUpError(
                f"the handle is {-y:.3g} rad inside the wall: move it out, or wall.position_rad"
            )

    def render(self, cycles: int | None) -> bool:
        """The wall until time is up; whether it was stopped before."""
        self._record["phase"] = Phase.RENDERING
        pending = list(self._changes)
        record, exchange = self._record, self._exchange
        while cycles is None or self.j < cycles:
            if self._stop():
                return True
            while pending and pending[0].j <= self.j:
                set_wall(self._cycle, pending.pop(0).wall, self._laws)
            exchange.cycle()
            if record["trip"]:
                raise _WallGivenUpError(self._trip_text())
            if self.j % self._progress_every == 0:
                self._progress(self.j)
        return False

    def leave(self) -> bool:
        """Zero torque and the state machine down; whether the drive confirmed it."""
        record = self._record
        record["phase"] = Phase.LEAVING
        if record["trip"] == Trip.MISSED_TPDO:
            # The drive may hear though it is not heard: quick stop, whatever its state.
            record["controlword"] = Controlword.QUICK_STOP
            self._exchange.cycle()
        for _ in range(_LEAVE_CYCLES):
            state = state_of(int(record["statusword"]))
            record["controlword"] = controlword_down(state)
            if state in _DISABLED and self._exchange.row["phase"][0] == Phase.LEAVING:
                return True
            if self._silent():
                return False
            self._exchange.cycle()
        return False

    def disable_over_sdo(self) -> bool:
        """Zero torque and no voltage without the cycle; whether the drive confirmed it."""
        self._node.write(od.TARGET_TORQUE, 0, 0)
        self._node.write(od.CONTROLWORD, 0, Controlword.DISABLE_VOLTAGE)
        return state_of(self._node.read(od.STATUSWORD)) in _DISABLED

    def _silent(self) -> bool:
        return bool(self._record["missed_in_a_row"] >= _SILENT_CYCLES)

    def _state(self) -> str:
        statusword = int(self._record["statusword"])
        return f"{state_of(statusword)} (statusword {statusword:#06x})"

    def _emergency(self) -> str:
        if not self._node.emergencies:
            return ""
        latest = self._node.emergencies[-1]
        return f"; EMCY {latest.code:#06x} ({latest.get_desc() or 'no description'})"

    def _trip_text(self) -> str:
        record, j = self._record, self.j - 1
        position = float(record["counts"]) * float(record["rad_per_count"])
        match Trip(int(record["trip"])):
            case Trip.SPEED:
                speed = float(record["estimator"]["v"][0])
                what = f"speed {speed:.3g} rad/s beyond limits.speed_rad_s"
            case Trip.POSITION:
                what = f"position {position:.4g} rad outside limits.position_rad"
            case Trip.MISSED_TPDO:
                what = f"no TPDO for {int(record['missed_in_a_row'])} cycles"
            case Trip.NOT_ENABLED:
                what = f"the drive left OPERATION ENABLED: {self._state()}{self._emergency()}"
            case _:
                law = self._laws[int(record["law"])].name
                what = f"law {law} gave a force that is not a number"
        return f"cycle {j} ({j * float(record['period']):.3f} s): {what}"
