"""The SYNC by the clock: how well its intervals are kept, and what more drives cost."""

import itertools
import statistics
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from typing import Any

import can
import canopen
import numpy as np
from can.interfaces.virtual import VirtualBus
from numpy.typing import NDArray
from on_the_socket import enabled_axis

from canwall import config
from canwall.cycle import Exchange, real_time_priority, run_laws
from canwall.drive import Link
from canwall.record import Ring
from canwall.run import drive_dictionary, make_axis, make_exchange, on_the_bus

_PERIOD_S = 0.001
_SYNCS = 4000
_TURNS = 3
_CYCLES = 3000
_SYNC_ID = 0x080
_channels = itertools.count()


class _NotingBus(VirtualBus):
    """Notes when each SYNC was handed to it."""

    def __init__(self) -> None:
        super().__init__(f"clock {next(_channels)}")
        self.instants_ns: list[int] = []

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Note the instant, and send."""
        self.instants_ns.append(time.perf_counter_ns())
        super().send(msg, timeout)

    def errors_us(self) -> NDArray[np.float64]:
        """Deviations of the intervals from the period [us]."""
        intervals = np.diff(np.array(self.instants_ns[10:]))
        return np.abs(intervals / 1e3 - _PERIOD_S * 1e6)


def _ours() -> NDArray[np.float64]:
    with _NotingBus() as bus:
        exchange = Exchange(Link(bus), [enabled_axis(True)], real_time=True)
        with real_time_priority():
            for _ in range(_SYNCS):
                exchange.cycle()
        return bus.errors_us()


def _canopens() -> NDArray[np.float64]:
    with _NotingBus() as bus:
        network = canopen.Network(bus)
        network.connect()
        network.sync.start(_PERIOD_S)
        time.sleep(_SYNCS * _PERIOD_S)
        network.sync.stop()
        network.notifier.stop()
        return bus.errors_us()


@contextmanager
def _load(processes: int) -> Any:
    """As many processes that do nothing but compute."""
    with ExitStack() as stack:
        for _ in range(processes):
            busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            stack.callback(busy.wait)
            stack.callback(busy.kill)
        yield


def sync_jitter() -> dict[str, Any]:
    """Deviation of the SYNC's intervals from 1 ms: canwall's producer and canopen's, in turns.

    Idle, and with two processes that compute all the time. p99 in microseconds. canwall's runs
    as in a run: with real-time priority where it is granted.
    """
    with real_time_priority() as granted:
        result: dict[str, Any] = {"aim": "ratio <= 0.2", "scheduling": granted.found}
    for name, processes in (("idle", 0), ("loaded", 2)):
        with _load(processes):
            turns = [(_ours(), _canopens()) for _ in range(_TURNS)]
        p99 = [[float(np.percentile(errors, 99)) for errors in turn] for turn in turns]
        result[name] = {
            "canwall_p99_us": round(statistics.median(ours for ours, _ in p99), 1),
            "canopen_p99_us": round(statistics.median(usual for _, usual in p99), 1),
            "ratio": round(statistics.median(ours / usual for ours, usual in p99), 3),
            "repeats": [round(ours / usual, 3) for ours, usual in p99],
        }
    return result


def several_drives() -> dict[str, Any]:
    """The master's time per cycle with one drive and with four, from SYNC to the last RPDO.

    Less what the simulated drives take, which live in the master's idle time.
    """
    turns = [(_master_us(1), _master_us(4)) for _ in range(_TURNS)]
    return {
        "one_us": round(statistics.median(one for one, _ in turns), 1),
        "four_us": round(statistics.median(four for _, four in turns), 1),
        "ratio": round(statistics.median(four / one for one, four in turns), 2),
    }


def _master_us(drives: int) -> float:
    """Median of a cycle's time [us] without that of the drives."""
    many = [
        config.load(
            config.shipped("config/sim.toml"), {"drive.node_id": 5 + k, "wall.law": "half_sample"}
        )
        for k in range(drives)
    ]
    with on_the_bus(*many) as link:
        idle, in_drives = link.idle, 0

        def timed() -> None:
            nonlocal in_drives
            begin = time.perf_counter_ns()
            if idle is not None:
                idle()
            in_drives += time.perf_counter_ns() - begin

        link.idle = timed
        axes = [
            make_axis(link, one, drive_dictionary(one), run_laws(one), Ring.create())
            for one in many
        ]
        link.log = axes[0].ring.log_frame
        exchange = make_exchange(link, axes)
        durations = []
        for _ in range(_CYCLES):
            in_drives = 0
            begin = time.perf_counter_ns()
            exchange.cycle()
            durations.append(time.perf_counter_ns() - begin - in_drives)
    return statistics.median(durations) / 1e3
