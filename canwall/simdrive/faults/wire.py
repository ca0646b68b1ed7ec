"""What happens to frames between the drive and the bus."""

from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random
from typing import Literal

from canwall.config import ON_FRAMES
from canwall.simdrive.communication.frame import CRC_ERROR, ERROR_FRAME, Frame
from canwall.simdrive.faults.plan import PlannedFault

Way = Literal["sent", "received"]

_CUT: dict[str, tuple[Way, ...]] = {
    "silence": ("sent",),
    "bus_off": ("sent", "received"),
    "reboot": ("sent", "received"),
}
"""Kinds that stop every frame, and which way."""

_STOPS = ("lost", *_CUT)

_BABBLE_ID = 0x001
"""Without a CAN-ID of one's own: goes before nearly everything, and is nobody's."""

_MAX_BYTES = 8


def _lost(frame: Frame, fault: PlannedFault, random: Random) -> list[Frame]:
    return []


def _doubled(frame: Frame, fault: PlannedFault, random: Random) -> list[Frame]:
    return [frame] * (1 + fault.amount)


def _corrupted(frame: Frame, fault: PlannedFault, random: Random) -> list[Frame]:
    """Bits are flipped, each another one. With none, the CRC notices: the frame is sent anew."""
    can_id, data = frame
    if not fault.amount:
        return [CRC_ERROR, frame]
    bits = 8 * len(data)
    number = int.from_bytes(data, "little")
    for bit in random.sample(range(bits), min(fault.amount, bits)):
        number ^= 1 << bit
    return [(can_id, number.to_bytes(len(data), "little"))]


def _wrong_length(frame: Frame, fault: PlannedFault, random: Random) -> list[Frame]:
    can_id, data = frame
    length = max(0, min(_MAX_BYTES, len(data) + fault.amount))
    return [(can_id, data[:length].ljust(length, b"\0"))]


_CHANGES: dict[str, Callable[[Frame, PlannedFault, Random], list[Frame]]] = {
    "lost": _lost,
    "doubled": _doubled,
    "corrupted": _corrupted,
    "wrong_length": _wrong_length,
}


@dataclass
class _Disturbance:
    """One fault that is present, with the random numbers that are its own."""

    fault: PlannedFault
    random: Random
    babbled: float = 0.0

    def touches(self, way: Way, can_id: int) -> bool:
        """Whether a frame is met: draws a random number for each that could be."""
        fault = self.fault
        if fault.kind in _CUT:
            return way in _CUT[fault.kind]
        if fault.kind == "babbling" or fault.direction not in (way, "both"):
            return False
        if fault.can_id not in (None, can_id):
            return False
        return fault.probability >= 1.0 or self.random.random() < fault.probability

    def babble(self, periods: float) -> list[Frame]:
        """Frames with random data for so many periods."""
        can_id = _BABBLE_ID if self.fault.can_id is None else self.fault.can_id
        self.babbled += self.fault.amount * periods
        count = int(self.babbled)
        self.babbled -= count
        return [(can_id, self.random.randbytes(_MAX_BYTES)) for _ in range(count)]


@dataclass
class Wire:
    """Carries frames between drive and bus through the faults that are present, in their order."""

    _present: list[_Disturbance] = field(default_factory=list)
    _late: list[tuple[float, Way, Frame]] = field(default_factory=list)

    @property
    def straight(self) -> bool:
        """Whether every frame passes as it is, and none is under way."""
        return not self._present and not self._late

    def disturb(self, fault: PlannedFault, random: Random) -> None:
        """Let a fault begin, if it is one of frames."""
        if fault.kind in ON_FRAMES or fault.kind in _CUT or fault.kind == "babbling":
            self._present.append(_Disturbance(fault, random))

    def mend(self, fault: PlannedFault) -> None:
        """Let a fault end; what is late on its account still comes."""
        self._present = [present for present in self._present if present.fault is not fault]

    def passes_remote(self, can_id: int) -> bool:
        """Whether a remote frame that the drive is to receive comes through."""
        return not any(
            present.fault.kind in _STOPS and present.touches("received", can_id)
            for present in self._present
        )

    def carry(self, way: Way, frame: Frame, now: float) -> list[Frame]:
        """Return what becomes of a frame now."""
        frames = [frame]
        for present in self._present:
            frames = [out for each in frames for out in self._meet(present, way, each, now)]
        return frames

    def _meet(self, present: _Disturbance, way: Way, frame: Frame, now: float) -> list[Frame]:
        if frame[0] & ERROR_FRAME or not present.touches(way, frame[0]):
            return [frame]
        if present.fault.kind == "late":
            self._late.append((now + present.fault.amount, way, frame))
            return []
        change = _CHANGES.get(present.fault.kind, _lost)
        return change(frame, present.fault, present.random)

    def due(self, way: Way, now: float) -> list[Frame]:
        """Return the late frames whose time has come, in their order."""
        come = [late for late in self._late if late[1] == way and late[0] <= now]
        self._late = [late for late in self._late if late not in come]
        return [frame for _, _, frame in come]

    def babble(self, periods: float) -> list[Frame]:
        """Return what a drive that babbles sends in so many periods."""
        return [
            frame
            for present in self._present
            if present.fault.kind == "babbling"
            for frame in present.babble(periods)
        ]
