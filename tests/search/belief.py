"""State machine over pairs: what a drive is, and what its master takes it for."""

import threading
from collections import Counter
from collections.abc import Callable
from typing import ClassVar

from adversary import (
    KINDS,
    Act,
    Duel,
    Frame,
    Master,
    Pair,
    fast_duels,
    forged_to_drive,
    forged_to_master,
)
from hypothesis import HealthCheck, seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    rule,
    run_state_machine_as_test,
)

_CYCLES, _STEPS = 400, 30
#: Times that a master may stand still [s]: shorter and longer than the watchdog waits.
_STALLS_S = (0.1, 5.0, 29.0, 31.0, 100.0)


class Stepped:
    """A function in a thread of its own, which goes on only when it is told to."""

    def __init__(self, function: Callable[[], None]) -> None:
        self._function = function
        self._go, self._stands = threading.Semaphore(0), threading.Semaphore(0)
        self.ended = False
        self.error: BaseException | None = None
        threading.Thread(target=self._run, daemon=True).start()

    def step(self) -> None:
        """Go on to the next `pause`, or the end."""
        if not self.ended:
            self._go.release()
            self._stands.acquire()

    def pause(self) -> None:
        """Stand still; called by the function."""
        self._stands.release()
        self._go.acquire()

    def _run(self) -> None:
        self._go.acquire()
        try:
            self._function()
        except BaseException as error:
            self.error = error
        finally:
            self.ended = True
            self._stands.release()


class Belief(RuleBasedStateMachine):
    """Master and drive, frame by frame; rules are what may happen to either, or on the bus."""

    #: Pairs that were seen, and how often; the machines so far.
    pairs: ClassVar[Counter[Pair]] = Counter()
    machines: ClassVar[int] = 0

    tell: ClassVar[Callable[[int], None]] = staticmethod(lambda done: None)

    @initialize(native=st.booleans(), phase=st.sampled_from(["set up", "enabling", "rendering"]))
    def begin(self, native: bool, phase: str) -> None:
        self.duel = Duel(native=native)
        self.master = Master(self.duel, _CYCLES)
        self.thread = Stepped(self.master.run)
        self.duel.adversary.before_frame = self.thread.pause
        while self.master.belief != phase and not self.thread.ended:
            self.thread.step()

    @rule(frames=st.integers(1, 80))
    def go_on(self, frames: int) -> None:
        for _ in range(frames):
            self.thread.step()
            self.master.note()

    @rule(
        kind=st.sampled_from([kind for kind in KINDS if not kind.startswith(("to ", "gone"))]),
        number=st.integers(0, 63) | st.integers(0, 400),
    )
    def frame_meets_something(self, kind: str, number: int) -> None:
        self._do(Act(kind, 0, number))

    @rule(frame=forged_to_master)
    def master_gets_a_forged_frame(self, frame: Frame) -> None:
        self._do(Act("to master", frame=frame))

    @rule(frame=forged_to_drive)
    def drive_gets_a_forged_frame(self, frame: Frame) -> None:
        self._do(Act("to drive", frame=frame))

    @rule(duration_s=st.sampled_from(_STALLS_S))
    def master_stands_still(self, duration_s: float) -> None:
        self.duel.stand_still(duration_s)
        self.go_on(1)

    @rule()
    def master_is_asked_to_end(self) -> None:
        self.master.stops = True

    @rule()
    def master_is_killed(self) -> None:
        self.duel.adversary.master_is_gone = True

    @invariant()
    def nothing_was_wrong(self) -> None:
        if getattr(self, "thread", None) is not None and self.thread.error is not None:
            raise self.thread.error

    def teardown(self) -> None:
        if not hasattr(self, "thread"):
            return
        self.duel.adversary.before_frame = lambda: None
        while not self.thread.ended:
            self.thread.step()
        Belief.pairs.update(self.master.pairs)
        Belief.machines += 1
        Belief.tell(Belief.machines)
        try:
            self.nothing_was_wrong()
            self.duel.settle()
        finally:
            self.duel.close()

    def _do(self, act: Act) -> None:
        self.duel.adversary.plan([act])
        self.go_on(1)


def pairs(
    first: int, examples: int, tell: Callable[[int], None] = lambda done: None
) -> dict[str, object]:
    """Play so many machines, and return the pairs that were reached, and how often.

    Args:
        first: seed.
        examples: number of machines.
        tell: called with the machines so far.
    """
    Belief.pairs, Belief.machines = Counter(), 0
    Belief.tell = staticmethod(tell)
    given = settings(
        max_examples=examples,
        stateful_step_count=_STEPS,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    with fast_duels():
        run_state_machine_as_test(seed(first)(Belief), settings=given)
    return {
        "machines": Belief.machines,
        "pairs": {
            f"{state}, {'torque' if torque else 'no torque'}; master: {belief}": count
            for (state, torque, belief), count in Belief.pairs.most_common()
        },
    }
