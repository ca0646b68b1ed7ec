"""Transmission of PDOs: transmission types, inhibit time, event timers, lengths."""

import struct

import pytest
from simdrive_bench import (
    CONTROLWORD,
    EMCY,
    NO_RTR,
    NOT_VALID,
    POSITION,
    PRE_OPERATIONAL,
    RPDO,
    START,
    STATUSWORD,
    TARGET_TORQUE,
    TPDO,
    Bench,
)

MS = 0.001


@pytest.fixture
def quiet(bench: Bench) -> Bench:
    """No valid TPDO, and past NOT READY TO SWITCH ON."""
    bench.tick()
    for number in range(4):
        bench.write(0x1800 + number, 1, NOT_VALID | NO_RTR | TPDO[number + 1], 4)
    return bench


def position_tpdo(bench: Bench, kind: int, inhibit_100us: int = 0, event_ms: int = 0) -> None:
    bench.write(0x1803, 3, inhibit_100us, 2)
    bench.configure_pdo(0x1803, NO_RTR | TPDO[4], kind, [POSITION], event_ms)
    bench.nmt(START)


@pytest.mark.parametrize("kind", [1, 2, 5, 240])
def test_every_nth_sync(quiet: Bench, kind: int) -> None:
    position_tpdo(quiet, kind)
    sent = [bool(quiet.sync()) for _ in range(2 * kind)]
    assert sent == ([False] * (kind - 1) + [True]) * 2


def test_sync_count_begins_with_operational(quiet: Bench) -> None:
    position_tpdo(quiet, 3)
    quiet.sync()
    quiet.nmt(PRE_OPERATIONAL)
    quiet.nmt(START)
    assert [bool(quiet.sync()) for _ in range(3)] == [False, False, True]


def test_acyclic_synchronous_is_sent_with_sync_after_a_change(quiet: Bench) -> None:
    quiet.configure_pdo(0x1800, NO_RTR | TPDO[1], 0, [STATUSWORD])
    assert quiet.nmt(START) == []
    assert quiet.sync() == [(TPDO[1], b"\x50\x02")]
    assert quiet.sync() == []
    quiet.write(0x6040, 0, 6, 2)
    assert quiet.tick() == []
    assert quiet.sync() == [(TPDO[1], b"\x31\x02")]


@pytest.mark.parametrize("kind", [254, 255])
def test_event_driven_is_sent_at_once_and_only_after_a_change(quiet: Bench, kind: int) -> None:
    quiet.configure_pdo(0x1800, NO_RTR | TPDO[1], kind, [STATUSWORD])
    assert quiet.nmt(START) == [(TPDO[1], b"\x50\x02")]
    assert quiet.tick() == []
    assert quiet.sync() == []
    quiet.write(0x6040, 0, 6, 2)
    assert quiet.sent[-1] == (TPDO[1], b"\x31\x02")
    assert quiet.tick(1.0) == []


def test_inhibit_time_keeps_events_apart(quiet: Bench) -> None:
    position_tpdo(quiet, 255, inhibit_100us=25)
    first = quiet.motion.position
    assert quiet.sent[-1] == (TPDO[4], struct.pack("<i", first))
    quiet.sync()
    assert quiet.sync() == []
    last = quiet.motion.position
    assert last != first
    assert quiet.tick(2.4 * MS) == []
    assert quiet.tick(0.1 * MS) == [(TPDO[4], struct.pack("<i", last))]
    assert quiet.tick(1.0) == []


def test_event_timer_sends_what_has_not_changed(quiet: Bench) -> None:
    position_tpdo(quiet, 255, event_ms=10)
    for _ in range(3):
        sent = [quiet.tick(MS) for _ in range(10)]
        assert [len(frames) for frames in sent] == [0] * 9 + [1]


def test_event_restarts_the_event_timer(quiet: Bench) -> None:
    position_tpdo(quiet, 255, event_ms=10)
    quiet.tick(6 * MS)
    quiet.sync()
    assert len(quiet.sync()) == 1
    assert quiet.tick(9 * MS) == []
    assert len(quiet.tick(1 * MS)) == 1


def test_event_timer_respects_the_inhibit_time(quiet: Bench) -> None:
    position_tpdo(quiet, 255, inhibit_100us=200, event_ms=10)
    assert quiet.tick(19 * MS) == []
    assert len(quiet.tick(1 * MS)) == 1


def test_no_event_outside_operational(quiet: Bench) -> None:
    position_tpdo(quiet, 255, event_ms=10)
    quiet.nmt(PRE_OPERATIONAL)
    assert quiet.tick(1.0) == []
    assert len(quiet.nmt(START)) == 1


def test_power_on_configuration(bench: Bench) -> None:
    bench.tick()
    assert bench.nmt(START) == [(TPDO[1], b"\x50\x02"), (TPDO[2], b"\x50\x02\x00")]
    bench.give(RPDO[2], b"\x06\x00\x0a")
    assert bench.sent[-2:] == [(TPDO[1], b"\x31\x02"), (TPDO[2], b"\x31\x02\x0a")]
    assert bench.sync() == [(TPDO[3], struct.pack("<Hi", 0x0231, 1000))]
    bench.give(RPDO[3], b"\x07\x00\x2c\x01")
    assert bench.read(0x6071) == 300
    assert bench.sent[-3][1] == b"\x33\x02"


def test_rpdo_too_long_counts_and_is_reported_once(quiet: Bench) -> None:
    quiet.nmt(START)
    long = b"\x06\x00\x2c\x01\xff"
    frames = quiet.give(RPDO[3], long)
    assert frames[0] == (EMCY, bytes.fromhex("2082 11 0216 00 0000"))
    assert quiet.read(0x6071) == 300
    assert quiet.read(0x6041) == 0x0231
    assert EMCY not in dict(quiet.give(RPDO[3], long))
    assert quiet.give(RPDO[3], long[:3])[0] == (EMCY, bytes.fromhex("1082 11 0216 00 0000"))
    assert [data[:2] for can_id, data in quiet.give(RPDO[3], long[:4]) if can_id == EMCY] == [
        b"\0\0",
        b"\0\0",
    ]
    assert quiet.read(0x1001) == 0


def test_rpdo_too_short_is_ignored_and_reported_once(quiet: Bench) -> None:
    quiet.nmt(START)
    short = b"\x06\x00\x2c"
    assert quiet.give(RPDO[3], short) == [(EMCY, bytes.fromhex("1082 11 0216 00 0000"))]
    assert quiet.give(RPDO[3], short) == []
    assert quiet.read(0x6041) == 0x0250
    assert quiet.read(0x603F) == 0x8210
    assert quiet.give(RPDO[3], b"\x06\x00\x2c\x01")[0] == (
        EMCY,
        bytes.fromhex("0000 00 0216 00 0000"),
    )
    assert quiet.read(0x603F) == 0


@pytest.mark.parametrize("kind", [1, 255])
def test_rpdo_event_timer(bench: Bench, kind: int) -> None:
    bench.configure_cycle()
    bench.configure_pdo(0x1402, RPDO[3], kind, [CONTROLWORD, TARGET_TORQUE], event_ms=20)
    bench.nmt(START)
    assert bench.tick(1.0) == []  # watched from the first reception on
    for controlword in (0x06, 0x07, 0x0F):
        bench.command(controlword, 100)
        bench.sync()
    for _ in range(5):
        assert bench.tick(19 * MS) == []
        bench.command(0x0F, 100)
    assert bench.cycle()[::2] == (0x1237, 100)
    bench.tick(19 * MS)
    assert bench.tick(1 * MS) == [(EMCY, bytes.fromhex("5082 11 0214 05 0000"))]
    assert bench.cycle()[::2] == (0x0218, 0)
    assert bench.tick(1.0) == []
    bench.command(0x80, 0)
    bench.sync()
    bench.command(0x80, 0)
    assert bench.cycle()[0] == 0x0250
    assert bench.emergencies() == [(0x8250, 0x11), (0x0000, 0x00)]


@pytest.mark.parametrize(("option", "status"), [(0, 0x1237), (1, 0x0218), (2, 0x0250), (3, 0x0250)])
def test_rpdo_timeout_does_what_0x6007_says(bench: Bench, option: int, status: int) -> None:
    bench.configure_cycle()
    bench.write(0x6007, 0, option, 2)
    bench.write(0x1402, 5, 20, 2)
    bench.nmt(START)
    for controlword in (0x00, 0x06, 0x07, 0x0F):
        bench.command(controlword, 100)
        bench.sync()
    bench.tick(20 * MS)
    assert bench.emergencies() == [(0x8250, 0x11)]
    assert bench.cycle()[0] == status
    bench.command(0x0F, 100)
    assert bench.emergencies()[1:] == ([] if option == 1 else [(0x0000, 0x00)])


def test_rpdo_timer_switched_off_ends_the_error(bench: Bench) -> None:
    bench.write(0x1402, 5, 20, 2)
    bench.nmt(START)
    bench.give(RPDO[3], bytes(4))
    bench.tick(20 * MS)
    bench.write(0x1402, 5, 0, 2)
    assert bench.emergencies() == [(0x8250, 0x11), (0x0000, 0x00)]


def test_rpdo_timer_rests_outside_operational(bench: Bench) -> None:
    bench.write(0x1402, 5, 20, 2)
    bench.nmt(START)
    bench.give(RPDO[3], bytes(4))
    bench.nmt(PRE_OPERATIONAL)
    bench.tick(1.0)
    assert bench.emergencies() == []
