"""Latency of the cycle on a bus, idle and under load, and the shortest cycle that it holds.

The drive is set up as for a run and gets a SYNC and an RPDO in every cycle, but it is never
enabled: controlword and torque are 0 and the law is not evaluated (`scripts/bench law_steps`
measures its time). At the end all changes in the drive are undone.
"""

import gc
import math
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canwall.bench.budget import USABLE, Budget, cycle_budget
from canwall.config import Settings
from canwall.cycle import (
    Exchange,
    Grant,
    WallAxis,
    buckets_ns,
    latest_emergency,
    percentile_ns,
    real_time_machine,
    run_laws,
)
from canwall.drive import DriveError
from canwall.errors import RunFailedError
from canwall.record import Ring
from canwall.run import (
    StopRequest,
    drive_dictionary,
    make_axis,
    make_exchange,
    make_monitor,
    on_the_bus,
    restoring_drives,
)

#: Time before each phase that is not measured: caches fill and the load starts [s].
_SETTLING_S = 0.3
#: Share of cycles that may miss their TPDO in a cycle that counts as held.
_MISSED_SHARE = 1e-3

#: Program of a busy process, which ends with the process that started it.
_COMPUTE = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: sum(range(100_000))"


@dataclass(frozen=True)
class Histogram:
    """Histogram of durations.

    Attributes:
        ends_us: Upper ends of the buckets, inclusive and ascending [µs], shape (n,).
        counts: Cycles in each bucket, shape (n,).
        p50_us: Median [µs].
        p99_us: 99th percentile [µs].
        p999_us: 99.9th percentile [µs].
        max_us: Largest duration [µs].
    """

    ends_us: NDArray[np.float64]
    counts: NDArray[np.int64]
    p50_us: float
    p99_us: float
    p999_us: float
    max_us: float

    @classmethod
    def of(cls, histogram: NDArray[np.void]) -> "Histogram":
        """Convert an array of shape (1,) and dtype HISTOGRAM."""
        ends, counts = buckets_ns(histogram)
        p50, p99, p999 = (percentile_ns(histogram, percent) / 1e3 for percent in (50, 99, 99.9))
        return cls(ends / 1e3, counts, p50, p99, p999, float(histogram["largest_ns"][0]) / 1e3)


@dataclass(frozen=True)
class LatencyPhase:
    """One phase of the measurement, idle or under load.

    Attributes:
        name: "idle" or "load".
        cycles: Cycles measured.
        missed_tpdo: Cycles without a TPDO.
        late_rpdo: RPDOs sent after the next SYNC was due.
        sync_error: |interval between two SYNCs − period|.
        tpdo_to_rpdo: From the arrival of the TPDO, by the kernel's time stamp if the bus has one,
            until the RPDO is handed over.
        sync_to_rpdo: From the instant at which the SYNC is due until the RPDO is handed over. The
            period minus this is the margin before the next SYNC.
    """

    name: str
    cycles: int
    missed_tpdo: int
    late_rpdo: int
    sync_error: Histogram
    tpdo_to_rpdo: Histogram
    sync_to_rpdo: Histogram


@dataclass(frozen=True)
class ShortestCycle:
    """Shortest cycle that machine, interface and bus hold together.

    Attributes:
        holds_s: Shortest cycle [s], math.inf if not even the measured one is held.
        by_bus_s: Shortest cycle that the bus would hold alone [s].
        by_machine_s: Shortest cycle that the machine would hold alone [s].
        text: One line about it.
    """

    holds_s: float
    by_bus_s: float
    by_machine_s: float
    text: str


@dataclass(frozen=True)
class Latency:
    """Result of a measurement: its conditions, its phases, and the shortest cycle.

    `not_restored` has a line if changes in the drive could not be undone.
    """

    interface: str
    channel: str
    bitrate: int
    cycle_s: float
    exchange: str
    granted: dict[str, Grant]
    load: str
    phases: tuple[LatencyPhase, ...]
    budget: Budget
    shortest_cycle: ShortestCycle
    not_restored: tuple[str, ...]


def measurement_settings(settings: Settings) -> Settings:
    """Return the settings of a measurement: in real time, without a schedule, drive put back."""
    bus = settings.bus.model_copy(update={"pace": "real_time"})
    drive = settings.drive.model_copy(update={"restore": True})
    return settings.model_copy(update={"bus": bus, "drive": drive, "schedule": ()})


def measure_latency(
    settings: Settings,
    duration_s: float,
    processes: int,
    threads: int,
    stop: StopRequest,
    report: Callable[[str], None] = lambda step: None,
    progress: Callable[[str, float, float], None] = lambda phase, now_s, end_s: None,
) -> Latency | None:
    """Measure the cycle idle and, with a load, as long under load.

    Args:
        settings: Configuration of bus and drive.
        duration_s: Duration of each phase [s].
        processes: Busy processes of the load.
        threads: Busy Python threads of this process in the load.
        stop: Asked whether to stop.
        report: Called with each step of the preparation.
        progress: Called with the phase, its seconds done and their total.

    Returns:
        The result; None if it was stopped.

    Raises:
        ConfigError: If the bus cannot be opened.
        DictionaryError: If the object dictionary cannot be used.
        DriveError: If the drive cannot be set up; if it was stopped, and cannot be put back.
        RunFailedError: If no TPDO arrives, or somebody else acts on bus or drive.
        can.CanError: If the bus fails.
    """
    settings = measurement_settings(settings)
    loads = {"idle": (0, 0)}
    if processes or threads:
        loads["load"] = (processes, threads)
    dictionary, laws = drive_dictionary(settings), run_laws(settings)
    with on_the_bus(settings) as link, closing(Ring.create()) as ring:
        report("setting up the drive, without enabling it")
        with restoring_drives() as (axes, failures):
            axes.append(axis := make_axis(link, settings, dictionary, laws, ring))
            budget = cycle_budget(axis.node, axis.setup, settings.bus)
            with closing(make_exchange(link, [axis])) as exchange:
                make_monitor(link, [axis])  # whose words are in `axis.suspected`
                measurement = _Measurement(axis, exchange, stop, progress)
                phases = []
                for name, load in loads.items():
                    # The load starts first, to inherit neither the priority nor the processor.
                    with (
                        _load(*load),
                        _without_garbage_collection(),
                        real_time_machine(settings.bus.processor) as granted,
                    ):
                        phases.append(measurement.phase(name, duration_s))
                    if stop():
                        break
    not_restored = [line for lines in failures.values() for line in lines]
    if stop():
        if not_restored:
            raise DriveError("; ".join(["interrupted", *not_restored]))
        return None
    bus = settings.bus
    return Latency(
        bus.interface,
        bus.channel,
        bus.bitrate,
        bus.cycle_s,
        exchange.name,
        granted,
        _describe_load(processes, threads),
        tuple(phases),
        budget,
        shortest_cycle(phases, budget, settings, granted),
        tuple(not_restored),
    )


class _Measurement:
    """Cycle of a drive that is not enabled, with histograms for each phase."""

    def __init__(
        self,
        axis: WallAxis,
        exchange: Exchange,
        stop: Callable[[], bool],
        progress: Callable[[str, float, float], None],
    ) -> None:
        self._axis, self._exchange = axis, exchange
        self._stop, self._progress = stop, progress
        self._period_s = axis.settings.bus.cycle_s

    def phase(self, name: str, duration_s: float) -> LatencyPhase:
        """Measure for `duration_s` seconds. Raises RunFailedError as `measure_latency` does."""
        axis, exchange = self._axis, self._exchange
        self._run(name, _SETTLING_S, report=False)
        missed_before = int(axis.cycle["missed_tpdo"][0])
        if missed_before and missed_before == int(axis.cycle["j"][0]):
            raise RunFailedError(
                f"no TPDO (0x{axis.setup.tpdo.cob_id:03X}) for {missed_before} SYNCs"
                f"{latest_emergency(axis)}"
            )
        late_before = axis.late_rpdo
        histograms = (exchange.sync_error, axis.latency, axis.sync_to_rpdo)
        for histogram in histograms:
            # In place: compiled code has their addresses.
            histogram[:] = np.zeros(1, histogram.dtype)
        first = int(axis.cycle["j"][0])
        self._run(name, duration_s, report=True)
        return LatencyPhase(
            name,
            int(axis.cycle["j"][0]) - first,
            int(axis.cycle["missed_tpdo"][0]) - missed_before,
            axis.late_rpdo - late_before,
            *(Histogram.of(histogram) for histogram in histograms),
        )

    def _run(self, name: str, duration_s: float, report: bool) -> None:
        cycles = max(1, round(duration_s / self._period_s))
        cycle, first = self._axis.cycle, int(self._axis.cycle["j"][0])
        while (done := int(cycle["j"][0]) - first) < cycles and not self._stop():
            if report:
                self._progress(name, done * self._period_s, cycles * self._period_s)
            self._exchange.cycle(min(self._exchange.ahead, cycles - done))
            self._axis.ring.take_rows()
            if self._axis.suspected:
                raise RunFailedError(f"SYNC {int(cycle['j'][0])}: {self._axis.suspected}")


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """Disable garbage collection, as in a run: it would stop the cycle for milliseconds."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


@contextmanager
def _load(processes: int, threads: int) -> Iterator[None]:
    """Run busy processes and threads for as long as the context lasts."""
    ended = threading.Event()

    def compute() -> None:
        while not ended.is_set():
            sum(range(100))

    workers = [threading.Thread(target=compute, daemon=True) for _ in range(threads)]
    with ExitStack() as stack:
        for _ in range(processes):
            busy = subprocess.Popen([sys.executable, "-c", _COMPUTE], start_new_session=True)
            stack.callback(busy.wait)
            stack.callback(busy.kill)
        stack.callback(ended.set)
        for worker in workers:
            worker.start()
        yield


def _describe_load(processes: int, threads: int) -> str:
    parts = []
    if processes:
        parts.append(f"{processes} busy process{'es' if processes > 1 else ''}")
    if threads:
        plural = "s" if threads > 1 else ""
        parts.append(f"{threads} busy Python thread{plural} in the process of the cycle")
    return " and ".join(parts) or "none"


def shortest_cycle(
    phases: Sequence[LatencyPhase], budget: Budget, settings: Settings, granted: dict[str, Grant]
) -> ShortestCycle:
    """Estimate the shortest cycle that is held, with one RPDO in a thousand after the next SYNC.

    The bus is bound by its budget. The machine is bound by the p99.9 from SYNC to RPDO plus the
    time that the RPDO takes on the wire. On a bus without a bit rate this is the time of all
    frames at `bus.bitrate`.
    """
    bus = settings.bus
    worst = max(phases, key=lambda phase: phase.sync_to_rpdo.p999_us)
    wire = budget.lines[-1].bits if settings.bus.has_wire else budget.bits
    by_bus_s = 1.0 / budget.highest_hz
    by_machine_s = worst.sync_to_rpdo.p999_us * 1e-6 + wire / bus.bitrate
    missing = next((p for p in phases if p.missed_tpdo > _MISSED_SHARE * p.cycles), None)
    if missing is not None:
        share = missing.missed_tpdo / missing.cycles
        text = (
            f"not even bus.cycle_s = {bus.cycle_s:g} is held: {share:.2%} of the TPDOs do not "
            f"arrive within 80 % of the cycle ({_when(missing)})"
        )
        return ShortestCycle(math.inf, by_bus_s, math.inf, text)
    holds_s = math.ceil(max(by_bus_s, by_machine_s) * 1e5) / 1e5
    if by_bus_s >= by_machine_s:
        why = (
            f"limited by the bus: a cycle has {budget.bits} bits, and {USABLE:.0%} of "
            f"{bus.bitrate / 1000:g} kbit/s are usable; the machine alone would hold "
            f"{by_machine_s * 1e6:.0f} µs"
        )
    else:
        why = (
            f"limited by the machine: {worst.sync_to_rpdo.p999_us:.0f} µs from SYNC to RPDO at "
            f"p99.9 ({_when(worst)}), most of it {_largest_part(worst)}{_priority(granted)}, and "
            f"{wire / bus.bitrate * 1e6:.0f} µs on a wire of {bus.bitrate / 1000:g} kbit/s; the "
            f"bus alone would hold {by_bus_s * 1e6:.0f} µs"
        )
    held = "holds" if holds_s <= bus.cycle_s else f"does not hold {bus.cycle_s * 1e3:g} ms, but"
    return ShortestCycle(
        holds_s,
        by_bus_s,
        by_machine_s,
        f"{held} a cycle of {holds_s * 1e3:.2f} ms ({math.floor(1.0 / holds_s)} Hz), {why}",
    )


def _when(phase: LatencyPhase) -> str:
    return "under load" if phase.name == "load" else phase.name


def _largest_part(phase: LatencyPhase) -> str:
    """Return the part of the way from SYNC to RPDO that is the longest by its p99.9."""
    late, own = phase.sync_error.p999_us, phase.tpdo_to_rpdo.p999_us
    parts = {
        "the SYNC being late": late,
        "from TPDO to RPDO": own,
        "waiting for the TPDO": phase.sync_to_rpdo.p999_us - late - own,
    }
    return max(parts, key=lambda name: parts[name])


def _priority(granted: dict[str, Grant]) -> str:
    return (
        ""
        if granted["scheduling"].found.startswith("SCHED_FIFO")
        else ", without real-time priority"
    )
