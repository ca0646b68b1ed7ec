"""A bus on which anything may happen to a frame, between a master and its drive.

Frames are lost, late, doubled, reordered, cut, changed and forged, in both directions. What is not
forged is another master: SDO requests and RPDOs that nobody has sent. Such a one is obeyed, as CAN
has no senders, and what it leaves behind is its own affair.
"""

import types
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, TypeAlias, cast
from unittest.mock import patch

import canopen.sdo
import rig
from hypothesis import strategies as st
from rig import RPDO1, SDO_ANSWER, SYNC, TPDO1, Loop, Rig, settings_with

import canwall.cycle.exchange
import canwall.cycle.way_out
import canwall.drive.setup
import canwall.simdrive.communication.dictionary as drive_dictionary
from canwall.config import Settings
from canwall.drive import DriveError, DriveState, state_of
from canwall.errors import RunFailedError
from canwall.record import Phase
from canwall.simdrive import BusRunner, FaultyDrive, Frame, ServoDrive
from canwall.simdrive.state import STATUSWORD, TORQUE

Way: TypeAlias = Literal["received", "sent"]
"""Direction of a frame, as the drive sees it."""

NODE_ID = 5
NMT, EMCY, HEARTBEAT = 0x000, 0x080 + NODE_ID, 0x700 + NODE_ID

#: States in which a drive may give a torque: of the master, or its own to come to rest.
POWERED = (
    DriveState.OPERATION_ENABLED,
    DriveState.QUICK_STOP_ACTIVE,
    DriveState.FAULT_REACTION_ACTIVE,
)

#: A hand that is at the wall at once, and stays there.
PRESSING = {
    "wall.law": "half_sample",
    "simulation.hand": {
        "inertia_kg_m2": 6.4e-5,
        "damping_nm_s_per_rad": 0.0256,
        "stiffness_nm_per_rad": 3.2,
        "strikes": 1,
        "first_strike_s": 0.0,
        "interval_s": 4000.0,
        "rest_rad": 0.02,
        "press_rad": -0.1,
        "approach_s": 0.02,
        "press_s": 3000.0,
        "withdraw_s": 0.1,
    },
}


@dataclass(frozen=True)
class Act:
    """What becomes of a frame.

    Attributes:
        kind: one of KINDS.
        after: frames that pass before, in both directions together.
        number: bit, bytes that are left, or frames for which it goes on or is held back.
        frame: the one that is forged.
    """

    kind: str
    after: int = 0
    number: int = 0
    frame: Frame = (HEARTBEAT, b"")


#: The watchdog waits for 30 s in simulated time.
_LONGER_THAN_A_WATCHDOG_S = 100.0
_STEPS = 10
#: Frames of a set-up, about.
_SET_UP_FRAMES = 200

KINDS = ("lose", "silence", "gone", "double", "late", "bit", "short", "to master", "to drive")


class TorqueError(AssertionError):
    """A torque that must not be."""


class Adversary:
    """A device between the runner and the drive, which does to frames what acts say."""

    def __init__(self, device: FaultyDrive, limit_per_mille: int) -> None:
        self.device = device
        self.record = device.drive.state.record
        self._limit = limit_per_mille
        self._acts: list[Act] = []
        self._left = 0
        self._lost: dict[Way, int] = {"received": 0, "sent": 0}
        self._held: dict[Way, list[tuple[int, Frame]]] = {"received": [], "sent": []}
        self._forged: list[Frame] = []
        #: True once the master is dead: nothing comes from it any more.
        self.master_is_gone = False
        self.syncs = 0
        #: Called before each frame of the master.
        self.before_frame: Callable[[], None] = lambda: None

    @property
    def real_time(self) -> bool:
        return self.device.real_time

    @property
    def state(self) -> DriveState:
        """The drive's state, as it is."""
        return state_of(int(self.record["values"][0][STATUSWORD]))

    @property
    def torque(self) -> int:
        """The drive's torque, as it is [per mille]."""
        return int(self.record["values"][0][TORQUE])

    def plan(self, acts: Iterable[Act]) -> None:
        """Do this, one after the other, from the next frame on."""
        waiting = bool(self._acts)
        self._acts += acts
        if self._acts and not waiting:
            self._left = self._acts[0].after

    def boot(self) -> list[Frame]:
        return self.device.boot()

    def process(self, can_id: int, data: bytes) -> list[Frame]:
        self.before_frame()
        self.syncs += can_id == SYNC
        arrived = self._carry("received", (can_id, data))
        answers = [answer for frame in arrived for answer in self.device.process(*frame)]
        return self._sent(answers)

    def request(self, can_id: int) -> list[Frame]:
        return [] if self.master_is_gone else self._sent(self.device.request(can_id))

    def tick(self, dt: float) -> list[Frame]:
        return self._sent(self.device.tick(dt))

    def _sent(self, answers: list[Frame]) -> list[Frame]:
        self._check()
        frames = [frame for answer in answers for frame in self._carry("sent", answer)]
        frames += self._forged
        self._forged = []
        return frames

    def _check(self) -> None:
        torque, state = self.torque, self.state
        if abs(torque) > self._limit:
            raise TorqueError(f"{torque} per mille, {self._limit} is the limit")
        if torque and state not in POWERED:
            raise TorqueError(f"{torque} per mille in {state}")

    def _carry(self, way: Way, frame: Frame) -> list[Frame]:
        if self.master_is_gone and way == "received":
            return []
        due = [held for left, held in self._held[way] if left <= 1]
        self._held[way] = [(left - 1, held) for left, held in self._held[way] if left > 1]
        act = self._next()
        if self._lost[way] > 0:
            self._lost[way] -= 1
            return due
        return [*self._changed(way, frame, act), *due]

    def _next(self) -> Act | None:
        if not self._acts:
            return None
        if self._left > 0:
            self._left -= 1
            return None
        act = self._acts.pop(0)
        self._left = self._acts[0].after if self._acts else 0
        return act

    def _changed(self, way: Way, frame: Frame, act: Act | None) -> list[Frame]:
        can_id, data = frame
        match act:
            case Act(kind="lose", number=number):
                self._lost[way] = number
                return []
            case Act(kind="silence", number=number):
                self._lost = {"received": number, "sent": number}
                return []
            case Act(kind="gone"):
                self.master_is_gone = True
                return [] if way == "received" else [frame]
            case Act(kind="double"):
                return [frame, frame]
            case Act(kind="late", number=number):
                self._held[way].append((max(1, number), frame))
                return []
            case Act(kind="bit", number=number) if data:
                changed = int.from_bytes(data, "little") ^ 1 << number % (8 * len(data))
                return [(can_id, changed.to_bytes(len(data), "little"))]
            case Act(kind="short", number=number) if data:
                return [(can_id, data[: number % len(data)])]
            case Act(kind="to master", frame=forged):
                self._forged.append(forged)
            case Act(kind="to drive", frame=forged):
                self._forged += self.device.process(*forged)
        return [frame]


class Duel(Rig):
    """Master and drive with an adversary between them; the drive's time goes with the SYNCs."""

    adversary: Adversary

    def __init__(self, settings: Settings | None = None, native: bool = False) -> None:
        self._stood_still_s = 0.0
        super().__init__(settings or duel_settings(), native=native)
        self.pass_time(0.01)  # the drive starts

    def switch_on(self, drive: ServoDrive) -> BusRunner:
        assert self.settings.simulation is not None
        device = cast(FaultyDrive, self.tampering.drive)
        self.adversary = Adversary(device, 3000)
        return BusRunner(self.adversary, self.drive_bus, self._clock)

    def _clock(self) -> float:
        return self.adversary.syncs * self.settings.bus.cycle_s + self._stood_still_s

    def stand_still(self, duration_s: float) -> None:
        """Let time pass for the drive before its next frame."""
        self._stood_still_s += duration_s

    def pass_time(self, duration_s: float) -> None:
        """Let time pass for the drive alone."""
        for _ in range(_STEPS):
            self.stand_still(duration_s / _STEPS)
            self.runner.poll()

    def settle(self) -> None:
        """Leave the drive alone for longer than its watchdog waits: no torque may be left."""
        self.adversary.master_is_gone = True
        self.pass_time(_LONGER_THAN_A_WATCHDOG_S)
        if self.adversary.torque:
            raise TorqueError(f"{self.adversary.torque} per mille, and no master in its cycle")


Pair: TypeAlias = tuple[DriveState, bool, str]
"""State of a drive, whether it has a torque, and what its master takes it for."""


class Master:
    """A master from its first SDO to its end, in a duel."""

    def __init__(self, duel: Duel, cycles: int) -> None:
        self.duel = duel
        self._cycles = cycles
        self._loop: Loop | None = None
        self._believes: str | None = None
        #: Asks for its end.
        self.stops = False
        self.pairs: Counter[Pair] = Counter()

    def run(self) -> None:
        """Set the drive up, render, leave; errors that the program has a line for end it too."""
        try:
            self._loop = Loop(self.duel)
            outcome = self._loop.run(self._cycles, self._asked)
        except RunFailedError as error:  # of the set-up
            self._believes = "not set up" if isinstance(error, DriveError) else "failed"
        else:
            self._believes = "disabled" if outcome.disabled else "not disabled, and says so"
        self.note()
        adversary = self.duel.adversary
        if self._believes == "disabled" and adversary.torque:
            raise TorqueError(f"{adversary.torque} per mille, and its master takes it for disabled")

    @property
    def belief(self) -> str:
        """What it takes the drive for."""
        if self._believes is not None or self._loop is None:
            return self._believes or "set up"
        return Phase(int(self._loop.record["phase"][0])).name.lower()

    def note(self) -> None:
        """Note what is, and what the master takes it for."""
        adversary = self.duel.adversary
        self.pairs[adversary.state, bool(adversary.torque), self.belief] += 1

    def _asked(self, j: int) -> bool:
        self.note()
        return self.stops


def duel_settings() -> Settings:
    """config/sim.toml with a hand that presses on the wall from the start."""
    return settings_with({"drive.wait_s": 0.01, "run.ramp_in_s": 0.01, **PRESSING})


def _no_collection() -> types.SimpleNamespace:
    return types.SimpleNamespace(
        **{name: lambda: None for name in ("collect", "freeze", "unfreeze", "enable", "disable")}
    )


@contextmanager
def fast_duels() -> Iterator[None]:
    """Read the dictionary once, and give up what the adversary has taken away sooner."""
    load, exchange = cache(rig.load_eds), canwall.cycle.exchange
    with (
        patch.object(rig, "load_eds", load),
        patch.object(drive_dictionary, "load_eds", load),
        patch.object(canwall.drive.setup, "_DISABLING_S", 0.01),
        patch.object(exchange, "_SIMULATED_TIMEOUT_S", 0.005),
        patch.object(exchange, "_MISSING_TIMEOUT_S", 0.0005),
        patch.object(canwall.cycle.way_out, "gc", _no_collection()),
        patch.object(canopen.sdo.SdoClient, "RESPONSE_TIMEOUT", 0.005),
    ):
        yield


forged_to_master = st.one_of(
    st.tuples(st.just(TPDO1), st.binary(max_size=8)),
    st.builds(  # a TPDO of a drive that is somewhere else, in another state
        lambda position, word, torque: (
            TPDO1,
            position.to_bytes(4, "little", signed=True)
            + word.to_bytes(2, "little")
            + torque.to_bytes(2, "little", signed=True),
        ),
        st.integers(-40_000, 40_000),
        st.sampled_from([0x0250, 0x0231, 0x0233, 0x0237, 0x0217, 0x021F, 0x0218]),
        st.integers(-3000, 3000),
    ),
    st.tuples(
        st.just(HEARTBEAT) | st.integers(0x701, 0x77F),
        st.builds(lambda state: bytes([state]), st.integers(0, 255)) | st.binary(max_size=8),
    ),
    st.tuples(st.just(EMCY) | st.integers(0x081, 0x0FF), st.binary(max_size=8)),
    st.tuples(st.just(SDO_ANSWER), st.binary(max_size=8)),
    st.tuples(st.just(SYNC), st.binary(max_size=1)),
    st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8)),
)
forged_to_drive = st.one_of(
    st.builds(
        lambda command, node: (NMT, bytes([command, node])),
        st.sampled_from([1, 2, 128, 129, 130]),
        st.sampled_from([0, NODE_ID]),
    ),
    st.tuples(st.just(SYNC), st.binary(max_size=1)),
    st.tuples(st.just(RPDO1), st.binary(max_size=3)),
)


@st.composite
def acts(draw: Any) -> list[Act]:
    """Draw what happens on the bus."""
    kinds = draw(st.lists(st.sampled_from(KINDS), max_size=12))
    gaps = st.integers(0, 6) | st.integers(0, 300)
    # Most of them once the drive is set up, where the torque is.
    begin = draw(st.sampled_from([0, _SET_UP_FRAMES, _SET_UP_FRAMES + 150]))
    planned = [Act("none", begin)] if begin else []
    for kind in kinds:
        forged = forged_to_drive if kind == "to drive" else forged_to_master
        frame = draw(forged) if kind.startswith("to ") else (HEARTBEAT, b"")
        number = draw(st.integers(0, 63) | st.integers(0, 400))
        planned.append(Act(kind, draw(gaps), number, frame))
    return planned
