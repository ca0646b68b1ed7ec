"""SYNC counter, communication cycle period, synchronous window; error behaviour."""

import pytest
from canopen import SdoAbortedError
from simdrive_bench import (
    EMCY,
    HEARTBEAT,
    NO_RTR,
    NOT_VALID,
    POSITION,
    START,
    SYNC,
    TPDO,
    Bench,
)

MS = 0.001
LENGTH_ERROR = 0x8240
SYNC_LOST = 0x8700
MASTER = 0x701


@pytest.fixture
def cyclic(bench: Bench) -> Bench:
    bench.configure_cycle()
    bench.enable()
    return bench


def test_counter_overflow_value(bench: Bench) -> None:
    for value in (2, 240, 0):
        bench.write(0x1019, 0, value, 1)
    for value in (1, 241, 255):
        with pytest.raises(SdoAbortedError, match="06090030"):
            bench.write(0x1019, 0, value, 1)
    bench.write(0x1006, 0, 1000, 4)
    with pytest.raises(SdoAbortedError, match="08000022"):
        bench.write(0x1019, 0, 4, 1)


@pytest.mark.parametrize(("overflow", "right", "wrong"), [(0, b"", b"\x01"), (4, b"\x01", b"")])
def test_sync_of_the_wrong_length_is_none(
    cyclic: Bench, overflow: int, right: bytes, wrong: bytes
) -> None:
    cyclic.write(0x1019, 0, overflow, 1)
    assert [can_id for can_id, _ in cyclic.give(SYNC, right)] == [TPDO[3]]
    assert cyclic.give(SYNC, wrong) == [(EMCY, bytes.fromhex("4082 11 1910 00 0000"))]
    assert cyclic.give(SYNC, wrong) == []
    assert [can_id for can_id, _ in cyclic.give(SYNC, right)] == [EMCY, TPDO[3]]
    assert cyclic.emergencies() == [(LENGTH_ERROR, 0x11), (0, 0)]


@pytest.mark.parametrize(("divider", "answered"), [(1, [3, 4, 1, 2, 3, 4, 1]), (2, [3, 1, 3, 1])])
def test_start_value(cyclic: Bench, divider: int, answered: list[int]) -> None:
    cyclic.write(0x1019, 0, 4, 1)
    cyclic.write(0x1803, 1, NOT_VALID | NO_RTR | TPDO[4], 4)
    cyclic.write(0x1803, 6, 3, 1)
    cyclic.configure_pdo(0x1803, NO_RTR | TPDO[4], divider, [POSITION])
    counters = [1, 2, 3, 4, 1, 2, 3, 4, 1]
    sent = [count for count in counters if TPDO[4] in dict(cyclic.give(SYNC, bytes([count])))]
    assert sent == answered
    with pytest.raises(SdoAbortedError, match="08000022"):
        cyclic.write(0x1803, 6, 0, 1)


def test_start_value_means_nothing_without_a_counter(cyclic: Bench) -> None:
    cyclic.write(0x1803, 1, NOT_VALID | NO_RTR | TPDO[4], 4)
    cyclic.write(0x1803, 6, 3, 1)
    cyclic.configure_pdo(0x1803, NO_RTR | TPDO[4], 1, [POSITION])
    assert TPDO[4] in dict(cyclic.sync())


@pytest.mark.parametrize(("option", "status"), [(0, 0x1237), (1, 0x0218), (2, 0x0250), (3, 0x0250)])
def test_missed_sync_does_what_0x6007_says(cyclic: Bench, option: int, status: int) -> None:
    cyclic.write(0x6007, 0, option, 2)
    cyclic.write(0x1006, 0, 10_000, 4)
    assert cyclic.tick(10.0) == []  # none has come yet
    cyclic.command(0x0F)
    cyclic.sync()
    assert cyclic.tick(14 * MS) == []
    cyclic.sync()
    assert cyclic.tick(14 * MS) == []
    assert cyclic.tick(1 * MS) == [(EMCY, bytes.fromhex("0087 11 0610 00 0000"))]
    cyclic.tick()
    assert cyclic.read(0x6041) == status
    cyclic.sync()
    if option != 1:  # a fault is latched
        assert cyclic.emergencies() == [(SYNC_LOST, 0x11), (0, 0)]


def test_no_period_no_watch(cyclic: Bench) -> None:
    cyclic.sync()
    assert cyclic.tick(10.0) == []


def test_rpdo_after_the_window_is_dropped(cyclic: Bench) -> None:
    cyclic.write(0x1007, 0, 2000, 4)
    cyclic.command(0x0F, 100)
    assert cyclic.cycle()[2] == 100  # nothing is late before the first SYNC
    cyclic.tick(2 * MS)
    cyclic.command(0x0F, 200)
    assert cyclic.cycle()[2] == 200
    cyclic.tick(3 * MS)
    cyclic.command(0x0F, 300)
    assert cyclic.cycle()[2] == 200
    cyclic.write(0x1007, 0, 0, 4)
    cyclic.tick(3 * MS)
    cyclic.command(0x0F, 400)
    assert cyclic.cycle()[2] == 400


@pytest.mark.parametrize(("behaviour", "state"), [(0, 0x7F), (1, 0x05), (2, 0x04)])
@pytest.mark.parametrize("guarding", [False, True])
def test_error_behaviour(bench: Bench, behaviour: int, state: int, guarding: bool) -> None:
    bench.write(0x1029, 1, behaviour, 1)
    bench.write(0x1016, 1, 0x0001000A, 4)
    bench.write(0x100C, 0, 10, 2)
    bench.write(0x100D, 0, 1, 1)
    bench.nmt(START)
    if guarding:
        bench.request(HEARTBEAT)
    else:
        bench.give(MASTER, b"\x05")
    bench.tick(10 * MS)
    ((_, (shown,)),) = bench.request(HEARTBEAT)[:1]
    assert shown & 0x7F == state
    assert bench.emergencies()[0] == (0x8130, 0x11)


def test_error_behaviour_that_there_is_none_of(bench: Bench) -> None:
    with pytest.raises(SdoAbortedError, match="06090030"):
        bench.write(0x1029, 1, 3, 1)
