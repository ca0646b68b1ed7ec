"""Faults of frames between the drive and the bus."""

from collections.abc import Sequence

from canwall.faults import FaultKind, Way
from canwall.frame import ERROR_FRAME, Frame


class Wire:
    """Carries frames between drive and bus through the faults that are present, in their order."""

    def __init__(self, present: Sequence[FaultKind]) -> None:
        """Carry frames through the faults in a list, which is the caller's to change."""
        self._present = present
        self._late: list[tuple[float, Way, Frame]] = []

    @property
    def transparent(self) -> bool:
        """True if every frame passes as it is, and none is under way."""
        return not self._present and not self._late

    def passes_remote(self, can_id: int) -> bool:
        """Return True if the drive receives a remote frame."""
        return not any(fault.stops and fault.meets("received", can_id) for fault in self._present)

    def carry(self, way: Way, frame: Frame, now: float) -> list[Frame]:
        """Return what becomes of a frame now; error frames pass as they are."""
        frames = [frame]
        for fault in self._present:
            frames = [out for each in frames for out in self._meet(fault, way, each, now)]
        return frames

    def _meet(self, fault: FaultKind, way: Way, frame: Frame, now: float) -> list[Frame]:
        if frame[0] & ERROR_FRAME or not fault.meets(way, frame[0]):
            return [frame]
        if fault.delay:
            self._late.append((now + fault.delay, way, frame))
            return []
        return fault.change(frame)

    def due(self, way: Way, now: float) -> list[Frame]:
        """Return the late frames whose time has come, in their order."""
        come = [late for late in self._late if late[1] == way and late[0] <= now]
        self._late = [late for late in self._late if late not in come]
        return [frame for _, _, frame in come]
