"""The bus's budget: what the frames of one cycle take of it, and the highest rate that fits.

A classical frame with an 11-bit identifier and n bytes of data takes 47 + 8n bits with the
interframe space, and at worst ⌊(34 + 8n − 1)/4⌋ stuff bits (ISO 11898-1; Davis, Burns, Bril and
Lukkien 2007). At best it has none.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

#: The part of a cycle that may be used: SDO, EMCY, heartbeats and a retransmission need the rest.
USABLE = 0.8


def frame_bits(length: int, stuffed: bool = True) -> int:
    """Bits of a frame with `length` bytes of data, with the most stuff bits or with none."""
    stuff = (34 + 8 * length - 1) // 4 if stuffed else 0
    return 47 + 8 * length + stuff


@dataclass(frozen=True)
class BudgetFrame:
    """A frame that comes once per cycle."""

    name: str
    can_id: int
    length: int


@dataclass(frozen=True)
class BudgetLine:
    """One frame of the budget.

    earliest_s, latest_s: its end after the beginning of the SYNC, the bus being free of all else
    but one frame of the greatest length, that had begun before [s].
    """

    frame: BudgetFrame
    bits: int
    share: float
    earliest_s: float
    latest_s: float


@dataclass(frozen=True)
class Budget:
    """What a cycle takes."""

    lines: tuple[BudgetLine, ...]
    bits: int
    share: float
    highest_hz: float

    @property
    def fits(self) -> bool:
        """Whether the cycle leaves room for everything else."""
        return self.share <= USABLE


def bus_budget(
    sync: BudgetFrame,
    tpdos: Sequence[BudgetFrame],
    rpdos: Sequence[BudgetFrame],
    bitrate: int,
    cycle_s: float,
) -> Budget:
    """The budget of a SYNC, the TPDOs that answer it, and the RPDOs that follow.

    TPDOs and RPDOs go over the bus in the order of their identifiers, lowest first: that is what
    arbitration makes of frames that are ready together. Times are those of the bus alone; drives
    and master add their own.
    """
    frames = [sync, *_by_priority(tpdos), *_by_priority(rpdos)]
    blocking = frame_bits(8) / bitrate
    lines, best, worst = [], 0, 0
    for frame in frames:
        best += frame_bits(frame.length, stuffed=False)
        bits = frame_bits(frame.length)
        worst += bits
        share = bits / bitrate / cycle_s
        lines.append(BudgetLine(frame, bits, share, best / bitrate, blocking + worst / bitrate))
    highest = USABLE * bitrate / worst
    # Rounded down: a rate that is said to fit, fits.
    return Budget(tuple(lines), worst, worst / bitrate / cycle_s, math.floor(highest))


def _by_priority(frames: Sequence[BudgetFrame]) -> list[BudgetFrame]:
    return sorted(frames, key=lambda frame: frame.can_id)
