"""Bus budget: the share of the bus that the frames of a cycle take, and the highest rate that fits.

A classical frame with an 11-bit identifier and n bytes of data has 47 + 8n bits with the
interframe space, and up to ⌊(34 + 8n − 1)/4⌋ stuff bits (ISO 11898-1; Davis, Burns, Bril and
Lukkien 2007).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from canwall.config import Bus as BusSettings
from canwall.drive import DriveNode, DriveSetup
from canwall.drive.pdo import tpdos_on_sync

#: Usable share of a cycle: SDO, EMCY, heartbeats and a retransmission need the rest.
USABLE = 0.8


def frame_bits(length: int, stuffed: bool = True) -> int:
    """Return the bits of a frame with `length` data bytes, with the most stuff bits or none."""
    stuff = (34 + 8 * length - 1) // 4 if stuffed else 0
    return 47 + 8 * length + stuff


@dataclass(frozen=True)
class BudgetFrame:
    """A frame that is sent once per cycle; length is that of its data in bytes."""

    name: str
    can_id: int
    length: int


@dataclass(frozen=True)
class BudgetLine:
    """One frame of the budget.

    Attributes:
        frame: The frame.
        bits: Its bits with the most stuff bits.
        share: Its share of the cycle.
        earliest_s: Earliest end after the start of the SYNC [s].
        latest_s: Latest end [s], if the bus is busy with a frame of the greatest length at the
            start and carries nothing else.
    """

    frame: BudgetFrame
    bits: int
    share: float
    earliest_s: float
    latest_s: float


@dataclass(frozen=True)
class Budget:
    """Budget of a cycle.

    Attributes:
        lines: Its frames, in the order in which they are sent.
        bits: Bits of a cycle with the most stuff bits.
        share: Share of the cycle that they take.
        highest_hz: Highest rate of the SYNC that fits [Hz].
    """

    lines: tuple[BudgetLine, ...]
    bits: int
    share: float
    highest_hz: float

    @property
    def fits(self) -> bool:
        """True if the cycle leaves room for all other frames."""
        return self.share <= USABLE


def cycle_budget(node: DriveNode, setup: DriveSetup, bus: BusSettings) -> Budget:
    """Return the budget of a drive that is set up: SYNC, all TPDOs that follow it, and the RPDO.

    Raises DriveError.
    """
    return bus_budget(
        BudgetFrame("SYNC", setup.sync_cob_id, 1 if setup.sync_counter_overflow else 0),
        [BudgetFrame("TPDO", tpdo.cob_id, tpdo.length) for tpdo in tpdos_on_sync(node)],
        [BudgetFrame("RPDO", setup.rpdo.cob_id, setup.rpdo.length)],
        bus.bitrate,
        bus.cycle_s,
    )


def bus_budget(
    sync: BudgetFrame,
    tpdos: Sequence[BudgetFrame],
    rpdos: Sequence[BudgetFrame],
    bitrate: int,
    cycle_s: float,
) -> Budget:
    """Return the budget of a SYNC, the TPDOs that answer it, and the RPDOs that follow.

    TPDOs and RPDOs are sent in the order of their identifiers, lowest first, as arbitration does
    with frames that are ready together. Drives and master add their own times to those of the bus.

    Args:
        sync: SYNC.
        tpdos: TPDOs sent with it.
        rpdos: RPDOs of the cycle.
        bitrate: Bit rate [bit/s].
        cycle_s: Period of the SYNC [s].
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
    # Rounded down, so that the rate really fits.
    return Budget(tuple(lines), worst, worst / bitrate / cycle_s, math.floor(highest))


def _by_priority(frames: Sequence[BudgetFrame]) -> list[BudgetFrame]:
    return sorted(frames, key=lambda frame: frame.can_id)
