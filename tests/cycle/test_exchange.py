"""One cycle's frames by both transports: late, short, missing or slow, and the SYNC's grid."""

import time
from types import SimpleNamespace

import can
import numpy as np
import pytest
from rig import RPDO1, SYNC, TPDO1, Loop, Rig, RigFactory

from canwall.cycle import exchange as exchange_module
from canwall.cycle import python_can as python_can_module
from canwall.cycle.core import SPIN_NS
from canwall.record.ring import FRAMES

PERIOD_NS = 1_000_000


def tpdo(counts: int) -> can.Message:
    data = counts.to_bytes(4, "little", signed=True) + b"\x50\x02\0\0"
    return can.Message(arbitration_id=TPDO1, data=data, is_extended_id=False)


@pytest.fixture
def rig(make_rig: RigFactory, monkeypatch: pytest.MonkeyPatch) -> Rig:
    monkeypatch.setattr(exchange_module, "_SIMULATED_TIMEOUT_S", 0.05)
    return make_rig()


def test_one_cycle_is_sync_tpdo_rpdo(rig: Rig) -> None:
    loop = Loop(rig)
    rig.frames.clear()
    loop.exchange.cycle()
    cyclic = [frame for frame in rig.frames if frame[0] in (SYNC, TPDO1, RPDO1)]
    assert [can_id for can_id, _ in cyclic] == [SYNC, TPDO1, RPDO1]
    assert [len(data) for _, data in cyclic] == [0, 8, 4]


def test_tpdo_that_comes_late_is_not_taken_for_the_next(rig: Rig) -> None:
    loop = Loop(rig)
    rig.tampering.mute.add(TPDO1)
    loop.exchange.cycle()
    rig.drive_bus.send(tpdo(111))  # the one that was missed
    rig.tampering.mute.clear()
    for _ in range(3):
        loop.exchange.cycle()
    rows = loop.rows()
    assert rows["received"].tolist() == [False, True, True, True]
    assert 111 not in rows["counts"]


def test_emergencies_among_the_late_frames_are_heard(rig: Rig) -> None:
    loop = Loop(rig)
    rig.tampering.mute.add(TPDO1)
    loop.exchange.cycle()
    rig.inject(0x085, b"\x30\x81\x11\0\0\0\0\0")
    loop.exchange.cycle()
    assert [emergency.code for emergency in rig.node.emergencies] == [0x8130]


def test_tpdo_that_is_too_short_is_none(rig: Rig) -> None:
    loop = Loop(rig)
    loop.exchange.cycle()
    out = rig.tampering._out
    rig.tampering._out = lambda frames: [(i, data[:7]) for i, data in out(frames)]  # type: ignore[method-assign]
    loop.exchange.cycle()
    rig.tampering._out = out  # type: ignore[method-assign]
    loop.exchange.cycle()
    rows = loop.rows()
    assert rows["received"].tolist() == [True, False, True]
    assert rows["counts"][1] == rows["counts"][0]


def test_tpdo_that_comes_twice_or_late_is_not_taken_for_the_next(rig: Rig) -> None:
    loop = Loop(rig)
    loop.exchange.cycle()
    stale = can.Message(arbitration_id=TPDO1, data=bytes(8), is_extended_id=False)
    out = rig.tampering._out
    rig.tampering._out = lambda frames: 2 * out(frames)  # type: ignore[method-assign]
    for _ in range(3):
        rig.drive_bus.send(stale)
        loop.exchange.cycle()
    while rig.bus.recv(0) is not None:
        pass
    rows = loop.rows()
    assert rows["received"].all()
    assert np.abs(np.diff(rows["counts"])).max() < 10
    tpdos = [data for can_id, data in rig.frames if can_id == TPDO1 and any(data)]
    # All but the last were taken off the bus before their successors.
    assert len(tpdos) == 1 + 2 * 2 + 1


def test_lost_tpdo_of_an_embedded_drive_is_not_waited_for(
    make_rig: RigFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In simulated time: a drive that has been served has said all there is."""
    monkeypatch.setattr(exchange_module, "_SIMULATED_TIMEOUT_S", 20.0)
    loop = Loop(make_rig())
    begin = time.monotonic()
    for muted in ({TPDO1}, set[int](), {TPDO1}):
        loop.rig.tampering.mute = muted
        loop.exchange.cycle()
    assert loop.rows()["received"].tolist() == [False, True, False]
    assert time.monotonic() - begin < 10.0


def test_timing_columns(rig: Rig) -> None:
    loop = Loop(rig)
    for _ in range(3):
        loop.exchange.cycle()
    rows = loop.rows()
    assert rows["sync_interval_s"][0] == 0.0
    assert (rows["sync_interval_s"][1:] > 0.0).all()
    assert (rows["latency_s"] > 0.0).all()
    assert loop.exchange.sync_interval["counts"].sum() == 2
    assert loop.axis.latency["counts"].sum() == 3
    largest = float(loop.axis.latency["largest_ns"][0])
    assert largest == pytest.approx(rows["latency_s"].max() * 1e9)


def test_warming_up_leaves_no_trace(rig: Rig) -> None:
    loop = Loop(rig)
    assert loop.record["j"][0] == 0
    assert loop.record["missed_tpdo"][0] == 0
    assert len(loop.rows()) == 0
    assert loop.axis.latency["counts"].sum() == 0


# The record


def test_simulated_time_waits_for_the_writer_of_the_record(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = Loop(rig)
    loop.ring.header["frame_head"] = FRAMES  # full
    naps: list[float] = []

    def nap(duration_s: float) -> None:
        naps.append(duration_s)
        if len(naps) == 3:
            loop.ring.take_frames()

    monkeypatch.setattr(exchange_module, "time", fake_time(sleep=nap))
    loop.exchange.cycle()
    assert len(naps) == 3
    loop.exchange.cycle()
    assert len(naps) == 3


def test_dead_writer_is_not_waited_for_for_ever(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    loop = Loop(rig)
    loop.ring.header["frame_head"] = FRAMES
    slept: list[float] = []
    monkeypatch.setattr(
        exchange_module, "time", fake_time(sleep=slept.append, monotonic=lambda: len(slept))
    )
    loop.exchange.cycle()
    assert 0 < len(slept) < 20
    before = len(slept)
    loop.exchange.cycle()
    assert len(slept) == before


def fake_time(**functions: object) -> SimpleNamespace:
    return SimpleNamespace(**{**vars(time), **functions})


# Real time: the SYNCs' instants, by a clock of the test's own; compiled code has the machine's

over_python_can = pytest.mark.parametrize("native", ["python-can"], indirect=True)


class Clock:
    """A clock that moves by sleeping, a little by being asked, and by what a cycle takes."""

    def __init__(self) -> None:
        self.now_ns = 5_000_000_000
        self.oversleep_ns = 0

    def perf_counter_ns(self) -> int:
        self.now_ns += 10
        return self.now_ns

    def sleep(self, duration_s: float) -> None:
        self.now_ns += round(duration_s * 1e9) + self.oversleep_ns


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    time_of_the_clock = fake_time(perf_counter_ns=clock.perf_counter_ns, sleep=clock.sleep)
    monkeypatch.setattr(exchange_module, "time", time_of_the_clock)
    monkeypatch.setattr(python_can_module, "time", time_of_the_clock)
    return clock


def syncs(loop: Loop, clock: Clock, cycle_takes_ns: list[int]) -> list[float]:
    """Instants of the SYNCs in periods since the first; each cycle takes as long as given."""
    instants: list[int] = []
    send = loop.rig.link.send_unlogged

    def noting(message: can.Message) -> None:
        if message.arbitration_id == SYNC:
            instants.append(clock.now_ns)
        send(message)

    loop.rig.link.send_unlogged = noting  # type: ignore[method-assign]
    for duration in cycle_takes_ns:
        loop.exchange.cycle()
        clock.now_ns += duration
    return ((np.array(instants) - instants[0]) / PERIOD_NS).tolist()


@over_python_can
def test_syncs_keep_to_absolute_deadlines(rig: Rig, clock: Clock) -> None:
    loop = Loop(rig, real_time=True)
    clock.oversleep_ns = SPIN_NS + 60_000
    durations = [100_000 * (j % 7) for j in range(50)]
    instants = syncs(loop, clock, durations)
    # Each is late by what the sleep took too long, and none passes it on to the next.
    assert instants == pytest.approx([0.0, *(j + 0.06 for j in range(1, 50))], abs=1e-3)
    assert loop.axis.late_rpdo == 0


@over_python_can
def test_sleep_that_is_a_little_too_long_makes_no_sync_late(rig: Rig, clock: Clock) -> None:
    loop = Loop(rig, real_time=True)
    clock.oversleep_ns = SPIN_NS - 10_000
    assert syncs(loop, clock, [0] * 20) == pytest.approx(range(20), abs=1e-3)


@over_python_can
def test_late_cycle_is_not_made_up_for_by_a_burst(rig: Rig, clock: Clock) -> None:
    loop = Loop(rig, real_time=True)
    instants = syncs(loop, clock, [0, 0, 3_400_000, 0, 0])
    assert instants == pytest.approx([0.0, 1.0, 2.0, 6.0, 7.0], abs=1e-3)


@over_python_can
def test_sync_that_is_a_little_late_is_sent_at_once(rig: Rig, clock: Clock) -> None:
    loop = Loop(rig, real_time=True)
    instants = syncs(loop, clock, [0, 0, 1_400_000, 0, 0])
    assert instants == pytest.approx([0.0, 1.0, 2.0, 3.4, 4.0], abs=1e-3)


@over_python_can
def test_rpdo_after_the_next_sync_was_due_is_late(rig: Rig, clock: Clock) -> None:
    loop = Loop(rig, real_time=True)
    send = rig.link.send_unlogged

    def slow(message: can.Message) -> None:
        send(message)
        if message.arbitration_id == RPDO1 and loop.record["j"][0] == 3:
            clock.now_ns += 1_100_000

    rig.link.send_unlogged = slow  # type: ignore[method-assign]
    for _ in range(6):
        loop.exchange.cycle()
    assert loop.axis.late_rpdo == 1


def test_reset_depends_on_nothing_that_was_heard(make_rig: RigFactory) -> None:
    rig = make_rig()
    said = [bytes([state]) for state in range(0x100)] + [b"", bytes(8)]
    for data in said:
        rig.link.dispatch(can.Message(arbitration_id=0x705, data=data, is_extended_id=False))
        rig.link.dispatch(can.Message(arbitration_id=0, data=b"\x01\x05", is_extended_id=False))
        rig.node.command("RESET")
    assert rig.frames.count((0, b"\x81\x05")) == len(said)
