"""Delay of a PDO's torque and passage of time, compared with a free mass in closed form."""

import itertools
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import can
import pytest
from can.interfaces.virtual import VirtualBus
from hypothesis import given, settings
from hypothesis import strategies as st
from simdrive_bench import (
    CONTROLWORD,
    EDS,
    NODE_ID,
    PERIOD_S,
    RPDO,
    START,
    SYNC,
    TARGET_TORQUE,
    TPDO,
    Bench,
)

from canwall.simdrive import BusRunner, Dictionary, ServoDrive

RATED_NM = 0.637
INERTIA = 1e-4
COUNTS_PER_RAD = 1e6
NM_PER_MILLE = RATED_NM / 1000.0

Step = tuple[float, float]
"""(seconds, torque in N·m) from which on a torque acts."""


@dataclass
class FreeMass:
    """Nothing but an inertia: its motion under held torques is exact."""

    position: float = 0.0
    speed: float = 0.0
    elapsed_s: float = 0.0

    def counts(self) -> int:
        return round(self.position * COUNTS_PER_RAD)

    def speed_counts_per_s(self) -> float:
        return self.speed * COUNTS_PER_RAD

    def torque_nm(self) -> float | None:
        return None

    def advance(self, torque_nm: float, duration_s: float) -> None:
        acceleration = torque_nm / INERTIA
        self.position += self.speed * duration_s + acceleration * duration_s**2 / 2.0
        self.speed += acceleration * duration_s
        self.elapsed_s += duration_s


def position_at(t: float, steps: Sequence[Step]) -> float:
    """Each change of the torque adds Δτ·(t − t_i)²/2m."""
    before, position = 0.0, 0.0
    for at, torque in steps:
        if at < t:
            position += (torque - before) * (t - at) ** 2 / (2.0 * INERTIA)
            before = torque
    return position


@dataclass
class MassBench(Bench):
    """An enabled drive with a free mass; RPDO3 of some transmission type carries the torque."""

    kind: int = 1
    delay: float = 0.0
    real_time: bool = False
    motion: FreeMass = field(default_factory=FreeMass)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        dictionary = Dictionary.load(EDS, NODE_ID)
        self.drive = ServoDrive(
            dictionary,
            NODE_ID,
            self.motion,
            PERIOD_S,
            torque_delay_cycles=self.delay,
            real_time=self.real_time,
        )
        self.sent = self.drive.boot()
        self.configure_cycle()
        self.configure_pdo(0x1402, RPDO[3], self.kind, [CONTROLWORD, TARGET_TORQUE])
        self.nmt(START)
        for controlword in (0x00, 0x06, 0x07, 0x0F):
            self.command(controlword)
            self.sync()
        self.command(0x0F)
        self.elapsed_s = self.motion.elapsed_s

    @property
    def now_s(self) -> float:
        return self.motion.elapsed_s - self.elapsed_s


torques = st.lists(st.integers(-1000, 1000), min_size=1, max_size=12)


@pytest.mark.slow
@settings(derandomize=True, deadline=None, max_examples=60)
@given(
    torques=torques,
    kind=st.sampled_from((1, 254, 255)),
    delay=st.sampled_from((0.0, 0.35, 1.0, 2.0, 2.35, 3.0)),
)
def test_loop_delay_is_that_of_the_pdo_and_the_configured_one(
    torques: list[int], kind: int, delay: float
) -> None:
    """D = delay for an asynchronous RPDO, 1 + delay for a synchronous one."""
    bench = MassBench(kind=kind, delay=delay)
    loop_delay = delay + (1.0 if kind == 1 else 0.0)
    steps: list[Step] = []
    for j, torque in enumerate(torques):
        bench.command(0x0F, torque)  # after SYNC j
        steps.append(((j + loop_delay) * PERIOD_S, torque * NM_PER_MILLE))
        _, counts, _ = bench.cycle()
        assert bench.now_s == pytest.approx((j + 1) * PERIOD_S, rel=1e-12)
        exact = position_at((j + 1) * PERIOD_S, steps) * COUNTS_PER_RAD
        assert counts == pytest.approx(exact, abs=0.5 + 1e-6)


@pytest.mark.parametrize(
    ("delay", "shown"),
    [
        (0.0, [500, 500, 0, 0, 0]),
        (0.35, [0, 500, 500, 0, 0]),
        (1.0, [0, 500, 500, 0, 0]),
        (2.0, [0, 0, 500, 500, 0]),
    ],
)
def test_torque_actual_value_is_the_one_that_acts(delay: float, shown: list[int]) -> None:
    bench = MassBench(delay=delay)
    actual, demanded = [], []
    for torque in (500, 500, 0, 0, 0):
        bench.command(0x0F, torque)
        actual.append(bench.cycle()[2])
        demanded.append(bench.read(0x6074, signed=True))
    assert actual == shown
    assert demanded == [500, 500, 0, 0, 0]


def test_power_stage_that_goes_off_ends_the_torque_at_once() -> None:
    bench = MassBench(delay=2.35)
    for _ in range(5):
        bench.command(0x0F, 800)
        bench.cycle()
    bench.command(0x0F, -400)
    bench.cycle()
    bench.cycle()  # the torque of -400 is under way
    speed = bench.motion.speed
    bench.write(0x6040, 0, 0, 2)
    for _ in range(5):
        bench.sync()
    assert bench.motion.speed == speed


def test_torque_written_over_sdo_acts_on_reception() -> None:
    bench = MassBench()
    bench.write(0x6071, 0, 300, 2)
    assert bench.read(0x6077) == 300
    bench.sync()
    assert bench.motion.speed == pytest.approx(300 * NM_PER_MILLE * PERIOD_S / INERTIA)


@pytest.mark.slow
@settings(derandomize=True, deadline=None, max_examples=60)
@given(
    events=st.lists(
        st.tuples(st.floats(0.0, 0.01), st.one_of(st.none(), st.integers(-1000, 1000))),
        min_size=1,
        max_size=20,
    ),
    delay=st.sampled_from((0.0, 0.35, 2.0)),
)
def test_real_time_is_what_tick_tells(events: list[tuple[float, int | None]], delay: float) -> None:
    """After each stretch of time a torque arrives, or a SYNC (None), which moves nothing."""
    bench = MassBench(kind=255, delay=delay, real_time=True)
    now_s = 0.0
    steps: list[Step] = []
    for dt, torque in events:
        bench.tick(dt)
        now_s += dt
        if torque is None:
            _, counts, _ = bench.cycle()
            exact = position_at(now_s, steps) * COUNTS_PER_RAD
            assert counts == pytest.approx(exact, abs=0.5 + 1e-6)
        else:
            bench.command(0x0F, torque)
            steps.append((now_s + delay * PERIOD_S, torque * NM_PER_MILLE))
    assert bench.now_s == pytest.approx(now_s, abs=1e-12)


def test_slope_of_profile_torque_goes_on_with_real_time() -> None:
    bench = MassBench(kind=255, real_time=True)
    bench.write(0x6060, 0, 4, 1)
    bench.write(0x6087, 0, 10_000, 4)  # per mille a second
    bench.write(0x6071, 0, 500, 2)
    for _ in range(25):
        bench.tick(0.001)
        bench.sync()  # as many as there are: none of them is a period
        bench.sync()
    assert bench.read(0x6077) == 250


_channels = itertools.count()


@dataclass
class Clock:
    now_s: float = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def at_the_bus() -> Iterator[Callable[[bool], tuple[can.BusABC, BusRunner, MassBench, Clock]]]:
    opened: list[can.BusABC] = []

    def make(real_time: bool) -> tuple[can.BusABC, BusRunner, MassBench, Clock]:
        bench = MassBench(kind=255, real_time=real_time)
        channel = f"time {next(_channels)}"
        buses = [VirtualBus(channel), VirtualBus(channel)]
        opened.extend(buses)
        clock = Clock()
        bench.drive.boot = list  # type: ignore[method-assign]  # it is up, and stays as it is
        return buses[0], BusRunner(bench.drive, buses[1], clock), bench, clock

    yield make
    for bus in opened:
        bus.shutdown()


def send(bus: can.BusABC, can_id: int, data: bytes = b"") -> None:
    bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))


def position_of(bus: can.BusABC) -> int:
    while (message := bus.recv(0)) is not None:
        if message.arbitration_id == TPDO[3]:
            position: int = struct.unpack_from("<2xi", message.data)[0]
            return position
    raise AssertionError("no TPDO")


@pytest.mark.parametrize("real_time", [False, True])
def test_time_on_the_bus(
    at_the_bus: Callable[[bool], tuple[can.BusABC, BusRunner, MassBench, Clock]], real_time: bool
) -> None:
    bus, runner, bench, clock = at_the_bus(real_time)
    send(bus, RPDO[3], struct.pack("<Hh", 0x0F, 1000))
    runner.poll()
    clock.now_s += 0.0004  # less than a tick: the frame itself makes the time pass
    send(bus, RPDO[3], struct.pack("<Hh", 0x0F, 0))
    runner.poll()
    clock.now_s += 0.0101
    send(bus, SYNC)
    runner.poll()
    steps = [(0.0, RATED_NM), (0.0004, 0.0)]
    exact = position_at(0.0105, steps) * COUNTS_PER_RAD if real_time else 0.0
    assert position_of(bus) == pytest.approx(exact, abs=0.51)
    assert bench.now_s == pytest.approx(0.0105 if real_time else PERIOD_S)


def test_others_frames_on_the_bus_are_no_business_of_the_drive(
    at_the_bus: Callable[[bool], tuple[can.BusABC, BusRunner, MassBench, Clock]],
) -> None:
    bus, runner, bench, _ = at_the_bus(False)
    rpdo = struct.pack("<Hh", 0x0F, 1000)
    bus.send(can.Message(arbitration_id=RPDO[3], data=rpdo, is_extended_id=True))
    bus.send(can.Message(arbitration_id=RPDO[3], data=rpdo, is_error_frame=True))
    bus.send(can.Message(arbitration_id=SYNC, is_extended_id=True))
    bus.send(can.Message(arbitration_id=RPDO[3], is_remote_frame=True, is_extended_id=False))
    bus.send(can.Message(arbitration_id=SYNC, is_remote_frame=True, is_extended_id=False))
    runner.poll()
    assert bus.recv(0) is None
    assert bench.now_s == 0.0
    assert bench.read(0x6071) == 0
