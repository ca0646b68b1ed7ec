"""The core of the cycle alone: frames and times of the test's own, without a bus or a clock."""

import weakref
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rig import settings_with

from canwall.bus.raw_socket import CAN_RTR
from canwall.cycle import Exchange, Transport, Trip, WallAxis, run_laws, start_at
from canwall.cycle.core import SPIN_NS, Want, abandon, begin, next_deadline, proceed, take
from canwall.drive import DriveNode, DriveSetup, Field, Link, PdoLayout, Watchdog
from canwall.drive.watchdog import NO_WATCHDOG, ErrorControlFrame
from canwall.record import Phase, Ring
from canwall.record.controls import Controls
from canwall.units import DriveUnits

PERIOD_NS = 1_000_000
SYNC, TPDO, RPDO = 0x080, 0x180, 0x200
ENABLED = 0x0237
#: Beginning of time: 0 would be no time.
START_NS = 1_000_000_000

Frame = tuple[int, int, int]


def no_transport(link: Link, core: object, frames: object) -> Transport:
    """Make a transport that never moves a frame; the bench does that."""
    return cast(Transport, SimpleNamespace(run=lambda: Want.DONE))


class Bench:
    """A core, its drives and the time; `frames` are those that it has sent, with their time."""

    def __init__(
        self,
        drives: int = 1,
        real_time: bool = False,
        external_sync: bool = False,
        watchdog: Watchdog = NO_WATCHDOG,
        overflow: int = 0,
    ) -> None:
        ring = Ring.create()
        weakref.finalize(self, ring.close)
        self.axes = [_axis(5 + k, watchdog, overflow, ring) for k in range(drives)]
        self.link = Link(cast(can.BusABC, SimpleNamespace()))
        self.exchange = Exchange(self.link, self.axes, real_time, external_sync, no_transport)
        self.exchange._choose_handling()
        self.core = self.exchange._core
        self.now_ns = START_NS
        self.frames: list[tuple[int, Frame]] = []

    def begin(self, most: int = 1) -> Want:
        begin(self.core, most, 0)
        return self.proceed()

    def proceed(self) -> Want:
        """Go on at the present time; frames that are to be sent are, at once."""
        return self._served(proceed(self.core, self.now_ns))

    def take(self, can_id: int, data: bytes = b"", stamp_ns: int = 0) -> Want:
        number = int.from_bytes(data, "little", signed=True)
        return self._served(take(self.core, can_id, len(data), number, self.now_ns, stamp_ns))

    def _served(self, want: int) -> Want:
        while want == Want.SEND:
            can_id, length, number = self.core["out"][0].tolist()
            self.frames.append((self.now_ns, (can_id, length, number)))
            want = proceed(self.core, self.now_ns)
        return Want(want)

    def cycle(self) -> Want:
        """One cycle in simulated time, in which every drive answers."""
        assert self.begin() == Want.DRAIN
        assert self.proceed() == Want.FRAME
        want = Want.FRAME
        for axis in self.axes:
            want = self.take(axis.setup.tpdo.cob_id, tpdo())
        return want

    @property
    def sent(self) -> list[int]:
        return [frame[0] for _, frame in self.frames]


def tpdo(counts: int = 0, statusword: int = ENABLED) -> bytes:
    return counts.to_bytes(4, "little", signed=True) + statusword.to_bytes(2, "little") + b"\0\0"


def _axis(node_id: int, watchdog: Watchdog, overflow: int, ring: Ring) -> WallAxis:
    settings = settings_with({"wall.law": "standard"})
    layout = PdoLayout(
        TPDO + node_id,
        (Field(0x6064, 0, 0, 32), Field(0x6041, 0, 32, 16), Field(0x6077, 0, 48, 16)),
    )
    rpdo = PdoLayout(RPDO + node_id, (Field(0x6040, 0, 0, 16), Field(0x6071, 0, 16, 16)))
    setup = DriveSetup(DriveUnits(131072.0, 0.637), SYNC, layout, rpdo, watchdog)
    setup = replace(setup, sync_counter_overflow=overflow)
    node = cast(DriveNode, SimpleNamespace(node_id=node_id, emergencies=[]))
    axis = WallAxis(node, setup, settings, run_laws(settings), ring)
    axis.cycle["phase"], axis.cycle["controlword"] = Phase.RENDERING, 0x0F
    start_at(axis.cycle, 0)
    return axis


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.mark.parametrize("received", [True, False])
def test_stop_word_takes_the_torque_out_of_the_next_rpdo(received: bool) -> None:
    """It is written after the SYNC, before the TPDO: nobody in Python is asked in between."""
    bench = Bench()
    (axis,) = bench.axes

    def cycle(between: Callable[[], None]) -> tuple[Want, int]:
        bench.begin(1000)
        bench.proceed()
        between()
        if received:
            want = bench.take(axis.setup.tpdo.cob_id, tpdo(-100))
        else:
            for _ in range(2):  # in simulated time there is a second look
                bench.now_ns += 2_000_000_000
                want = bench.proceed()
        rpdos = [number for _, (can_id, _, number) in bench.frames if can_id == RPDO + 5]
        return want, rpdos[-1]

    with closing(Controls.create()) as controls:
        axis.open_controls(controls)
        if received:
            want, rpdo = cycle(lambda: None)
            assert want == Want.DRAIN  # the next cycle
            assert rpdo >> 16 > 0
            abandon(bench.core)
        # The cycle ends, and no further one begins, for the loop to take the drive down.
        assert cycle(controls.stop) == (Want.DONE, 0x0F)
        assert axis.cycle["trip"][0] == Trip.STOPPED


def test_cycle_is_sync_tpdo_rpdo(bench: Bench) -> None:
    assert bench.cycle() == Want.DONE
    assert bench.frames == [(START_NS, (SYNC, 0, 0)), (START_NS, (RPDO + 5, 4, 0x0F))]
    (row,) = bench.axes[0].ring.take_rows()
    assert row["received"]


def test_several_cycles_follow_one_another(bench: Bench) -> None:
    assert bench.begin(3) == Want.DRAIN
    for left in (2, 1, 0):
        assert bench.proceed() == Want.FRAME
        bench.now_ns += 50_000
        assert bench.take(TPDO + 5, tpdo()) == (Want.DRAIN if left else Want.DONE)
    rows = bench.axes[0].ring.take_rows()
    assert rows["j"].tolist() == [0, 1, 2]
    assert rows["sync_interval_s"].tolist() == [0.0, 50e-6, 50e-6]


def test_each_drive_is_answered_when_it_comes() -> None:
    bench = Bench(drives=3)
    bench.begin()
    bench.proceed()
    for node_id in (6, 5):
        assert bench.take(TPDO + node_id, tpdo()) == Want.FRAME
        assert bench.sent[-1] == RPDO + node_id
    assert bench.take(TPDO + 7, tpdo()) == Want.DONE
    assert bench.sent == [SYNC, RPDO + 6, RPDO + 5, RPDO + 7]


def test_tpdo_that_does_not_come_is_answered_for_in_time() -> None:
    bench = Bench(drives=2)
    bench.begin()
    bench.proceed()
    bench.take(TPDO + 6, tpdo())
    until_ns = int(bench.core["until_ns"][0])
    assert until_ns == START_NS + 1_000_000_000
    bench.now_ns = until_ns - 1
    assert bench.proceed() == Want.FRAME
    # The machine may have been away, so there is a second look.
    bench.now_ns = until_ns
    assert bench.proceed() == Want.FRAME
    until_ns = int(bench.core["until_ns"][0])
    assert until_ns == bench.now_ns + 50_000_000
    bench.now_ns = until_ns
    assert bench.proceed() == Want.DONE
    assert bench.sent == [SYNC, RPDO + 6, RPDO + 5]
    assert [int(axis.cycle["missed_tpdo"][0]) for axis in bench.axes] == [1, 0]
    # The next one is not waited for as long.
    bench.begin()
    bench.proceed()
    assert int(bench.core["until_ns"][0]) == until_ns + 50_000_000


def test_short_tpdo_counts_as_none(bench: Bench) -> None:
    bench.begin()
    bench.proceed()
    assert bench.take(TPDO + 5, tpdo()[:7]) == Want.DONE
    assert bench.axes[0].wrong_length == 7
    (row,) = bench.axes[0].ring.take_rows()
    assert not row["received"]


@pytest.mark.parametrize("extra", [b"", b"\xff"])
def test_tpdo_that_is_long_enough_counts(bench: Bench, extra: bytes) -> None:
    bench.begin()
    bench.proceed()
    bench.take(TPDO + 5, (tpdo(counts=7) + extra)[:8])
    assert bench.axes[0].wrong_length is None
    assert bench.axes[0].ring.take_rows()["counts"].tolist() == [7]


def test_tpdo_before_the_sync_is_a_late_one(bench: Bench) -> None:
    assert bench.begin() == Want.DRAIN
    assert bench.take(TPDO + 5, tpdo(counts=999)) == Want.DRAIN
    bench.proceed()
    bench.take(TPDO + 5, tpdo(counts=1))
    assert bench.axes[0].ring.take_rows()["counts"].tolist() == [1]


def test_remote_frame_with_the_tpdos_identifier_is_none(bench: Bench) -> None:
    bench.begin()
    bench.proceed()
    assert bench.take((TPDO + 5) | CAN_RTR) == Want.FRAME


@pytest.mark.parametrize(
    ("can_id", "data", "urgent"),
    [
        (0x085, bytes(8), True),
        (0x705, b"\x04", True),
        (0x705, b"\x05", False),
        (0x705, b"\x05\x05", True),
        (SYNC, b"", True),
        (0x300, b"\x01", False),
        (0x20000040, bytes(8), True),
    ],
    ids=["EMCY", "stopped", "operational", "two bytes", "SYNC", "other", "error frame"],
)
def test_what_may_end_the_wall_is_handed_over_before_the_torque(
    bench: Bench, can_id: int, data: bytes, urgent: bool
) -> None:
    bench.begin()
    bench.proceed()
    assert bench.take(can_id, data) == (Want.HAND_OVER if urgent else Want.FRAME)
    assert bench.proceed() == Want.FRAME
    assert bench.take(TPDO + 5, tpdo()) == Want.DONE
    # The same while the bus is drained: before the SYNC.
    bench.begin()
    assert bench.take(can_id, data) == Want.DRAIN
    syncs = bench.sent.count(SYNC)
    assert bench.proceed() == (Want.HAND_OVER if urgent else Want.FRAME)
    assert bench.sent.count(SYNC) == syncs + (not urgent)


def test_pdo_that_nobody_subscribed_to_is_not_handed_over(bench: Bench) -> None:
    bench.begin()
    for can_id in (0x381, 0x700):
        bench.take(can_id, b"\x01")
    handed = [int(frame["can_id"]) for frame in bench.exchange._inbox.take()]
    assert handed == [0x700]


def test_frames_for_python_end_many_cycles(bench: Bench) -> None:
    bench.begin(10)
    bench.take(0x701, b"\x01")
    bench.proceed()
    assert bench.take(TPDO + 5, tpdo()) == Want.DONE


def test_sync_counts_up_to_its_overflow_value() -> None:
    bench = Bench(overflow=3)
    for _ in range(7):
        bench.cycle()
    syncs = [frame for _, frame in bench.frames if frame[0] == SYNC]
    assert syncs == [(SYNC, 1, n) for n in (1, 2, 3, 1, 2, 3, 1)]


def test_error_control_frames_are_sent_when_they_are_due() -> None:
    frame = ErrorControlFrame(0x77F, b"\x05")
    bench = Bench(drives=2, watchdog=Watchdog("consumer heartbeat", 0.1, frame, 0.0025))
    for _ in range(6):
        bench.cycle()
        bench.now_ns += PERIOD_NS
    instants = [now_ns for now_ns, sent in bench.frames if sent[0] == 0x77F]
    # One for both drives, with the first cycle and then as soon as 2.5 ms are over.
    assert [(t - START_NS) // PERIOD_NS for t in instants] == [0, 3]
    assert (0x77F, 1, 5) in [sent for _, sent in bench.frames]


def test_guarding_is_a_remote_frame() -> None:
    frame = ErrorControlFrame(0x705, remote=True)
    bench = Bench(watchdog=Watchdog("life guarding", 0.1, frame, 0.03))
    bench.cycle()
    assert bench.sent[-1] == 0x705 | CAN_RTR


def test_real_time_sleeps_drains_spins_and_sends() -> None:
    bench = Bench(real_time=True)
    assert bench.begin() == Want.DRAIN
    assert bench.proceed() == Want.FRAME  # the first SYNC is due at once
    bench.now_ns += 100_000
    bench.take(TPDO + 5, tpdo())
    assert bench.begin() == Want.SLEEP
    assert int(bench.core["until_ns"][0]) == START_NS + PERIOD_NS - SPIN_NS
    bench.now_ns = START_NS + PERIOD_NS - SPIN_NS
    assert bench.proceed() == Want.DRAIN
    assert bench.proceed() == Want.SPIN
    bench.now_ns = START_NS + PERIOD_NS - 1
    assert bench.proceed() == Want.SPIN
    bench.now_ns += 1
    assert bench.proceed() == Want.FRAME
    assert bench.frames[-1] == (START_NS + PERIOD_NS, (SYNC, 0, 0))


def test_late_rpdo_is_counted_against_the_next_sync() -> None:
    bench = Bench(real_time=True)
    late = []
    for takes_ns in (PERIOD_NS - 1, PERIOD_NS, PERIOD_NS + 1, PERIOD_NS + 2, 10_000):
        assert bench.begin() == Want.DRAIN
        bench.proceed()
        bench.now_ns += takes_ns
        bench.take(TPDO + 5, tpdo())
        late.append((bench.axes[0].late_rpdo, bench.axes[0].late_in_a_row))
        bench.now_ns = int(bench.core["deadline_ns"][0])
    assert late == [(0, 0), (0, 0), (1, 1), (2, 2), (2, 0)]


@pytest.mark.parametrize("late", [0, 400_000, 600_000, 3_400_000, 3_600_000])
def test_master_that_stood_still_keeps_to_the_grid(late: int) -> None:
    bench = Bench(real_time=True)
    bench.begin()
    bench.proceed()
    bench.now_ns += 100_000
    bench.take(TPDO + 5, tpdo())
    bench.now_ns = START_NS + PERIOD_NS + late
    want = bench.begin()
    while not (want == Want.FRAME and bench.sent[-1] == SYNC):
        bench.now_ns += 10_000
        want = bench.proceed()
    sent_ns = bench.frames[-1][0]
    assert abs((sent_ns - START_NS + PERIOD_NS // 2) % PERIOD_NS - PERIOD_NS // 2) <= 410_000
    assert sent_ns - (START_NS + PERIOD_NS + late) < PERIOD_NS
    skipped = round((sent_ns - START_NS) / PERIOD_NS) - 1
    assert bench.axes[0].cycle["skipped"][0] == skipped


def test_no_sync_is_skipped_in_simulated_time(bench: Bench) -> None:
    for _ in range(3):
        bench.cycle()
        bench.now_ns += 7 * PERIOD_NS
        assert bench.axes[0].cycle["skipped_sync"][0] == 0


def test_external_sync_is_skipped_by_the_kernels_stamp() -> None:
    bench = Bench(real_time=True, external_sync=True)
    assert bench.begin() == Want.DRAIN
    for stamp, skipped in ((1, 0), (2, 0), (5, 2), (6, 2)):
        bench.proceed()
        bench.begin()
        bench.now_ns += 50 * PERIOD_NS  # frames that have waited for the master
        bench.take(SYNC, stamp_ns=START_NS + stamp * PERIOD_NS)
        bench.take(TPDO + 5, tpdo())
        assert bench.axes[0].cycle["skipped_sync"][0] == skipped


def test_rpdo_on_an_external_sync_that_has_waited_is_late() -> None:
    """The next SYNC is on the bus already, though the master has not seen it."""
    bench = Bench(real_time=True, external_sync=True)
    bench.begin()
    bench.proceed()
    late = []
    for waited_ns in (100_000, 900_000, 1_100_000, 100_000):
        bench.begin()
        bench.now_ns += PERIOD_NS
        bench.take(SYNC, stamp_ns=bench.now_ns - waited_ns)
        bench.take(TPDO + 5, tpdo())
        late.append((bench.axes[0].late_rpdo, bench.axes[0].late_in_a_row))
    assert late == [(0, 0), (0, 0), (1, 1), (1, 0)]


def test_external_syncs_before_the_first_cycle_are_over() -> None:
    bench = Bench(real_time=True, external_sync=True)
    assert bench.begin() == Want.DRAIN
    for _ in range(50):
        assert bench.take(SYNC) == Want.DRAIN
        assert bench.take(TPDO + 5, tpdo()) == Want.DRAIN
    while bench.proceed() != Want.FRAME:
        pass
    assert bench.sent == []
    bench.take(SYNC)
    assert bench.take(TPDO + 5, tpdo()) == Want.DONE
    assert bench.sent == [RPDO + 5]


@pytest.mark.parametrize(("factor", "told"), [(1.0, False), (1.25, True), (0.5, True)])
def test_external_sync_with_another_period_is_found(factor: float, told: bool) -> None:
    period_ns = round(factor * PERIOD_NS)
    bench = Bench(real_time=True, external_sync=True)
    bench.begin()
    bench.proceed()
    for _ in range(20):
        bench.begin()
        bench.now_ns += period_ns
        bench.take(SYNC)
        bench.take(TPDO + 5, tpdo())
    found_s = bench.exchange.other_period_s
    assert found_s == (pytest.approx(period_ns * 1e-9, rel=1.0 / 32.0) if told else None)


def test_tpdo_after_its_window_is_a_late_one() -> None:
    bench = Bench(real_time=True)
    bench.begin()
    bench.proceed()
    bench.now_ns = int(bench.core["until_ns"][0])
    assert bench.proceed() == Want.DONE
    bench.now_ns = START_NS + 900_000
    assert bench.begin() == Want.DRAIN
    bench.take(TPDO + 5, tpdo())
    frames = bench.axes[0].frames
    assert (frames["late_tpdo"][0], frames["late_tpdo_ns"][0]) == (1, 900_000)
    assert not bench.axes[0].cycle["overtaken"][0]


def test_second_tpdo_of_a_cycle_shows_that_the_first_was_late(bench: Bench) -> None:
    bench.cycle()
    bench.begin()
    bench.take(TPDO + 5, tpdo(3))
    assert bench.axes[0].cycle["overtaken"][0]
    assert bench.axes[0].frames["late_tpdo"][0] == 0


@given(
    deadline=st.integers(0, 10**15),
    late=st.integers(-(10**9), 10**10),
    period=st.integers(1, 10**9),
)
def test_deadlines_are_a_grid_ahead_of_now(deadline: int, late: int, period: int) -> None:
    now = deadline + late
    following = next_deadline(deadline, now, period)
    assert (following - deadline) % period == 0
    assert following > max(now, deadline)
    assert following - max(now, deadline) <= period


def test_external_sync_begins_the_cycle() -> None:
    bench = Bench(external_sync=True)
    assert bench.begin() == Want.FRAME
    assert bench.take(TPDO + 5, tpdo()) == Want.FRAME  # of nobody's cycle
    bench.now_ns += 5
    assert bench.take(SYNC) == Want.FRAME
    assert bench.sent == []
    assert bench.exchange.last_sync_ns == START_NS + 5
    assert bench.take(TPDO + 5, tpdo()) == Want.DONE
    assert bench.begin() == Want.FRAME
    bench.now_ns = int(bench.core["until_ns"][0]) - 1
    assert bench.proceed() == Want.FRAME
    bench.now_ns += 1
    assert bench.proceed() == Want.SYNC_LOST


def test_kernels_stamp_is_when_the_tpdo_came(bench: Bench) -> None:
    wall_ns = 1_700_000_000_000_000_000
    begin(bench.core, 1, wall_ns - START_NS)
    bench.proceed()
    bench.proceed()
    bench.now_ns += 500_000
    bench.take(TPDO + 5, tpdo(), stamp_ns=wall_ns + 100_000)
    (row,) = bench.axes[0].ring.take_rows()
    assert row["latency_s"] == pytest.approx(400e-6)


def test_abandoned_cycle_is_followed_by_a_whole_one(bench: Bench) -> None:
    bench.begin()
    bench.proceed()
    abandon(bench.core)
    assert bench.proceed() == Want.DONE
    assert bench.cycle() == Want.DONE
    assert bench.sent == [SYNC, SYNC, RPDO + 5]


def test_simulated_time_waits_for_the_writer(bench: Bench) -> None:
    bench.core["writer_reads"] = True
    header = bench.axes[0].ring.header
    header["row_head"] = 9000
    assert bench.begin() == Want.WRITER
    header["row_tail"] = 9000
    assert bench.proceed() == Want.DRAIN
    assert np.all(header["rows_lost"] == 0)
