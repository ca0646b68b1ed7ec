"""A simulated drive with faults; the same seed always gives the same ones."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from random import Random

from canwall.faults import POWER_ON, FaultKind, PlannedFault
from canwall.frame import ERROR_FRAME, Frame
from canwall.simdrive.communication.dictionary import Dictionary
from canwall.simdrive.drive import ServoDrive
from canwall.simdrive.faults.encoder import FaultyEncoder
from canwall.simdrive.faults.request import FaultRequest
from canwall.simdrive.faults.wire import Wire
from canwall.simdrive.profile.feedback import Motion


class FaultyDrive:
    """A simulated drive, with faults inside it and between it and the bus.

    Faults begin and end with a SYNC (in real time: with a tick). The world outside goes on with
    every SYNC on the bus, whether the drive hears it or not.
    """

    def __init__(
        self,
        drive: ServoDrive,
        encoder: FaultyEncoder,
        faults: Iterable[PlannedFault] = (),
        seed: int = 0,
        report: Callable[[str], None] = lambda line: None,
    ) -> None:
        """Take over a drive that is not switched on.

        Args:
            drive: the drive itself.
            encoder: encoder from which the drive reads its position.
            faults: those that are planned.
            seed: of the random numbers. Two drives with the same seed answer the same frames with
                the same frames.
            report: called with one line when a fault begins or ends.
        """
        self.drive = drive
        self._seed = seed
        self._report = report
        self._present: list[FaultKind] = []
        self._wire = Wire(self._present)
        self._encoder = encoder
        self._count = 0
        self._waiting: list[FaultKind] = []
        self._ended_on_request = False
        self._elapsed = 0.0
        self._idle = True
        drive.extend(self._serve)
        for fault in faults:
            self._plan(fault)

    @property
    def motion(self) -> Motion:
        """Motor, handle and hand, as they move whatever the encoder says."""
        return self._encoder.motion

    @property
    def real_time(self) -> bool:
        """True if `tick` moves time on, False if the count of SYNCs does."""
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
        """Take a data frame from the bus and return the frames that the drive sends in answer.

        Error frames among them have an identifier with `ERROR_FRAME`.
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

    def begin(self, plan: PlannedFault) -> tuple[FaultKind, list[Frame]]:
        """Begin a fault now, not with a SYNC; return it and the frames that the device sends."""
        fault = self._plan(replace(plan, begin=self.now))
        frames = self._turn(0.0)
        if plan.periods == 0.0:  # before the first SYNC it would last until that
            frames += self.end(fault)
        self._settle()
        return fault, frames

    def end(self, fault: FaultKind) -> list[Frame]:
        """End a fault now, if it is present; return the frames that the device sends."""
        frames = self._end(fault) if fault in self._present else []
        self._settle()
        return frames

    def _serve(self, dictionary: Dictionary) -> None:
        self._request = FaultRequest(dictionary, self._requested, self._end_all)
        self._show()

    def _plan(self, plan: PlannedFault) -> FaultKind:
        # Each fault has random numbers of its own, whatever other faults there are.
        random = Random(f"{self._seed} {self._count}")
        fault = plan.kind(plan, random, self.drive, self._encoder)
        self._waiting.append(fault)
        self._count += 1
        self._settle()
        return fault

    def _requested(self, plan: PlannedFault, syncs: int) -> None:
        self._plan(replace(plan, begin=self.now + 1.0 + syncs))

    def _end_all(self) -> None:
        self._waiting.clear()
        self._ended_on_request = True
        self._settle()

    def _settle(self) -> None:
        """Determine whether frames only have to be passed on."""
        self._idle = self._wire.transparent and not self._waiting
        self.drive.passes_syncs = self._idle
        self._show()

    def _show(self) -> None:
        self._request.show(len(self._waiting) + len(self._present))

    def _turn(self, periods: float) -> list[Frame]:
        """End and begin what is due now; return the frames that the drive and its faults send.

        Args:
            periods: SYNC periods since the last call.
        """
        now = self.now
        frames: list[Frame] = []
        for fault in [*self._present]:
            if self._ended_on_request or now >= fault.plan.end:
                frames += self._end(fault)
        self._ended_on_request = False
        due = [fault for fault in self._waiting if fault.plan.begin <= now]
        self._waiting = [fault for fault in self._waiting if fault not in due]
        for fault in due:
            frames += self._begin(fault)
            if now >= fault.plan.end:
                frames += self._end(fault)
        frames += self._wire.due("sent", now)
        for fault in self._present:
            frames += fault.advance(periods) or []
        return frames

    def _begin(self, fault: FaultKind) -> list[Frame]:
        self._say(fault, "begins")
        self._present.append(fault)
        frames = fault.begin() or []
        return self._send([*frames, *self.drive.take_outbox()])

    def _end(self, fault: FaultKind) -> list[Frame]:
        self._present.remove(fault)
        others = any(other.effect == fault.effect for other in self._present)
        frames = [] if others else fault.end() or []
        self._say(fault, "ends")
        return self._send([*frames, *self.drive.take_outbox()])

    def _say(self, fault: FaultKind, what: str) -> None:
        if self.real_time:
            when = f"{self.now * self.drive.sync_period_s:.3f} s"
        else:
            when = "power-on" if self.now == POWER_ON else f"SYNC {self.now:.0f}"
        self._report(f"{when}: {fault.plan} {what}")

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
