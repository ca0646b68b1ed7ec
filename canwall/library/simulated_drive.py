"""A simulated drive for the tests of other programs: on a bus, with faults, to be looked into."""

import itertools
import logging
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pydantic import ValidationError

from canwall.bus import open_bus
from canwall.config import Bus, Drive, Fault, Settings, Simulation, first_error, has_wire, shipped
from canwall.errors import ConfigError
from canwall.faults import KINDS, FaultKind
from canwall.library.arguments import as_dict, as_path
from canwall.realtime import real_time_priority
from canwall.simdrive import (
    BusRunner,
    FaultyDrive,
    Frame,
    ServoMotion,
    load_compiled_code,
    make_drive,
    planned,
)

_log = logging.getLogger(__name__)

_NOBODY = {
    "inertia_kg_m2": 0.0,
    "damping_nm_s_per_rad": 0.0,
    "stiffness_nm_per_rad": 0.0,
    "strikes": 0,
    "rest_rad": 0.0,
}
"""A hand that has let go."""

_POLL_S, _IDLE_S = 0.001, 0.1
"""Intervals at which a condition is asked: that of a test, and one that may last for ever, whose
process has a drive to serve."""

_numbers = itertools.count(1)


class SimulatedDrive:
    """A simulated CiA 402 servo drive on a python-can bus, for the length of a `with` block.

    A thread serves the bus from the beginning of the block to its end. The drive is found,
    configured and driven through frames alone, as every drive is; what stands here looks at it, and
    makes faults happen.

    Attributes:
        node_id: Its node-ID.
        eds: Its object dictionary.
        interface: python-can's name of the bus.
        channel: Channel of the bus.
        faults: Faults to begin and to end.
    """

    def __init__(
        self,
        eds: Path | str | None = None,
        *,
        node_id: int = 5,
        interface: str = "virtual",
        channel: str | None = None,
        bitrate: int = 1_000_000,
        cycle_s: float = 0.001,
        sync: bool = False,
        real_time: bool = True,
        simulation: Mapping[str, Any] | None = None,
        rated_torque_unit_nm: float | None = None,
        report: Callable[[str], None] = _log.info,
        prompt: bool = False,
    ) -> None:
        """Describe the drive, which is on no bus yet.

        Args:
            eds: EDS or DCF that it serves; the package's own unless given.
            node_id: 1 to 127.
            interface: A python-can interface. "virtual" is within this process.
            channel: Channel of the interface; for "virtual" one of its own unless given.
            bitrate: In bit/s.
            cycle_s: Time from one SYNC to the next [s].
            sync: Produce SYNC every cycle_s, for a master that consumes it. One that is overdue is
                left out.
            real_time: Time passes by the clock. Otherwise it passes by cycle_s with each SYNC, and
                the motion repeats to the bit.
            simulation: Keys of `[simulation]`: mechanics, hand, power-on values. Nobody holds the
                handle unless `hand` is given.
            rated_torque_unit_nm: As in `[drive]`.
            report: Called with a line when a fault begins or ends, or the bus goes or comes back.
            prompt: With real_time, give its thread real-time priority, if that is allowed: a drive
                answers in time, however busy the machine is.

        Raises:
            ConfigError: If an argument is not valid.
            DictionaryError: If the dictionary cannot be read, or no drive can be made from it.
        """
        if channel is None:
            if interface != "virtual":
                raise ConfigError(f"channel is missing: {interface} has none of its own")
            channel = f"canwall-{next(_numbers)}"
        described = {"real_time": real_time, "hand": _NOBODY} | as_dict("simulation", simulation)
        bus = _section(Bus, interface=interface, channel=channel, bitrate=bitrate, cycle_s=cycle_s)
        drive = _section(
            Drive,
            node_id=node_id,
            eds=as_path("eds", eds or shipped("eds/canwall-drive.eds")).resolve(),
            rated_torque_unit_nm=rated_torque_unit_nm,
        )
        self.node_id, self.eds = drive.node_id, drive.eds
        self.interface, self.channel = bus.interface, bus.channel
        self._bitrate, self._cycle_s, self._report = bus.bitrate, bus.cycle_s, report
        self._device = make_drive(
            drive, _section(Simulation, **described), bus.cycle_s, bus.bitrate, report
        )
        self._shared = _Shared(self._device, bus.cycle_s if sync else None)
        self.faults = Faults(self._shared, bus.cycle_s)
        self._stop = threading.Event()
        self._failure: BaseException | None = None
        self._thread: threading.Thread | None = None
        self._prompt = prompt and self._device.real_time

    @classmethod
    def from_settings(
        cls, settings: Settings, report: Callable[[str], None] = _log.info
    ) -> "SimulatedDrive":
        """Describe the drive of a configuration: `[bus]`, `[drive]` and `[simulation]`.

        Raises:
            ConfigError: If there is no `[simulation]`.
            DictionaryError: As the constructor does.
        """
        simulation, bus = settings.simulation, settings.bus
        if simulation is None:
            raise ConfigError("[simulation] is missing: there is no drive to simulate")
        return cls(
            settings.drive.eds,
            node_id=settings.drive.node_id,
            interface=bus.interface,
            channel=bus.channel,
            bitrate=bus.bitrate,
            cycle_s=bus.cycle_s,
            simulation=simulation.model_dump(),
            rated_torque_unit_nm=settings.drive.rated_torque_unit_nm,
            report=report,
            prompt=True,
        )

    def __enter__(self) -> Self:
        """Join the bus and switch the drive on: its boot-up message is on the bus.

        Raises:
            ConfigError: If the bus does not exist.
            can.CanError: If the bus does not take the message.
        """
        if self._thread is not None:
            raise RuntimeError("this drive has been on its bus already; make another one")
        load_compiled_code(self._device.real_time)
        self._bus = open_bus(self.interface, self.channel, self._bitrate)
        # A real controller makes error frames itself; given one, it sends it as data.
        virtual = not has_wire(self.interface, self.channel)
        try:
            runner = BusRunner(self._shared, self._bus, error_frames=virtual, report=self._report)
            time.sleep(_POLL_S)
            runner.poll()  # a tick that takes it to SWITCH ON DISABLED
        except BaseException:
            self._bus.shutdown()
            raise
        self._thread = threading.Thread(
            target=self._serve, args=(runner,), name=f"simulated drive {self.node_id}", daemon=True
        )
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Leave the bus.

        Raises:
            can.CanError: If the bus failed meanwhile.
        """
        self._stop.set()
        assert self._thread is not None
        self._thread.join()
        self._bus.shutdown()
        if error is None:
            self._check()

    def _serve(self, runner: BusRunner) -> None:
        try:
            with real_time_priority(above_loop=True) if self._prompt else nullcontext():
                runner.run(self._stop.is_set)
        except BaseException as error:
            self._failure = error

    def _check(self) -> None:
        """Raise what ended the thread."""
        if self._failure is not None:
            raise self._failure

    def wait_until(self, condition: Callable[[], bool], timeout_s: float | None = 10.0) -> None:
        """Wait until a condition holds, asked every millisecond; without a time-out, every 100 ms.

        Args:
            condition: Asked in this thread, e.g. ``lambda: drive.state == "FAULT"``.
            timeout_s: How long to wait; None: for ever.

        Raises:
            TimeoutError: If it does not hold in time; the text has the state of the drive.
            can.CanError: If the bus fails meanwhile.
        """
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while not condition():
            self._check()
            if deadline is not None and time.monotonic() >= deadline:
                raise TimeoutError(f"waited for {timeout_s:g} s: {self!r}")
            time.sleep(_IDLE_S if deadline is None else _POLL_S)

    @property
    def state(self) -> str:
        """State of CiA 402, as BaseNode402 spells it: "OPERATION ENABLED"."""
        with self._shared.lock:
            return _words(self._device.drive.axis.state_machine.state.name)

    @property
    def nmt_state(self) -> str:
        """State of the node, as canopen spells it: "PRE-OPERATIONAL"."""
        with self._shared.lock:
            name = self._device.drive.nmt_state.name
        return "INITIALISING" if name == "INITIALISATION" else name.replace("_", "-")

    @property
    def position(self) -> float:
        """Position of the shaft [rad], whatever the encoder says."""
        with self._shared.lock:
            return self._motion.position_rad

    @property
    def velocity(self) -> float:
        """Velocity of the shaft [rad/s]."""
        with self._shared.lock:
            return self._motion.speed_rad_s

    @property
    def torque(self) -> float:
        """Torque of the motor, at the shaft [N·m]; 0 while the power stage is off."""
        with self._shared.lock:
            return self._device.drive.torque_nm

    @property
    def errors(self) -> tuple[int, ...]:
        """Error codes that are present (EMCY), in the order of their coming."""
        with self._shared.lock:
            return tuple(code for code, _ in self._device.drive.emcy.present)

    @property
    def syncs(self) -> int:
        """Number of SYNCs that have been on the bus."""
        with self._shared.lock:
            return self._device.drive.syncs

    def __getitem__(self, key: int | tuple[int, int]) -> Any:
        """Return the value of an object, by index or (index, sub-index), without the bus.

        Raises:
            KeyError: If the dictionary does not have it.
        """
        index, subindex = key if isinstance(key, tuple) else (key, 0)
        with self._shared.lock:
            dictionary = self._device.drive.dictionary
            if (index, subindex) not in dictionary:
                raise KeyError(f"0x{index:04X}:{subindex:02X} is not in {self.eds}")
            return dictionary[index, subindex].value

    def __repr__(self) -> str:
        """Return what it is and how it is."""
        errors = "".join(f", error 0x{code:04X}" for code in self.errors)
        return (
            f"<SimulatedDrive node {self.node_id} on {self.interface} {self.channel}: "
            f"{self.nmt_state}, {self.state}{errors}, {self.position:.4g} rad, {self.torque:.4g} "
            f"N·m, {self.syncs} SYNCs>"
        )

    @property
    def _motion(self) -> ServoMotion:
        motion = self._device.motion
        assert isinstance(motion, ServoMotion)
        return motion


class Faults:
    """Faults of a drive: a method begins one of each kind, `drive.faults.sto()`.

    The names are those of docs/faults.md, and so are the arguments: `amount`, `can_id`,
    `direction`, `probability`, where the kind has them, and `duration_s` or `duration_syncs`.
    A fault begins at once. It ends after its duration, with `ActiveFault.end`, or with the `with`
    block that it heads.
    """

    def __init__(self, shared: "_Shared", cycle_s: float) -> None:
        self._shared = shared
        self._cycle_s = cycle_s
        self._begun: list[ActiveFault] = []

    def begin(self, kind: str, **settings: Any) -> "ActiveFault":
        """Begin a fault of a kind, by its name.

        Raises:
            ConfigError: If the kind has no such setting, or does not take its value.
        """
        device = self._shared.device
        plan = planned(_section(Fault, kind=kind, **settings), self._cycle_s, device.real_time)
        with self._shared.lock:
            fault, frames = device.begin(plan)
            self._shared.outbox += frames
        self._begun.append(ActiveFault(self._shared, fault))
        return self._begun[-1]

    def end_all(self) -> None:
        """End all that were begun here."""
        for fault in self._begun:
            fault.end()
        self._begun.clear()

    def __getattr__(self, name: str) -> Callable[..., "ActiveFault"]:
        """Return the method that begins a fault of the kind of this name."""
        if name not in KINDS:
            raise AttributeError(
                f"there is no fault {name!r}; there are {', '.join(KINDS)}", name=name, obj=self
            )

        def begin(**settings: Any) -> ActiveFault:
            return self.begin(name, **settings)

        begin.__name__, begin.__doc__ = name, KINDS[name].__doc__
        return begin

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *KINDS]


class ActiveFault:
    """A fault that has begun; as the head of a `with` block it ends with the block."""

    def __init__(self, shared: "_Shared", fault: FaultKind) -> None:
        self._shared = shared
        self._fault = fault

    def end(self) -> None:
        """End the fault, if it has not ended by itself."""
        with self._shared.lock:
            self._shared.outbox += self._shared.device.end(self._fault)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.end()

    def __repr__(self) -> str:
        return f"<ActiveFault {self._fault.plan}>"


class _Shared:
    """A device between the thread that serves its bus and those that look at it.

    Attributes:
        device: The device; to be touched under the lock only.
        lock: Held while a frame or a tick changes the device.
        outbox: Frames that a change from outside has made; they go with the next tick.
    """

    def __init__(self, device: FaultyDrive, sync_s: float | None) -> None:
        self.device = device
        self.lock = threading.Lock()
        self.outbox: list[Frame] = []
        self._sync_s = sync_s
        self._since_sync_s = 0.0
        self._counter = 0

    @property
    def real_time(self) -> bool:
        """True if time has to be up to date whenever a frame comes."""
        return self.device.real_time

    def boot(self) -> list[Frame]:
        """Switch the device on."""
        with self.lock:
            return self.device.boot()

    def process(self, can_id: int, data: bytes) -> list[Frame]:
        """Take a data frame and return the answers."""
        with self.lock:
            return [*self._posted(), *self.device.process(can_id, data)]

    def request(self, can_id: int) -> list[Frame]:
        """Take a remote frame and return the answers."""
        with self.lock:
            return [*self._posted(), *self.device.request(can_id)]

    def tick(self, dt: float) -> list[Frame]:
        """Let time pass and return the frames that are due, a SYNC among them if it is."""
        with self.lock:
            return [*self._posted(), *self.device.tick(dt), *self._sync(dt)]

    def _posted(self) -> list[Frame]:
        frames, self.outbox = self.outbox, []
        return frames

    def _sync(self, dt: float) -> list[Frame]:
        if self._sync_s is None:
            return []
        self._since_sync_s += dt
        if self._since_sync_s < self._sync_s:
            return []
        self._since_sync_s %= self._sync_s
        drive = self.device.drive
        overflow = drive.dictionary.number(0x1019, absent=0).value
        self._counter = self._counter % overflow + 1 if overflow else 0
        frame = drive.sync_can_id, bytes([self._counter] if overflow else [])
        return [frame, *self.device.process(*frame)]


def _words(name: str) -> str:
    return name.replace("_", " ")


def _section(model: Any, **values: Any) -> Any:
    """Validate the values of a section. Raises ConfigError."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ConfigError(first_error(error, model)) from None
