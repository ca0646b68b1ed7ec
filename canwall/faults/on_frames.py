"""Faults of the bus: what happens to frames between it and the drive."""

from canwall.faults.kind import FRAME_KEYS, Amount, FaultKind
from canwall.frame import CRC_ERROR, Frame

_MAX_BYTES = 8

_BABBLE_ID = 0x001
"""Wins the arbitration against nearly every frame, and no service has it."""


class Lost(FaultKind):
    """Frames vanish, remote frames included."""

    name = "lost"
    number = 1
    frame_keys = FRAME_KEYS
    stops = True


class Late(FaultKind):
    """Frames are late.

    Those sent come before what the drive sends with that SYNC, those received after that SYNC.
    """

    name = "late"
    number = 2
    frame_keys = FRAME_KEYS
    amount = Amount(1, 1, 100_000, "SYNC periods")

    @property
    def delay(self) -> int:
        return self.plan.amount


class Doubled(FaultKind):
    """Frames come more than once."""

    name = "doubled"
    number = 3
    frame_keys = FRAME_KEYS
    amount = Amount(1, 1, 100, "copies more")

    def change(self, frame: Frame) -> list[Frame]:
        return [frame] * (1 + self.plan.amount)


class Corrupted(FaultKind):
    """Bits of the data are flipped, unnoticed by the CRC.

    With 0 bits it notices: an error frame comes, then the frame again.
    """

    name = "corrupted"
    number = 4
    frame_keys = FRAME_KEYS
    amount = Amount(1, 0, 64, "bits")

    def change(self, frame: Frame) -> list[Frame]:
        can_id, data = frame
        if not self.plan.amount:
            return [CRC_ERROR, frame]
        bits = 8 * len(data)
        number = int.from_bytes(data, "little")
        for bit in self.random.sample(range(bits), min(self.plan.amount, bits)):
            number ^= 1 << bit
        return [(can_id, number.to_bytes(len(data), "little"))]


class WrongLength(FaultKind):
    """Data are cut short, or padded with zeros up to 8 bytes."""

    name = "wrong_length"
    number = 5
    frame_keys = FRAME_KEYS
    amount = Amount(-1, -8, 8, "bytes more")

    def change(self, frame: Frame) -> list[Frame]:
        can_id, data = frame
        length = max(0, min(_MAX_BYTES, len(data) + self.plan.amount))
        return [(can_id, data[:length].ljust(length, b"\0"))]


class Silence(FaultKind):
    """The drive sends nothing, but receives everything."""

    name = "silence"
    number = 6
    stops = True


class Babbling(FaultKind):
    """Frames with random data come before those of the drive, under `can_id` (default 0x001)."""

    name = "babbling"
    number = 16
    frame_keys = ("can_id",)
    amount = Amount(10, 1, 1000, "frames per SYNC period")

    _due = 0.0

    def advance(self, periods: float) -> list[Frame]:
        can_id = _BABBLE_ID if self.plan.can_id is None else self.plan.can_id
        self._due += self.plan.amount * periods
        count = int(self._due)
        self._due -= count
        return [(can_id, self.random.randbytes(_MAX_BYTES)) for _ in range(count)]
