"""The bus's budget, against frames that are stuffed bit by bit."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canwall.bench.budget import USABLE, BudgetFrame, bus_budget, frame_bits


def stuffed_bits(can_id: int, data: bytes) -> int:
    """Bits on the wire of a frame, by ISO 11898-1: fields, CRC, stuffing, interframe space."""
    bits = [0, *(can_id >> k & 1 for k in range(10, -1, -1)), 0, 0, 0]
    bits += [len(data) >> k & 1 for k in range(3, -1, -1)]
    bits += [byte >> k & 1 for byte in data for k in range(7, -1, -1)]
    crc = 0
    for bit in bits:
        top = bit ^ crc >> 14
        crc = crc << 1 & 0x7FFF
        if top:
            crc ^= 0x4599
    bits += [crc >> k & 1 for k in range(14, -1, -1)]
    count, run, last = 0, 0, None
    for bit in bits:
        run = run + 1 if bit == last else 1
        last = bit
        count += 1
        if run == 5:
            count += 1
            last, run = 1 - bit, 1
    # CRC delimiter, acknowledge slot and delimiter, end of frame, interframe space.
    return count + 1 + 2 + 7 + 3


@given(can_id=st.integers(0, 0x7FF), data=st.binary(max_size=8))
def test_no_frame_is_longer_or_shorter(can_id: int, data: bytes) -> None:
    length = len(data)
    assert frame_bits(length, stuffed=False) <= stuffed_bits(can_id, data) <= frame_bits(length)


def test_published_lengths() -> None:
    """Davis et al. 2007: 55 + 10·s bits at the most with an 11-bit identifier."""
    assert [frame_bits(n) for n in range(9)] == [55 + 10 * n for n in range(9)]


SYNC, TPDO, RPDO = (
    BudgetFrame("SYNC", 0x080, 0),
    BudgetFrame("TPDO", 0x185, 8),
    BudgetFrame("RPDO", 0x205, 4),
)


def test_one_drive_at_one_megabit() -> None:
    budget = bus_budget(SYNC, [TPDO], [RPDO], 1_000_000, 0.001)
    assert budget.bits == 55 + 135 + 95
    assert budget.share == pytest.approx(0.285)
    assert budget.fits
    assert budget.highest_hz == math.floor(USABLE / 285e-6)
    sync, tpdo, rpdo = budget.lines
    assert sync.earliest_s == pytest.approx(47e-6)
    assert tpdo.earliest_s == pytest.approx((47 + 111) * 1e-6)
    # Behind a frame that had just begun.
    assert rpdo.latest_s == pytest.approx((135 + 285) * 1e-6)


def test_four_drives_do_not_fit_into_a_millisecond() -> None:
    tpdos = [BudgetFrame(f"TPDO {k}", 0x180 + k, 8) for k in (4, 3, 2, 1)]
    rpdos = [BudgetFrame(f"RPDO {k}", 0x200 + k, 4) for k in (1, 2, 3, 4)]
    budget = bus_budget(SYNC, tpdos, rpdos, 1_000_000, 0.001)
    assert not budget.fits
    assert [line.frame.can_id for line in budget.lines[1:5]] == [0x181, 0x182, 0x183, 0x184]
    slower = bus_budget(SYNC, tpdos, rpdos, 1_000_000, 1.0 / budget.highest_hz)
    assert slower.fits
