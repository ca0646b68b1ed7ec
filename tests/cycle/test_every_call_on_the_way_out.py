"""A fault at every call on the way out, in turn: the torque goes, and the outcome is told.

The list of calls is generated: a run without a fault is watched from the first step of its way out
to its end, and each place that calls a function there gets each kind of fault once. So does each
place of the ways out that a failed cycle, a deaf drive and a hanging cycle take.
"""

import gc
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import can
import pytest
from rig import SDO_REQUEST, Loop, Rig, settings_with

import canwall
from canwall.cycle import Outcome, run_loop
from canwall.cycle import exchange as exchange_module
from canwall.cycle import loop as loop_module
from canwall.drive import DriveNode, Link
from canwall.stopping import stop_on_signals
from canwall.supervised import given_up

#: The hand begins to strike; after so many cycles there is a torque.
STRIKE_S = 0.04
CYCLES = 100

#: Patience with a drive that does not answer, on the way out.
_SDO_TIMEOUT_S = 0.05

#: Where calls are counted: this package and what it moves frames with.
PACKAGES = tuple(str(Path(str(m.__file__)).parent) for m in (canwall, can, sys.modules["canopen"]))

Place = tuple[str, str, str]
"""File and name of the caller, name of the function."""


class ForeignError(BaseException):
    """What no handler of exceptions expects."""


def _counts(code: CodeType) -> bool:
    """Return True for code of the master; not for the drive, nor for what looks on."""
    name = code.co_filename
    return name.startswith(PACKAGES) and "simdrive" not in name and "supervised" not in name


@dataclass
class Fault:
    """Watches calls from the first step of the way out on; something happens at one of them."""

    place: Place | None = None
    happens: Callable[[], None] = lambda: None
    armed: bool = False
    happened: bool = False
    places: dict[Place, None] = field(default_factory=dict)

    def __call__(self, frame: FrameType, event: str, argument: object) -> None:
        if event != "call" or not self.armed or frame.f_back is None:
            return
        caller: CodeType = frame.f_back.f_code
        called = frame.f_code
        if not (_counts(caller) and _counts(called)) or called.co_name == "<genexpr>":
            return
        place = (caller.co_filename, caller.co_qualname, called.co_qualname)
        self.places.setdefault(place)
        if place == self.place and not self.happened:
            self.happened = True
            self.happens()


def render(rig: Rig, fault: Fault, before: Callable[[Loop], None], outcome: Outcome) -> None:
    """Press on the wall, and leave; `before` is called as the way out begins."""
    loop = Loop(rig)
    leave = loop_module.Loop.leave

    def begin(self: loop_module.Loop) -> bool:
        assert rig.rpdos()[-1][1] != 0
        before(loop)
        # From here on only: set-up has its time, the cycles before are as fast as ever.
        loop.rig.node._node.sdo.RESPONSE_TIMEOUT = _SDO_TIMEOUT_S
        fault.armed = True
        sys.setprofile(fault)
        threading.setprofile(fault)
        return leave(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop_module.Loop, "leave", begin)
        try:
            run_loop(loop.exchange, lambda loop: loop.render(CYCLES), outcome=outcome)
        finally:
            threading.setprofile(None)
            fault.armed = False
    if not fault.happened:  # after a fault the last word may be SDO's or NMT's
        assert rig.rpdos()[-1] == (0x00, 0)


def in_order(loop: Loop) -> None:
    """Nothing is wrong."""


def failing(loop: Loop) -> None:
    """The exchange fails from now on."""

    def fail(most: int = 1) -> None:
        raise ValueError("no cycle")

    loop.exchange.cycle = fail  # type: ignore[method-assign]


def deaf(loop: Loop) -> None:
    """As before, and the drive does not hear SDO either."""
    failing(loop)
    loop.rig.tampering.deaf.add(SDO_REQUEST)


WAYS = {way.__name__: way for way in (in_order, failing, deaf)}


@pytest.fixture(autouse=True)
def _no_long_waits(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(exchange_module, "_SIMULATED_TIMEOUT_S", 1.0)
    monkeypatch.setattr("canwall.cycle.way_out._STANDSTILL_S", 0.15)
    yield
    given_up.clear()


def drive_is_at_rest(rig: Rig) -> bool:
    """Ask the drive for its state and its torque."""
    rig.tampering.deaf.clear()
    node = DriveNode(Link(rig.bus, idle=rig.runner.poll), 5, rig.node.dictionary)
    return node.read(0x6041) & 0x6F != 0x27 and node.read(0x6077) == 0


def raising(error: BaseException) -> Callable[[], None]:
    def happens() -> None:
        raise error

    return happens


def kinds() -> dict[str, Callable[[], None]]:
    return {
        "ValueError": raising(ValueError("injected")),
        "CanError": raising(can.CanOperationError("injected")),
        "no Exception": raising(ForeignError("injected")),
        "signal": lambda: signal.raise_signal(signal.SIGTERM),
        "hang": lambda: None,
    }


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("kind", kinds())
def test_fault_at_every_call(native: bool, kind: str, way: str) -> None:
    settings = settings_with(
        {
            "wall.law": "half_sample",
            "drive.sdo_timeout_s": 2.0,
            "simulation.hand": {"first_strike_s": STRIKE_S},
        }
    )

    @contextmanager
    def tried(fault: Fault, outcome: Outcome, way: str) -> Iterator[Rig]:
        # One at a time: each run collects garbage, and would visit all rigs that there are.
        with closing(Rig(settings, native=native)) as rig:
            with suppress(ValueError, ForeignError), stop_on_signals():
                render(rig, fault, WAYS[way], outcome)
            yield rig

    def places(way: str) -> set[Place]:
        watched = Fault()
        with tried(watched, Outcome(), way):
            return set(watched.places)

    # What the ways have in common is tried on the first of them.
    others = list(WAYS)[: list(WAYS).index(way)]
    listed = places(way).difference(*map(places, others))
    assert len(listed) > (5 if others else 20)
    gc.freeze()  # what is loaded by now need not be visited by the collector of each run
    failed: list[Any] = []
    for place in sorted(listed):
        released = threading.Event()
        happens = kinds()[kind] if kind != "hang" else lambda released=released: released.wait(60)
        fault, outcome = Fault(place, happens), Outcome()
        try:
            with tried(fault, outcome, way) as rig:
                said = [*outcome.trips, *outcome.notes]
                at_rest = drive_is_at_rest(rig)
                # What is absorbed, by canopen for one, leaves everything in order.
                told = bool(said) or (outcome.disabled and outcome.error is None)
                confirmed = outcome.disabled or any("switch it off" in line for line in said)
                released.set()
                for thread in given_up:
                    thread.join(5.0)
                # What has come back does nothing more.
                still = drive_is_at_rest(rig) and not any(thread.is_alive() for thread in given_up)
                if not (at_rest and told and confirmed and still):
                    failed.append((place, at_rest, told, confirmed, still, said))
        except Exception as error:
            failed.append((place, error))
        finally:
            released.set()
            given_up.clear()
    assert failed == []
