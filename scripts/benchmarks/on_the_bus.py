"""The cycle on python-can's virtual bus: the whole loop, its exchange of frames, a drive alone."""

import itertools
import statistics
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import canopen
import numpy as np
from can.interfaces.virtual import VirtualBus
from numpy.typing import NDArray

from canwall import config, simdrive
from canwall.config import Settings
from canwall.cycle import Exchange, WallAxis, run_laws, step
from canwall.cycle.state import start_at
from canwall.drive import REQUIRED_OBJECTS, DriveNode, DriveSetup, Link, set_up
from canwall.eds import load_eds
from canwall.record import ROW, Phase, Recorder, Ring
from canwall.run import (
    drive_dictionary,
    make_axis,
    make_exchange,
    make_simulated_drive,
    on_the_bus,
    render,
)

_REPEATS = 7
#: Cycles of one turn; a ring without a reader holds them.
_CYCLES = 3000
_ENABLE_OPERATION = 0x0F
_channels = itertools.count()


def _settings(**overrides: Any) -> Settings:
    dotted = {key.replace("__", "."): value for key, value in overrides.items()}
    return config.load(config.shipped("config/sim.toml"), dotted)


def whole_loop() -> dict[str, Any]:
    """Cycles per second of what `canwall run` does from enabling to the disabled drive, recorded.

    Simulated drive and hand in the same process; free-running.
    """
    rates = [_rate_of_run(_settings(run__duration_s=10.0)) for _ in range(_REPEATS)]
    rate = statistics.median(rates)
    return {
        "cycles_per_s": round(rate),
        "times_real_time_at_1_khz": round(rate / 1000.0, 2),
        "aim": ">= 5",
        "repeats": [round(rate) for rate in rates],
    }


def _rate_of_run(settings: Settings) -> float:
    laws = run_laws(settings)
    with (
        tempfile.TemporaryDirectory() as folder,
        on_the_bus(settings) as link,
        Recorder() as recorder,
    ):
        recorder.begin(Path(folder), "bus.log", "bench", [law.name for law in laws])
        link.log = recorder.ring.log_frame
        axis = make_axis(link, settings, drive_dictionary(settings), laws, recorder.ring)
        exchange = make_exchange(link, [axis])
        begin = time.perf_counter()
        outcome = render(exchange, stop=lambda: False)
        duration = time.perf_counter() - begin
        notes = recorder.close()
    if outcome.trips or notes:
        raise RuntimeError("; ".join([*outcome.trips, *notes]))
    return outcome.cycles / duration


class StopwatchBus(VirtualBus):
    """Measures from the return of recv() with a TPDO to the return of send() with the RPDO."""

    def __init__(self, channel: str, tpdo: int, rpdo: int) -> None:
        super().__init__(channel)
        self.durations_ns: list[int] = []
        self._tpdo, self._rpdo = tpdo, rpdo
        self._received_ns = 0

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Receive, and start the watch."""
        message = super().recv(timeout)
        if message is not None and message.arbitration_id == self._tpdo:
            self._received_ns = time.perf_counter_ns()
        return message

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send, and stop the watch."""
        super().send(msg, timeout)
        if msg.arbitration_id == self._rpdo:
            self.durations_ns.append(time.perf_counter_ns() - self._received_ns)


@dataclass(frozen=True)
class _EnabledDrive:
    """An enabled drive, and a wall to be rendered on it."""

    bus: StopwatchBus
    drive: simdrive.ServoDrive
    runner: simdrive.BusRunner
    link: Link
    axis: WallAxis

    @property
    def setup(self) -> DriveSetup:
        """Set-up of the drive."""
        return self.axis.setup

    @property
    def cycle(self) -> NDArray[np.void]:
        """The record of the wall."""
        return self.axis.cycle


@contextmanager
def _ready() -> Iterator[_EnabledDrive]:
    settings = _settings(wall__law="half_sample")
    node_id = settings.drive.node_id
    channel = f"bench {next(_channels)}"
    with (
        StopwatchBus(channel, 0x180 + node_id, 0x200 + node_id) as bus,
        VirtualBus(channel) as drive_bus,
    ):
        drive = make_simulated_drive(settings)
        runner = simdrive.BusRunner(drive, drive_bus)
        link = Link(bus, idle=runner.poll)
        dictionary = load_eds(settings.drive.eds, node_id, REQUIRED_OBJECTS)
        node = DriveNode(link, node_id, dictionary)
        setup = set_up(node, settings.drive, settings.bus, settings.real_time)
        for controlword in (0x06, 0x07, _ENABLE_OPERATION):
            node.write(0x6040, 0, controlword)
        axis = WallAxis(node, setup, settings, run_laws(settings), Ring.create())
        axis.cycle["phase"], axis.cycle["controlword"] = Phase.RENDERING, _ENABLE_OPERATION
        start_at(axis.cycle, node.read(0x6064))
        yield _EnabledDrive(bus, drive, runner, link, axis)


def exchange() -> dict[str, Any]:
    """The master's time from TPDO to RPDO: canwall's exchange, and the usual way with canopen.

    Same bus, same drive, same compiled law, in turns. canwall notes frames and signals meanwhile,
    the usual way nothing.
    """
    turns = [(_durations_of_canwall(), _durations_the_usual_way()) for _ in range(_REPEATS)]
    ratios = [np.median(ours) / np.median(usual) for ours, usual in turns]
    return {
        "canwall": _percentiles(np.concatenate([ours for ours, _ in turns])),
        "usual_way": _percentiles(np.concatenate([usual for _, usual in turns])),
        "ratio_of_medians": round(float(np.median(ratios)), 3),
        "aim": "<= 0.333",
        "repeats": [round(float(ratio), 3) for ratio in ratios],
    }


def _percentiles(durations_ns: NDArray[np.int64]) -> dict[str, float]:
    p50, p99 = np.percentile(durations_ns, [50, 99]) / 1e3
    return {"p50_us": round(float(p50), 2), "p99_us": round(float(p99), 2)}


def _durations_of_canwall() -> NDArray[np.int64]:
    with _ready() as ready:
        ready.link.log = ready.axis.ring.log_frame
        exchange = Exchange(ready.link, [ready.axis], real_time=False)
        for _ in range(_CYCLES):
            exchange.cycle()
        return _checked(ready)


def _durations_the_usual_way() -> NDArray[np.int64]:
    with _ready() as ready:
        network = canopen.Network(ready.bus)
        node = network.add_node(5, str(_settings().drive.eds))
        tpdo, rpdo = node.tpdo[1], node.rpdo[1]
        for pdo, cob_id, objects in (
            (tpdo, ready.setup.tpdo.cob_id, (0x6064, 0x6041, 0x6077)),
            (rpdo, ready.setup.rpdo.cob_id, (0x6040, 0x6071)),
        ):
            pdo.clear()
            for index in objects:
                pdo.add_variable(index)
            pdo.cob_id, pdo.enabled = cob_id, True
        position, statusword, torque = tpdo
        controlword, target = rpdo
        row = np.zeros(1, ROW)
        sent = threading.Event()

        def on_tpdo(_: object) -> None:
            given = position.raw & 0xFFFFFFFF | statusword.raw << 32 | (torque.raw & 0x7FFF) << 48
            answer = step(ready.cycle, row, given, True)
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
                ready.runner.poll()
                if not sent.wait(10.0):
                    raise RuntimeError("no RPDO came")
            return _checked(ready)
        finally:
            network.notifier.stop()


def _checked(ready: _EnabledDrive) -> NDArray[np.int64]:
    """The durations, of a wall that was rendered to the end."""
    if ready.cycle["trip"][0] or len(ready.bus.durations_ns) != _CYCLES:
        raise RuntimeError("the wall was given up")
    return np.array(ready.bus.durations_ns)


def simulated_drive() -> dict[str, Any]:
    """Cycles per second of the simulated drive alone: SYNC and RPDO in, TPDO out, physics."""
    rates = []
    for _ in range(_REPEATS):
        with _ready() as ready:
            process, setup = ready.drive.process, ready.setup
        begin = time.perf_counter()
        for _ in range(_CYCLES):
            frames = process(setup.sync_cob_id, b"")
            process(setup.rpdo.cob_id, b"\x0f\0\0\0")
        rates.append(_CYCLES / (time.perf_counter() - begin))
        if frames[0][0] != setup.tpdo.cob_id:
            raise RuntimeError("the drive sent no TPDO")
    return {
        "cycles_per_s": round(statistics.median(rates)),
        "repeats": [round(rate) for rate in rates],
    }
