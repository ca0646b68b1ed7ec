"""NMT commands and resets, boot-up, heartbeat on both sides, EMCY and the error history."""

import pytest
from canopen import SdoAbortedError
from simdrive_bench import (
    EDS,
    EMCY,
    HEARTBEAT,
    NODE_ID,
    PERIOD_S,
    PRE_OPERATIONAL,
    RESET_COMMUNICATION,
    RESET_NODE,
    RPDO,
    SDO_REQUEST,
    START,
    STOP,
    SYNC,
    Bench,
    RecordingMotion,
)

from canwall.simdrive import Dictionary, ServoDrive

MS = 0.001
MASTER = 1
MASTER_HEARTBEAT = 0x700 + MASTER
WATCH_MASTER_100_MS = MASTER << 16 | 100
ALL = 0


def nmt_state(bench: Bench) -> int:
    """Return the NMT state as the heartbeat shows it."""
    bench.write(0x1017, 0, 1, 2)
    ((_, data),) = [frame for frame in bench.tick(1 * MS) if frame[0] == HEARTBEAT]
    return data[0]


def test_boot_up(bench: Bench) -> None:
    assert bench.sent == [(HEARTBEAT, b"\x00")]
    assert nmt_state(bench) == 127


def test_dead_before_boot() -> None:
    motion = RecordingMotion()
    drive = ServoDrive(Dictionary.load(EDS, NODE_ID), NODE_ID, motion, PERIOD_S)
    assert drive.process(SDO_REQUEST, b"\x40\x00\x10\x00\x00\x00\x00\x00") == []
    assert drive.process(SYNC, b"") == []
    assert drive.process(0x000, b"\x01\x00") == []
    assert drive.tick(1.0) == []
    assert motion.calls == []
    assert drive.boot() == [(HEARTBEAT, b"\x00")]


@pytest.mark.parametrize("address", [ALL, NODE_ID])
@pytest.mark.parametrize(("command", "state"), [(START, 5), (STOP, 4), (PRE_OPERATIONAL, 127)])
def test_state_commands(bench: Bench, command: int, state: int, address: int) -> None:
    bench.write(0x1017, 0, 1, 2)
    bench.nmt(START)
    bench.nmt(command, address)
    assert (HEARTBEAT, bytes([state])) in bench.tick(1 * MS)


@pytest.mark.parametrize("data", [b"", b"\x01", b"\x01\x05\x00", b"\x01\x06", b"\x7f\x05"])
def test_no_command_to_this_node(bench: Bench, data: bytes) -> None:
    bench.give(0x000, data)
    assert nmt_state(bench) == 127


def test_reset_communication_reloads_0x1000_to_0x1fff(bench: Bench) -> None:
    bench.enable()
    bench.write(0x1005, 0, 0x1F1, 4)
    bench.write(0x1402, 5, 20, 2)
    bench.write(0x6072, 0, 1500, 2)
    bench.write(0x6007, 0, 2, 2)
    assert bench.nmt(RESET_COMMUNICATION) == [(HEARTBEAT, b"\x00")]
    assert bench.read(0x1005) == 0x80
    assert bench.read(0x1402, 5) == 0
    assert bench.read(0x6072) == 1500
    assert bench.read(0x6041) == 0x0250  # disabled, no fault
    assert nmt_state(bench) == 127


def test_reset_node_reloads_everything(bench: Bench) -> None:
    bench.enable()
    bench.write(0x1017, 0, 7, 2)
    bench.write(0x6072, 0, 1500, 2)
    bench.write(0x6071, 0, 900, 2)
    bench.motion.calls.clear()
    assert bench.nmt(RESET_NODE) == [(HEARTBEAT, b"\x00")]
    assert bench.read(0x6041) == 0
    assert bench.read(0x6072) == 3000
    assert bench.read(0x6071) == 0
    assert bench.read(0x6061) == 0
    assert bench.read(0x6064) == bench.motion.position
    assert bench.tick(1.0) == []  # no heartbeat
    assert bench.read(0x6041) == 0x0250


def test_reset_restores_the_pdos(bench: Bench) -> None:
    bench.tick()
    power_on = bench.nmt(START)
    bench.nmt(PRE_OPERATIONAL)
    bench.configure_cycle()
    bench.nmt(RESET_COMMUNICATION)
    assert [can_id for can_id, _ in bench.nmt(START)] == [can_id for can_id, _ in power_on]
    bench.give(RPDO[1], b"\x06\x00")
    assert bench.read(0x6041) == 0x0231


def test_heartbeat_producer(bench: Bench) -> None:
    bench.write(0x1017, 0, 50, 2)
    sent = [bench.tick(10 * MS) for _ in range(15)]
    beats = [n for n, frames in enumerate(sent, start=1) if frames]
    assert beats == [5, 10, 15]
    assert sent[4] == [(HEARTBEAT, b"\x7f")]
    bench.nmt(STOP)
    assert [f for _ in range(5) for f in bench.tick(10 * MS)] == [(HEARTBEAT, b"\x04")]


def test_heartbeats_that_were_slept_through_are_not_made_up_for(bench: Bench) -> None:
    bench.write(0x1017, 0, 50, 2)
    assert len(bench.tick(1.0)) == 1
    assert bench.tick(49 * MS) == []
    assert len(bench.tick(1 * MS)) == 1


def test_heartbeat_keeps_its_pace_with_late_ticks(bench: Bench) -> None:
    bench.write(0x1017, 0, 50, 2)
    assert len(bench.tick(59 * MS)) == 1
    assert len(bench.tick(41 * MS)) == 1


def test_heartbeat_consumer_begins_with_the_first_heartbeat(bench: Bench) -> None:
    bench.write(0x1016, 1, WATCH_MASTER_100_MS, 4)
    bench.tick(10.0)
    bench.give(MASTER_HEARTBEAT, b"\x00")  # boot-up is none
    bench.tick(10.0)
    assert bench.emergencies() == []
    bench.give(MASTER_HEARTBEAT, b"\x05")
    bench.tick(99 * MS)
    bench.give(MASTER_HEARTBEAT, b"\x05")
    bench.tick(99 * MS)
    assert bench.emergencies() == []
    assert bench.tick(1 * MS) == [(EMCY, bytes.fromhex("3081 11 1610 01 0000"))]
    assert bench.tick(10.0) == []


@pytest.mark.parametrize(("option", "status"), [(0, 0x1237), (1, 0x0218), (2, 0x0250), (3, 0x0250)])
def test_heartbeat_loss_does_what_0x6007_says(bench: Bench, option: int, status: int) -> None:
    bench.enable()
    bench.write(0x6007, 0, option, 2)
    bench.write(0x1016, 2, WATCH_MASTER_100_MS, 4)
    bench.give(MASTER_HEARTBEAT, b"\x05")
    bench.tick(100 * MS)
    bench.tick()
    assert bench.emergencies() == [(0x8130, 0x11)]
    assert bench.read(0x6041) == status
    bench.give(MASTER_HEARTBEAT, b"\x05")
    if option == 1:  # latched until the fault is reset
        assert bench.read(0x603F) == 0x8130
        bench.write(0x6040, 0, 0x80, 2)
    assert bench.emergencies() == [(0x8130, 0x11), (0x0000, 0x00)]
    bench.tick(100 * MS)
    assert bench.emergencies()[2:] == [(0x8130, 0x11)]


def test_reset_ends_the_watch(bench: Bench) -> None:
    bench.write(0x1016, 1, WATCH_MASTER_100_MS, 4)
    bench.give(MASTER_HEARTBEAT, b"\x05")
    bench.nmt(RESET_COMMUNICATION)
    assert bench.tick(1.0) == []


def test_consumer_watches_in_stopped_and_is_silent_there(bench: Bench) -> None:
    bench.write(0x1016, 1, WATCH_MASTER_100_MS, 4)
    bench.give(MASTER_HEARTBEAT, b"\x05")
    bench.nmt(STOP)
    assert bench.tick(1.0) == []
    bench.nmt(PRE_OPERATIONAL)
    assert bench.read(0x1003, 1) == 0x10168130


def test_rewriting_the_consumer_ends_watch_and_error(bench: Bench) -> None:
    bench.write(0x1016, 1, WATCH_MASTER_100_MS, 4)
    bench.give(MASTER_HEARTBEAT, b"\x05")
    bench.tick(1.0)
    bench.write(0x1016, 1, 0, 4)
    assert bench.emergencies() == [(0x8130, 0x11), (0x0000, 0x00)]
    bench.give(MASTER_HEARTBEAT, b"\x05")
    bench.tick(1.0)
    assert len(bench.emergencies()) == 2


def test_one_node_may_be_watched_once(bench: Bench) -> None:
    bench.write(0x1016, 1, WATCH_MASTER_100_MS, 4)
    bench.write(0x1016, 1, WATCH_MASTER_100_MS + 1, 4)
    bench.write(0x1016, 2, MASTER << 16, 4)  # no time: not used
    with pytest.raises(SdoAbortedError, match="06040043"):
        bench.write(0x1016, 2, WATCH_MASTER_100_MS, 4)


def test_error_history(bench: Bench) -> None:
    bench.nmt(START)
    for _ in range(5):
        bench.give(RPDO[1], b"")
        bench.give(RPDO[2], b"")
        bench.give(RPDO[1], bytes(2))
        bench.give(RPDO[2], bytes(3))
    assert bench.read(0x1003, 0) == 8
    assert [bench.read(0x1003, n) for n in range(1, 9)] == [0x16018210, 0x16008210] * 4
    bench.write(0x1003, 0, 0, 1)
    assert bench.read(0x1003, 0) == 0
    with pytest.raises(SdoAbortedError, match="08000024"):
        bench.read(0x1003, 1)


def test_error_register_stays_while_one_error_does(bench: Bench) -> None:
    bench.nmt(START)
    bench.give(RPDO[1], b"")
    bench.give(RPDO[2], b"")
    bench.give(RPDO[2], bytes(3))
    assert bench.emergencies() == [(0x8210, 0x11), (0x8210, 0x11), (0x0000, 0x11)]
    assert bench.read(0x1001) == 0x11


def test_emcy_identifier(bench: Bench) -> None:
    bench.nmt(START)
    bench.write(0x1014, 0, 0x80000085, 4)
    bench.give(RPDO[1], b"")
    assert bench.emergencies() == []
    bench.write(0x1014, 0, 0x1F2, 4)
    assert bench.give(RPDO[1], bytes(2))[0][0] == 0x1F2
