"""A simulated drive in which things go wrong on demand, and by a seed always the same."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from random import Random

from canwall.simdrive.communication.dictionary import Dictionary
from canwall.simdrive.communication.frame import BUS_OFF, ERROR_FRAME, Frame
from canwall.simdrive.drive import SimulatedDrive
from canwall.simdrive.faults.encoder import FaultyEncoder
from canwall.simdrive.faults.plan import POWER_ON, PlannedFault
from canwall.simdrive.faults.request import INDEX, FaultRequest
from canwall.simdrive.faults.wire import Wire

_SOURCE = (INDEX, 1)
"""What EMCY names as the object that noticed."""


class FaultyDrive:
    """A simulated drive, and between it and the bus what goes wrong.

    Faults begin and end with a SYNC (in real time: with a tick). The world outside goes on with
    every SYNC on the bus, whether the drive hears it or not.
    """

    def __init__(
        self,
        drive: SimulatedDrive,
        encoder: FaultyEncoder,
        faults: Iterable[PlannedFault] = (),
        seed: int = 0,
        report: Callable[[str], None] = lambda line: None,
    ) -> None:
        """Take a drive over that is not switched on.

        Args:
            drive: the drive itself.
            encoder: what the drive reads its position from.
            faults: those that come by themselves.
            seed: two drives with the same seed and the same frames in have the same frames out.
            report: told in one line when a fault begins or ends.
        """
        self.drive = drive
        self._seed = seed
        self._report = report
        self._wire = Wire()
        self._encoder = encoder
        self._count = 0
        self._waiting: list[tuple[PlannedFault, Random]] = []
        self._present: list[PlannedFault] = []
        self._ended_on_request = False
        self._elapsed = 0.0
        self._idle = True
        drive.extend(self._serve)
        for fault in faults:
            self._plan(fault)

    @property
    def real_time(self) -> bool:
        """Whether time is what ``tick`` tells, not the count of SYNCs."""
        return self.drive.real_time

    @property
    def now(self) -> float:
        """SYNC number, or SYNC periods since power-on in real time."""
        return self._elapsed if self.drive.real_time else self.drive.syncs - 1.0

    def boot(self) -> list[Frame]:
        """Switch the device on, and return the frames that it sends."""
        boot_up = self.drive.boot()
        frames = self._turn(0.0)
        self._settle()
        return [*self._send(boot_up), *frames]

    def process(self, can_id: int, data: bytes) -> list[Frame]:
        """Take a data frame from the bus and return the frames that it makes the drive send.

        Error frames among them have an identifier with ``ERROR_FRAME``.
        """
        if self._idle:
            return self.drive.process(can_id, data)
        frames: list[Frame] = []
        is_sync = can_id == self.drive.sync_can_id
        if is_sync:
            self.drive.pass_sync()
            if not self.real_time:
                frames += self._turn(1.0)
        frames += self._deliver(self._wire.carry("received", (can_id, data), self.now))
        if is_sync and not self.real_time:
            frames += self._deliver(self._wire.due("received", self.now))
            self._settle()
        return frames

    def request(self, can_id: int) -> list[Frame]:
        """Take a remote frame and return the frames that answer it."""
        return self._send(self.drive.request(can_id)) if self._wire.passes_remote(can_id) else []

    def tick(self, dt: float) -> list[Frame]:
        """Let the protocol timers go on by ``dt`` seconds; return the frames that are due."""
        periods = dt / self.drive.sync_period_s
        self._elapsed += periods
        frames = self.drive.tick(dt)
        if self._idle:
            return frames
        frames = self._send(frames)
        if self.real_time:
            frames += self._turn(periods)
            frames += self._deliver(self._wire.due("received", self.now))
            self._settle()
        return frames

    def _serve(self, dictionary: Dictionary) -> None:
        self._request = FaultRequest(dictionary, self._asked, self._end_all)
        self._show()

    def _plan(self, fault: PlannedFault) -> None:
        # Each fault has random numbers of its own: it does not matter what else goes wrong.
        self._waiting.append((fault, Random(f"{self._seed} {self._count}")))
        self._count += 1
        self._settle()

    def _asked(self, fault: PlannedFault, syncs: int) -> None:
        self._plan(replace(fault, begin=self.now + 1.0 + syncs))

    def _end_all(self) -> None:
        self._waiting.clear()
        self._ended_on_request = True
        self._settle()

    def _settle(self) -> None:
        """See whether there is anything to do but to hand frames on."""
        straight = self._wire.straight and not self._present
        self._idle = straight and not self._waiting
        self.drive.passes_syncs = self._idle
        self._show()

    def _show(self) -> None:
        self._request.show(len(self._waiting) + len(self._present))

    def _turn(self, periods: float) -> list[Frame]:
        """Let end and begin what is due now; return what the drive and its faults send then.

        Args:
            periods: since the last time, for a drive that babbles.
        """
        now = self.now
        frames: list[Frame] = []
        for fault in [*self._present]:
            if self._ended_on_request or now >= fault.end:
                frames += self._end(fault)
        self._ended_on_request = False
        due = [waiting for waiting in self._waiting if waiting[0].begin <= now]
        self._waiting = [waiting for waiting in self._waiting if waiting not in due]
        for fault, random in due:
            frames += self._begin(fault, random)
            if now >= fault.end:
                frames += self._end(fault)
        frames += self._wire.due("sent", now)
        frames += self._wire.babble(periods)
        return frames

    def _begin(self, fault: PlannedFault, random: Random) -> list[Frame]:
        self._say(fault, "begins")
        self._present.append(fault)
        drive, axis = self.drive, self.drive.axis
        frames: list[Frame] = [BUS_OFF] if fault.kind == "bus_off" else []
        self._wire.disturb(fault, random)
        match fault.kind:
            case "reboot":
                drive.switch_off()
            case "emcy":
                drive.emcy.occurred(fault.amount, _SOURCE)
            case "fault":
                axis.fault(fault.amount, _SOURCE)
            case "encoder_jump":
                self._encoder.jump(fault.amount)
            case "encoder_stuck":
                self._encoder.stick()
            case "torque":
                drive.actuator.follow(fault.amount / 1000.0)
            case "sto":
                axis.sto(True)
            case "undervoltage":
                axis.undervoltage(True)
            case "bus_off":
                drive.bus_off()
        return frames + self._send(drive.take_outbox())

    def _end(self, fault: PlannedFault) -> list[Frame]:
        self._present.remove(fault)
        self._wire.mend(fault)
        drive, axis = self.drive, self.drive.axis
        frames: list[Frame] = []
        # Two faults of a kind may overlap: the last one to go mends it.
        if all(other.kind != fault.kind for other in self._present):
            match fault.kind:
                case "reboot":
                    frames = drive.boot()
                case "encoder_stuck":
                    self._encoder.release()
                case "torque":
                    drive.actuator.follow(1.0)
                case "sto":
                    axis.sto(False)
                case "undervoltage":
                    axis.undervoltage(False)
                case "bus_off":
                    drive.bus_recovered()
        if fault.kind == "emcy":
            drive.emcy.gone(fault.amount, _SOURCE)
        elif fault.kind == "encoder_jump":
            self._encoder.jump(-fault.amount)
        self._say(fault, "ends")
        return self._send([*frames, *drive.take_outbox()])

    def _say(self, fault: PlannedFault, what: str) -> None:
        if self.real_time:
            when = f"{self.now * self.drive.sync_period_s:.3f} s"
        else:
            when = "power-on" if self.now == POWER_ON else f"SYNC {self.now:.0f}"
        self._report(f"{when}: {fault} {what}")

    def _send(self, frames: Iterable[Frame]) -> list[Frame]:
        return [out for frame in frames for out in self._wire.carry("sent", frame, self.now)]

    def _deliver(self, frames: list[Frame]) -> list[Frame]:
        """Give the drive what arrives; return what it sends, and the error frames."""
        out: list[Frame] = []
        for can_id, data in frames:
            if can_id & ERROR_FRAME:
                out.append((can_id, data))
            else:
                out += self._send(self.drive.process(can_id, data))
        return out
