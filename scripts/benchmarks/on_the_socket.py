"""The native exchange: against a C program that only copies, against canopen, and under load."""

import contextlib
import gc
import itertools
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeAlias, cast

import can
import canopen
import numpy as np
from numpy.typing import NDArray

from canwall import config
from canwall.bus.socket_pair import SocketPairBus
from canwall.cycle import (
    Exchange,
    SocketTransport,
    WallAxis,
    percentile_ns,
    real_time_priority,
    run_laws,
    start_at,
    step,
)
from canwall.drive import DriveNode, DriveSetup, Field, Link, PdoLayout
from canwall.record import ROW, Phase, Ring
from canwall.run import drive_dictionary, make_axis, make_exchange, on_the_bus, render
from canwall.units import DriveUnits

_SOURCE = Path(__file__).with_name("frames.c")
_CYCLES = 4000
_TURNS = 7
_REAL_TIME_TURNS = 3
_SIMULATED_S = 30.0
#: PDOs of the drive in the C program.
_TPDO = PdoLayout(
    0x185, (Field(0x6064, 0, 0, 32), Field(0x6041, 0, 32, 16), Field(0x6077, 0, 48, 16))
)
_RPDO = PdoLayout(0x205, (Field(0x6040, 0, 0, 16), Field(0x6071, 0, 16, 16)))
_COUNTS = 0x1000
_names = itertools.count()

Ends: TypeAlias = Callable[[], AbstractContextManager[tuple[socket.socket, socket.socket]]]
"""Makes the master's and the drive's socket."""


@contextmanager
def _socket_pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, its:
        yield ours, its


@contextmanager
def _vcan0() -> Iterator[tuple[socket.socket, socket.socket]]:
    with ExitStack() as stack:
        ours, its = (
            stack.enter_context(socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW))
            for _ in range(2)
        )
        for end in (ours, its):
            end.bind(("vcan0",))
        yield ours, its


def _bus(sock: socket.socket) -> can.BusABC:
    """A python-can bus in the place of the master's socket."""
    if sock.family == socket.AF_CAN:
        # Nobody is going to read it.
        sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
        return can.Bus(interface="socketcan", channel=sock.getsockname()[0])
    return SocketPairBus(sock.dup(), f"bench {next(_names)}")


@contextmanager
def _program() -> Iterator[str]:
    with tempfile.TemporaryDirectory() as folder:
        program = f"{folder}/frames"
        subprocess.run(["gcc", "-O2", "-o", program, str(_SOURCE)], check=True)
        yield program


def _against_drive(
    program: str, master: Callable[[socket.socket], None], awake: bool, ends: Ends = _socket_pair
) -> NDArray[np.int64]:
    """As the drive sees it, TPDO → RPDO and from each SYNC to the next [ns], shape (n, 2).

    awake: the drive looks for frames all the time, as prompt as a drive of its own, on a processor
    that the master is kept away from, and without priority. Else it waits in the kernel.
    """
    processors = os.sched_getaffinity(0)
    of_the_drive = {max(processors)} if awake and len(processors) > 1 else processors
    with ends() as (ours, its):
        drive = subprocess.Popen(
            [program, str(its.fileno()), "drive", str(_CYCLES), *(["awake"] if awake else [])],
            pass_fds=[its.fileno()],
            stdout=subprocess.PIPE,
        )
        try:
            if awake:
                os.sched_setaffinity(drive.pid, of_the_drive)
                os.sched_setaffinity(0, processors - of_the_drive or processors)
            else:
                with contextlib.suppress(PermissionError):
                    policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
                    os.sched_setscheduler(drive.pid, policy, os.sched_param(40))
            master(ours)
            out, _ = drive.communicate(timeout=300.0)
        finally:
            os.sched_setaffinity(0, processors)
            drive.kill()
    return np.frombuffer(out, np.int64).reshape(-1, 2)[1:]


def enabled_axis(real_time: bool) -> WallAxis:
    """Return an axis whose drive is enabled, by the C program's frames."""
    settings = config.load(
        config.shipped("config/sim.toml"),
        {
            "wall.law": "mean_force",
            "bus.pace": "real_time" if real_time else "simulated",
            # What the machine does to a drive without a clock of its own ends no measurement.
            "limits.hold_cycles": 100,
            "limits.ramp_cycles": 1000,
            "limits.late_cycles": 0,
        },
    )
    setup = DriveSetup(DriveUnits(131072.0, 0.637), 0x080, _TPDO, _RPDO)
    node = cast(DriveNode, SimpleNamespace(node_id=5, emergencies=[]))
    axis = WallAxis(node, setup, settings, run_laws(settings), Ring.create())
    axis.cycle["phase"], axis.cycle["controlword"] = Phase.RENDERING, 0x0F
    start_at(axis.cycle, _COUNTS)
    return axis


def _c_master(program: str, awake: bool) -> Callable[[socket.socket], None]:
    def master(sock: socket.socket) -> None:
        subprocess.run(
            [program, str(sock.fileno()), "master", str(_CYCLES), *(["awake"] if awake else [])],
            pass_fds=[sock.fileno()],
            check=True,
        )

    return master


def _native(real_time: bool, axis: WallAxis, awake: bool = True) -> Callable[[socket.socket], None]:
    """awake: as it comes, for the first 30 µs after the SYNC; else it waits in the kernel."""

    def master(sock: socket.socket) -> None:
        bus = _bus(sock)
        link = Link(bus)
        link.log = axis.ring.log_frame
        exchange = Exchange(link, [axis], real_time, transport=SocketTransport)
        exchange.ahead = 20 if real_time else 1000
        if not awake:
            exchange.transport.poll_ns = 0
        while (j := int(axis.cycle["j"][0])) < _CYCLES:
            exchange.cycle(min(exchange.ahead, _CYCLES - j))
        sync_interval[:] = exchange.sync_interval
        if axis.cycle["trip"][0]:
            raise RuntimeError("the wall was given up")
        exchange.close()
        bus.shutdown()

    sync_interval = np.zeros(1, axis.latency.dtype)
    master.sync_interval = sync_interval  # type: ignore[attr-defined]
    return master


def _the_usual_way(sock: socket.socket) -> None:
    axis = enabled_axis(False)
    bus = _bus(sock)
    network = canopen.Network(bus)
    node = network.add_node(5, str(axis.settings.drive.eds))
    tpdo, rpdo = node.tpdo[1], node.rpdo[1]
    for pdo, cob_id, objects in (
        (tpdo, 0x185, (0x6064, 0x6041, 0x6077)),
        (rpdo, 0x205, (0x6040, 0x6071)),
    ):
        pdo.clear()
        for index in objects:
            pdo.add_variable(index)
        pdo.cob_id, pdo.enabled = cob_id, True
    position, statusword, torque = tpdo
    controlword, target = rpdo
    row, sent = np.zeros(1, ROW), threading.Event()

    def on_tpdo(_: object) -> None:
        given = position.raw & 0xFFFFFFFF | statusword.raw << 32 | (torque.raw & 0x7FFF) << 48
        answer = step(axis.cycle, row, given, True)
        controlword.raw = answer & 0xFFFF
        target.raw = (answer >> 16 & 0xFFFF ^ 0x8000) - 0x8000
        rpdo.transmit()
        sent.set()

    tpdo.add_callback(on_tpdo)
    tpdo.subscribe()
    network.connect()
    try:
        for _ in range(_CYCLES):
            sent.clear()
            network.sync.transmit()
            if not sent.wait(10.0):
                raise RuntimeError("no RPDO came")
    finally:
        network.notifier.stop()
        bus.shutdown()


def _us(durations_ns: NDArray[np.int64], percent: float) -> float:
    return round(float(np.percentile(durations_ns, percent)) / 1e3, 2)


def round_trip() -> dict[str, Any]:
    """SYNC, TPDO, RPDO over a socket pair between two processes, as the drive sees it."""
    return _round_trip(_socket_pair, ("awake", "waiting"))


def round_trip_on_vcan0() -> dict[str, Any]:
    """The same over vcan0, which has to be there and up (scripts/vcan-guest has it), waiting.

    A guest has one processor, on which only one of two processes can be awake.
    """
    return _round_trip(_vcan0, ("waiting",))


def _round_trip(ends: Ends, ways: Sequence[str]) -> dict[str, Any]:
    """Masters of each kind in turns, medians and ratios.

    The drive is the same C program for all, and so are the frames. The masters: a C program that
    copies; the native exchange (law, record and log of all frames included); the usual way with
    canopen (the law, no record, no log). Like with like: both look for frames awake, or both wait
    in the kernel; canopen's thread can only wait. Medians of the answer (`tpdo_to_rpdo`) and of a
    whole cycle, from one SYNC to the next, one cycle after the other. What the C program takes of
    the usual way is what the kernel takes for the frames: no master comes to less.
    """
    measured: dict[str, list[tuple[float, float, float]]] = {}

    def measure(name: str, master: Callable[[socket.socket], None], awake: bool) -> None:
        seen = _against_drive(program, master, awake, ends) / 1e3
        answer, cycle = np.median(seen, axis=0)
        p99 = np.percentile(seen[:, 0], 99)
        measured.setdefault(name, []).append((float(answer), float(cycle), float(p99)))

    with _program() as program:
        for _ in range(_TURNS):
            for way in ways:
                awake = way == "awake"
                measure(f"c_copy, {way}", _c_master(program, awake), awake)
                measure(f"native, {way}", _native(False, enabled_axis(False), awake), awake)
                measure(f"usual_way, drive {way}", _the_usual_way, awake)

    def ratios(one: str, other: str) -> dict[str, Any]:
        turns = list(zip(measured[one], measured[other], strict=True))
        found = {}
        for k, name in enumerate(("tpdo_to_rpdo", "whole_cycle")):
            each = [ours[k] / theirs[k] for ours, theirs in turns]
            found[name] = round(statistics.median(each), 3)
            found[f"{name}_repeats"] = [round(ratio, 2) for ratio in each]
        return found

    return {
        "us": {
            name: {
                what: round(statistics.median(turn[k] for turn in turns), 2)
                for k, what in enumerate(("tpdo_to_rpdo", "whole_cycle", "tpdo_to_rpdo_p99"))
            }
            for name, turns in measured.items()
        },
        "native_over_c": {
            "aim": "<= 1.3",
            **{way: ratios(f"native, {way}", f"c_copy, {way}") for way in ways},
        },
        "native_over_usual_way": {
            "aim": "<= 0.1",
            **{way: ratios(f"native, {way}", f"usual_way, drive {way}") for way in ways},
        },
        "c_over_usual_way": {
            way: ratios(f"c_copy, {way}", f"usual_way, drive {way}") for way in ways
        },
    }


def full_cycles() -> dict[str, Any]:
    """CANopen cycles per second in one thread over a socket pair: SYNC, TPDO, law, RPDO, drive."""
    settings = config.load(
        config.shipped("config/sim.toml"),
        {"wall.law": "mean_force", "run.duration_s": _SIMULATED_S, "bus.exchange": "native"},
    )
    rates, of_processor = [], []
    for _ in range(_TURNS):
        with on_the_bus(settings) as link:
            # Nobody reads the ring: what it has no room for is counted as lost.
            axis = make_axis(
                link, settings, drive_dictionary(settings), run_laws(settings), Ring.create()
            )
            link.log = axis.ring.log_frame
            exchange = make_exchange(link, [axis])
            exchange.waits_for_writer = False
            begin, begin_cpu = time.perf_counter(), time.process_time()
            outcome = render(exchange, stop=lambda: False)
            rates.append(outcome.cycles / (time.perf_counter() - begin))
            of_processor.append(outcome.cycles / (time.process_time() - begin_cpu))
            if outcome.trips:
                raise RuntimeError("; ".join(outcome.trips))
    return {
        "cycles_per_s": round(statistics.median(rates)),
        "best": round(max(rates)),
        "cycles_per_processor_s": round(statistics.median(of_processor)),
        "aim": ">= 50000",
        "repeats": [round(rate) for rate in rates],
    }


@contextmanager
def _python_threads() -> Iterator[None]:
    """One thread that computes, one that makes garbage, in this process."""
    over = threading.Event()

    def compute() -> None:
        while not over.is_set():
            sum(range(100))

    def litter() -> None:
        while not over.is_set():
            rings: list[Any] = [[k] for k in range(100)]
            for ring in rings:
                ring.append(ring)

    threads = [threading.Thread(target=work) for work in (compute, litter)]
    gc.collect()
    gc.freeze()  # as in a run: what was there before is not looked through again and again
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-4)
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        over.set()
        for thread in threads:
            thread.join()
        gc.unfreeze()
        sys.setswitchinterval(interval)


def under_python() -> dict[str, Any]:
    """TPDO → RPDO at 1 kHz in real time, with and without Python threads that hold the lock."""

    def measured() -> dict[str, float]:
        axis = enabled_axis(True)
        master = _native(True, axis)
        with real_time_priority():
            seen = _against_drive(program, master, awake=False)
        intervals = master.sync_interval  # type: ignore[attr-defined]
        return {
            "p99.9_us": percentile_ns(axis.latency, 99.9) / 1e3,
            "drive_p99.9_us": _us(seen[:, 0], 99.9),
            "sync_p99_us": percentile_ns(intervals, 99) / 1e3,
            "late": axis.late_rpdo,
        }

    turns = []
    with real_time_priority() as granted:
        pass
    with _program() as program:
        for _ in range(_REAL_TIME_TURNS):
            idle = measured()
            with _python_threads():
                turns.append((idle, measured()))
    ratios = [loaded["p99.9_us"] / idle["p99.9_us"] for idle, loaded in turns]
    names = list(turns[0][0])
    return {
        "scheduling": granted.found,
        "idle": {n: round(statistics.median(idle[n] for idle, _ in turns), 2) for n in names},
        "loaded": {n: round(statistics.median(busy[n] for _, busy in turns), 2) for n in names},
        "ratio": round(statistics.median(ratios), 2),
        "aim": "<= 2",
        "repeats": [round(ratio, 2) for ratio in ratios],
    }
