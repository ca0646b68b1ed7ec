"""Remote frames: node guarding, life guarding, and TPDOs that are asked for."""

from pathlib import Path

import pytest
from simdrive_bench import (
    EDS,
    EMCY,
    HEARTBEAT,
    NO_RTR,
    NOT_VALID,
    POSITION,
    PRE_OPERATIONAL,
    RESET_COMMUNICATION,
    START,
    STATUSWORD,
    STOP,
    SYNC,
    TPDO,
    Bench,
)

MS = 0.001


def watch(bench: Bench, guard_ms: int = 50, factor: int = 2) -> None:
    bench.write(0x100C, 0, guard_ms, 2)
    bench.write(0x100D, 0, factor, 1)


def test_state_and_toggle_bit(bench: Bench) -> None:
    assert bench.request(HEARTBEAT) == [(HEARTBEAT, b"\x7f")]
    assert bench.request(HEARTBEAT) == [(HEARTBEAT, b"\xff")]
    bench.nmt(START)
    assert bench.request(HEARTBEAT) == [(HEARTBEAT, b"\x05")]
    bench.nmt(STOP)
    assert bench.request(HEARTBEAT) == [(HEARTBEAT, b"\x84")]
    bench.nmt(PRE_OPERATIONAL)
    bench.request(HEARTBEAT)
    bench.nmt(RESET_COMMUNICATION)
    assert bench.request(HEARTBEAT) == [(HEARTBEAT, b"\x7f")]


def test_heartbeat_goes_before_guarding(bench: Bench) -> None:
    bench.write(0x1017, 0, 10, 2)
    assert bench.request(HEARTBEAT) == []


def test_heartbeat_ends_life_guarding(bench: Bench) -> None:
    watch(bench)
    bench.request(HEARTBEAT)
    bench.write(0x1017, 0, 1000, 2)
    assert bench.tick(200 * MS) == []
    bench.write(0x1017, 0, 0, 2)
    assert bench.tick(200 * MS) == []


def test_without_guard_time_there_is_no_guarding(tmp_path: Path) -> None:
    path = tmp_path / "unguarded.eds"
    path.write_text(EDS.read_text().replace("[100C]", "[2FFF]"))
    assert Bench(path).request(HEARTBEAT) == []


def test_life_time_begins_with_the_first_request(bench: Bench) -> None:
    watch(bench)
    bench.tick(10.0)
    bench.request(HEARTBEAT)
    assert bench.tick(99 * MS) == []
    bench.request(HEARTBEAT)
    assert bench.tick(99 * MS) == []
    assert bench.tick(1 * MS) == [(EMCY, bytes.fromhex("3081 11 0d10 00 0000"))]
    assert bench.tick(10.0) == []
    bench.request(HEARTBEAT)
    assert bench.emergencies() == [(0x8130, 0x11), (0x0000, 0x00)]
    bench.tick(100 * MS)
    assert bench.emergencies()[2:] == [(0x8130, 0x11)]


@pytest.mark.parametrize(("guard_ms", "factor"), [(0, 3), (50, 0)])
def test_no_life_time_no_watch(bench: Bench, guard_ms: int, factor: int) -> None:
    watch(bench, guard_ms, factor)
    bench.request(HEARTBEAT)
    assert bench.tick(10.0) == []


@pytest.mark.parametrize(("option", "status"), [(0, 0x1237), (1, 0x0218), (2, 0x0250), (3, 0x0250)])
def test_loss_does_what_0x6007_says(bench: Bench, option: int, status: int) -> None:
    bench.enable()
    bench.write(0x6007, 0, option, 2)
    watch(bench)
    bench.request(HEARTBEAT)
    bench.tick(100 * MS)
    bench.tick()
    assert bench.read(0x6041) == status
    assert bench.emergencies() == [(0x8130, 0x11)]


def test_rewriting_the_time_ends_watch_and_error(bench: Bench) -> None:
    watch(bench)
    bench.request(HEARTBEAT)
    bench.tick(1.0)
    bench.write(0x100C, 0, 0, 2)
    assert bench.emergencies() == [(0x8130, 0x11), (0x0000, 0x00)]
    watch(bench)
    assert bench.tick(1.0) == []


@pytest.mark.parametrize("kind", [0, 1, 240, 254, 255])
def test_tpdo_that_is_asked_for(bench: Bench, kind: int) -> None:
    bench.configure_pdo(0x1803, TPDO[4], kind, [POSITION])
    assert bench.request(TPDO[4]) == []
    bench.nmt(START)
    position = (TPDO[4], bench.motion.position.to_bytes(4, "little"))
    assert position in bench.request(TPDO[4])
    bench.nmt(STOP)
    assert bench.request(TPDO[4]) == []


def position_now(bench: Bench) -> tuple[int, bytes]:
    return TPDO[4], bench.motion.position.to_bytes(4, "little")


@pytest.fixture
def quiet(bench: Bench) -> Bench:
    """No TPDO but the fourth is there."""
    for index, can_id in ((0x1800, 0x185), (0x1801, 0x285), (0x1802, 0x385)):
        bench.write(index, 1, NOT_VALID | can_id, 4)
    return bench


@pytest.mark.parametrize("kind", [252, 253])
def test_tpdo_for_remote_frames_alone(quiet: Bench, kind: int) -> None:
    quiet.configure_pdo(0x1803, TPDO[4], kind, [POSITION], event_ms=1)
    assert quiet.read(0x1803, 2) == kind
    assert quiet.nmt(START) == []
    assert quiet.request(TPDO[4]) == [position_now(quiet)]
    for _ in range(3):
        assert quiet.sync() == []
        assert quiet.tick(1.0) == []
    assert len(quiet.request(TPDO[4])) == 1


def test_remote_frame_gets_the_last_sample(quiet: Bench) -> None:
    """252: what the last SYNC has sampled; 253: what is there now."""
    sampled, present = [STATUSWORD], [STATUSWORD]
    quiet.tick()
    quiet.configure_pdo(0x1802, TPDO[3], 252, sampled)
    quiet.configure_pdo(0x1803, TPDO[4], 253, present)
    quiet.nmt(START)
    quiet.sync()
    quiet.write(0x6040, 0, 0x06, 2)
    assert quiet.request(TPDO[3]) == [(TPDO[3], b"\x50\x02")]
    assert quiet.request(TPDO[4]) == [(TPDO[4], b"\x31\x02")]
    quiet.sync()
    assert quiet.request(TPDO[3]) == [(TPDO[3], b"\x31\x02")]


def test_tpdo_that_does_not_answer(bench: Bench) -> None:
    bench.configure_pdo(0x1803, NO_RTR | TPDO[4], 1, [POSITION])
    bench.nmt(START)
    assert bench.request(TPDO[4]) == []
    bench.write(0x1803, 1, NOT_VALID | TPDO[4], 4)
    assert bench.request(TPDO[4]) == []


@pytest.mark.parametrize("can_id", [SYNC, 0x000, 0x605, 0x205, 0x704])
def test_other_remote_frames_are_ignored(bench: Bench, can_id: int) -> None:
    bench.nmt(START)
    calls = len(bench.motion.calls)
    assert bench.request(can_id) == []
    assert len(bench.motion.calls) == calls
