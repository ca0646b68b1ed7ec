"""The socket transport: several cycles at a time, time stamps, a bus that fails, by errno."""

import errno
import os
import signal
import socket
import time
from collections.abc import Callable

import can
import numpy as np
import pytest
from rig import RPDO1, SYNC, TPDO1, Loop, RigFactory, settings_with

from canwall.bus.cycle_socket import CycleSocket
from canwall.bus.socket_pair import SocketPairBus
from canwall.config import Settings
from canwall.cycle.sockets import SocketTransport
from canwall.record import TIMING_COLUMNS, Phase
from canwall.stopping import stop_on_signals

PRESSING = 500

pytestmark = pytest.mark.parametrize("native", ["native"], indirect=True)


def pressing() -> Settings:
    return settings_with({"wall.law": "half_sample"})


@pytest.mark.slow
def test_many_cycles_at_a_time_are_the_same_cycles(make_rig: RigFactory) -> None:
    # Its schedule changes the law, its strikes have the wall come and go.
    one, many = Loop(make_rig(settings_with())), Loop(make_rig(settings_with()))
    many.exchange.ahead = 1000
    asked: list[int] = []
    assert one.run(1500).trips == []
    assert many.run(1500, lambda j: bool(asked.append(j))).trips == []
    assert len(asked) < 100
    # How long a drive takes to be left depends on the clock.
    ours, theirs = one.rows()[:1500], many.rows()[:1500]
    for name in set(ours.dtype.names or ()) - set(TIMING_COLUMNS):
        assert ours[name].tolist() == theirs[name].tolist(), name
    assert one.rig.rpdos()[:1500] == many.rig.rpdos()[:1500]
    assert many.record["j"][0] == len(many.rig.rpdos())


@pytest.mark.slow
def test_trip_ends_many_cycles_at_once(make_rig: RigFactory) -> None:
    one, many = (Loop(make_rig(settings_with({"limits.speed_rad_s": 0.5}))) for _ in range(2))
    many.exchange.ahead = 1000
    first, second = one.run(None), many.run(None)
    assert first.trips == second.trips
    assert first.trip_cycle == second.trip_cycle is not None


def test_signal_ends_many_cycles_at_once(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))
    loop.exchange.ahead = 1000
    process = loop.rig.tampering.process
    with stop_on_signals() as stop:
        stop.hold(loop.exchange.attend)

        def raising(can_id: int, data: bytes) -> list[tuple[int, bytes]]:
            if can_id == SYNC and int(loop.record["j"][0]) == PRESSING and not stop.count:
                os.kill(os.getpid(), signal.SIGTERM)
                while not stop.count:  # the handler's turn, in the main thread
                    time.sleep(0.001)
            return process(can_id, data)

        loop.rig.tampering.process = raising  # type: ignore[method-assign]
        outcome = loop.run(None, lambda j: stop())
    assert outcome.interrupted
    rows = loop.rows()
    after = rows["torque_cmd_per_mille"][rows["j"] > PRESSING]
    assert rows["torque_cmd_per_mille"][rows["j"] == PRESSING] != 0
    assert np.all(after == 0)
    assert len(after) < 10


def test_frames_of_others_reach_the_network_between_many_cycles(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))
    loop.exchange.ahead = 1000
    heard: list[bytes] = []
    loop.rig.link.network.subscribe(0x300, lambda can_id, data, stamp: heard.append(bytes(data)))
    loop.rig.drive_bus.send(can.Message(arbitration_id=0x300, data=b"\x07", is_extended_id=False))
    loop.run(300)
    assert heard == [b"\x07"]
    assert (0x300, b"\x07") in loop.rig.frames


def test_real_time_keeps_to_the_grid_of_its_first_sync(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()), real_time=True)
    deadlines = []
    for _ in range(20):
        loop.exchange.cycle()
        deadlines.append(loop.exchange.deadline_ns)
    assert set(np.diff(deadlines) % 1_000_000) == {0}
    assert min(np.diff(deadlines)) > 0


def test_latency_begins_with_the_arrival_of_the_tpdo(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()), real_time=True)
    poll = loop.rig.link.idle
    assert poll is not None

    def and_something_else() -> None:
        poll()  # the TPDO is there from now on, whoever looks for it when
        time.sleep(0.002)

    loop.rig.link.idle = and_something_else
    for _ in range(3):
        loop.exchange.cycle()
    rows = loop.rows()
    assert rows["received"].all()
    assert (rows["latency_s"] >= 0.002).all()


# A bus that fails


def breaking(loop: Loop, cycles: int | None) -> Callable[[int], bool]:
    """From PRESSING on, for so many cycles, the cycle has a descriptor that is none."""
    exchange, transport = loop.exchange, loop.exchange.transport
    assert isinstance(transport, SocketTransport)
    cycle, descriptor = exchange.cycle, transport.descriptor
    broken = socket.socket()
    broken.close()
    failures = 0

    def failing(most: int = 1) -> None:
        nonlocal failures
        fails = loop.record["j"][0] >= PRESSING and (cycles is None or failures < cycles)
        failures += fails
        transport.descriptor = -1 if fails else descriptor
        cycle(most)

    exchange.cycle = failing  # type: ignore[method-assign]
    return lambda j: False


def test_bus_that_fails_once_is_left_in_order(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))
    outcome = loop.run(None, breaking(loop, 1))
    assert outcome.trips == [
        f"the bus failed: {os.strerror(errno.EBADF)} [Error Code {errno.EBADF}]"
    ]
    assert outcome.disabled
    rows = loop.rows()
    leaving = rows[rows["phase"] == Phase.LEAVING]
    assert len(leaving) > 1
    assert not leaving["torque_cmd_per_mille"].any()
    assert loop.rig.rpdos()[PRESSING - 1][1] != 0


def test_cycle_that_fails_for_good_is_left_by_sdo(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))
    outcome = loop.run(None, breaking(loop, None))
    (trip,) = outcome.trips
    assert trip.startswith("the bus failed: ")
    assert outcome.disabled
    assert loop.rig.node.read(0x6041) & 0x6F == 0x40
    assert loop.rig.node.read(0x6071) == 0


def test_bus_that_is_gone(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))

    def leave(j: int) -> bool:
        if j == PRESSING:
            loop.rig.link.idle = None
            loop.rig.drive_bus.shutdown()
        return False

    outcome = loop.run(None, leave)
    assert len(outcome.trips) == 3
    assert outcome.trips[0].startswith("the bus failed: ")
    assert outcome.trips[2].startswith("the drive did not confirm that it is disabled (node 5: ")
    assert not outcome.disabled
    assert not any("\n" in trip for trip in outcome.trips)


def test_rpdo_that_the_other_end_does_not_take(make_rig: RigFactory) -> None:
    rig = make_rig(pressing())
    loop = Loop(rig)
    answer = rig.tampering.process

    def deaf_after_sync(can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        frames = answer(can_id, data)
        if can_id == 0x080 and loop.record["j"][0] == PRESSING:
            assert isinstance(rig.drive_bus, SocketPairBus)
            other_end = socket.socket(fileno=os.dup(rig.drive_bus.fileno()))
            other_end.shutdown(socket.SHUT_RD)
            other_end.close()
            # The drive hears nothing any more, and has not noticed.
            rig.drive_bus.recv = lambda timeout=None: None  # type: ignore[method-assign]
        return frames

    rig.tampering.process = deaf_after_sync  # type: ignore[method-assign]
    outcome = loop.run(None)
    assert outcome.trips[0] == (
        f"the bus failed: {os.strerror(errno.EPIPE)} [Error Code {errno.EPIPE}]"
    )
    tpdos = [data for can_id, data in rig.frames if can_id == TPDO1]
    assert len(tpdos) == len(rig.rpdos()) + 1 == PRESSING + 1


def test_bus_without_a_descriptor(make_rig: RigFactory) -> None:
    with (
        can.Bus(interface="virtual", channel="no descriptor") as bus,
        pytest.raises(can.CanInitializationError, match=r"bus\.exchange = 'python-can'"),
    ):
        CycleSocket(bus, [TPDO1], [RPDO1])
