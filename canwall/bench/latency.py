"""How well the cycle keeps to the clock on a bus, idle and under load, and what that holds.

The drive is set up as for a run and gets a SYNC and an RPDO in every cycle, but it is never
enabled: the controlword is 0 and so is the torque, and the wall's law is not asked (its time is
that of `scripts/bench law_steps`). At the end everything that was changed in it is put back.
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

from canwall.bench.budget import USABLE, Budget, BudgetFrame, bus_budget
from canwall.config import Settings
from canwall.cycle import (
    Exchange,
    Grant,
    WallAxis,
    buckets_ns,
    percentile_ns,
    real_time_machine,
    run_laws,
)
from canwall.drive.pdo import tpdos_on_sync
from canwall.errors import RunFailedError
from canwall.record import Ring
from canwall.run import StopRequest, drive_dictionary, make_axis, make_exchange, on_the_bus

#: Cycles before each phase that are not counted: caches, and a load that has yet to begin [s].
_SETTLING_S = 0.3
#: How often a TPDO may be missing, or an RPDO late, where a cycle is held.
_RARELY = 1e-3
#: Interfaces whose frames take no time on a wire.
_WITHOUT_BIT_RATE = ("virtual", "unixcan")

#: A process that computes all the time, until the one that started it has gone.
_COMPUTE = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: sum(range(100_000))"


@dataclass(frozen=True)
class Histogram:
    """How often what took how long.

    ends_us: upper ends of the buckets, inclusive, shape (n,), ascending [us]; counts: shape (n,);
    p50_us, p99_us, p999_us, max_us [us].
    """

    ends_us: NDArray[np.float64]
    counts: NDArray[np.int64]
    p50_us: float
    p99_us: float
    p999_us: float
    max_us: float

    @classmethod
    def of(cls, histogram: NDArray[np.void]) -> "Histogram":
        """From a HISTOGRAM array of shape (1,)."""
        ends, counts = buckets_ns(histogram)
        p50, p99, p999 = (percentile_ns(histogram, percent) / 1e3 for percent in (50, 99, 99.9))
        return cls(ends / 1e3, counts, p50, p99, p999, float(histogram["largest_ns"][0]) / 1e3)


@dataclass(frozen=True)
class LatencyPart:
    """One part of the measurement.

    sync_error: |interval of the SYNC − period|. tpdo_to_rpdo: from the TPDO's arrival, by the
    kernel's time stamp where the bus has one, to the RPDO being handed over. sync_to_rpdo: from the
    instant at which the SYNC was due to the RPDO being handed over; the margin before the next SYNC
    is the period less that.
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
    """What the machine, the interface and the bus hold together.

    holds_s: shortest cycle [s], math.inf where none was seen to be held; by_bus_s, by_machine_s:
    what either would hold alone. text: one line.
    """

    holds_s: float
    by_bus_s: float
    by_machine_s: float
    text: str


@dataclass(frozen=True)
class Latency:
    """The measurement: on what, what the machine granted, its phases, and what follows."""

    interface: str
    channel: str
    bitrate: int
    cycle_s: float
    exchange: str
    granted: dict[str, Grant]
    load: str
    phases: tuple[LatencyPart, ...]
    budget: Budget
    shortest_cycle: ShortestCycle
    notes: tuple[str, ...]


def measured_settings(settings: Settings) -> Settings:
    """The settings of a measurement: in real time, and an end that no schedule changes."""
    bus = settings.bus.model_copy(update={"pace": "real_time"})
    return settings.model_copy(update={"bus": bus, "schedule": ()})


def measure_latency(
    settings: Settings,
    duration_s: float,
    processes: int,
    threads: int,
    stop: StopRequest,
    report: Callable[[str], None] = lambda what: None,
    progress: Callable[[str, float, float], None] = lambda what, now_s, end_s: None,
) -> Latency | None:
    """Run the cycle for `duration_s` idle, and as long under load; None if it was stopped.

    The load: so many processes, and Python threads of this process, that compute all the time.
    report is told the steps, progress the part of the measurement, its seconds and their end.
    Raises ConfigError, DictionaryError, DriveError, RunFailedError where no TPDO comes,
    can.CanError.
    """
    settings = measured_settings(settings)
    parts = [("idle", (0, 0)), ("load", (processes, threads))][: 2 if processes or threads else 1]
    dictionary, laws = drive_dictionary(settings), run_laws(settings)
    with on_the_bus(settings) as link:
        ring = Ring.create()
        report("setting up the drive; it is not enabled")
        axis = make_axis(link, settings, dictionary, laws, ring)
        notes: list[str] = []
        try:
            budget = _budget(axis, settings)
            with closing(make_exchange(link, [axis])) as exchange:
                cycling = _Cycling(axis, exchange, stop, progress)
                phases = []
                for name, load in parts:
                    # The load comes first: it has neither the priority nor the processor.
                    with (
                        _load(*load),
                        _no_collection(),
                        real_time_machine(settings.bus.processor) as granted,
                    ):
                        phases.append(cycling.phase(name, duration_s))
                    if stop():
                        return None
        finally:
            notes += axis.node.restore()
            ring.close()
    bus = settings.bus
    return Latency(
        bus.interface,
        bus.channel,
        bus.bitrate,
        bus.cycle_s,
        exchange.name,
        granted,
        _described(processes, threads),
        tuple(phases),
        budget,
        shortest_cycle(phases, budget, settings, granted),
        tuple(notes),
    )


class _Cycling:
    """The cycle of a drive that is not enabled, and the histograms of a part of it."""

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

    def phase(self, name: str, duration_s: float) -> LatencyPart:
        """So many seconds of cycles. Raises RunFailedError where no TPDO comes at all."""
        axis, exchange = self._axis, self._exchange
        self._run(name, _SETTLING_S, told=False)
        missed_before = int(axis.cycle["missed_tpdo"][0])
        if missed_before and missed_before == int(axis.cycle["j"][0]):
            raise RunFailedError(
                f"no TPDO (0x{axis.setup.tpdo.cob_id:03X}) for {missed_before} SYNCs"
            )
        late_before = axis.late_rpdo
        histograms = (exchange.sync_error, axis.latency, axis.sync_to_rpdo)
        for histogram in histograms:
            # In place: compiled code knows where they are.
            histogram[:] = np.zeros(1, histogram.dtype)
        first = int(axis.cycle["j"][0])
        self._run(name, duration_s, told=True)
        return LatencyPart(
            name,
            int(axis.cycle["j"][0]) - first,
            int(axis.cycle["missed_tpdo"][0]) - missed_before,
            axis.late_rpdo - late_before,
            *(Histogram.of(histogram) for histogram in histograms),
        )

    def _run(self, name: str, duration_s: float, told: bool) -> None:
        cycles = max(1, round(duration_s / self._period_s))
        cycle, first = self._axis.cycle, int(self._axis.cycle["j"][0])
        while (done := int(cycle["j"][0]) - first) < cycles and not self._stop():
            if told:
                self._progress(name, done * self._period_s, cycles * self._period_s)
            self._exchange.cycle(min(self._exchange.ahead, cycles - done))
            self._axis.ring.take_rows()


@contextmanager
def _no_collection() -> Iterator[None]:
    """As in a run: a collection would stop the cycle for milliseconds."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


@contextmanager
def _load(processes: int, threads: int) -> Iterator[None]:
    """Processes and threads that compute all the time."""
    over = threading.Event()

    def compute() -> None:
        while not over.is_set():
            sum(range(100))

    workers = [threading.Thread(target=compute, daemon=True) for _ in range(threads)]
    with ExitStack() as stack:
        for _ in range(processes):
            busy = subprocess.Popen([sys.executable, "-c", _COMPUTE], start_new_session=True)
            stack.callback(busy.wait)
            stack.callback(busy.kill)
        stack.callback(over.set)
        for worker in workers:
            worker.start()
        yield


def _described(processes: int, threads: int) -> str:
    parts = []
    if processes:
        parts.append(
            f"{processes} process{'es' if processes > 1 else ''} that compute all the time"
        )
    if threads:
        parts.append(f"{threads} Python thread{'s' if threads > 1 else ''} of its own process")
    return " and ".join(parts) or "none"


def _budget(axis: WallAxis, settings: Settings) -> Budget:
    """Of all that the drive sends with a SYNC, and of the cycle's own frames."""
    setup, bus = axis.setup, settings.bus
    return bus_budget(
        BudgetFrame("SYNC", setup.sync_cob_id, 1 if setup.sync_counter_overflow else 0),
        [BudgetFrame("TPDO", tpdo.cob_id, tpdo.length) for tpdo in tpdos_on_sync(axis.node)],
        [BudgetFrame("RPDO", setup.rpdo.cob_id, setup.rpdo.length)],
        bus.bitrate,
        bus.cycle_s,
    )


def shortest_cycle(
    phases: Sequence[LatencyPart], budget: Budget, settings: Settings, granted: dict[str, Grant]
) -> ShortestCycle:
    """The shortest cycle that is held: one RPDO of a thousand may come after the next SYNC.

    By the machine: the p99.9 of SYNC to RPDO, and the time that frames take on the wire after that;
    on a bus without a bit rate all of them, as they would at `bus.bitrate`. By the bus: its budget.
    """
    bus = settings.bus
    worst = max(phases, key=lambda phase: phase.sync_to_rpdo.p999_us)
    wire = budget.bits if _without_bit_rate(settings) else budget.lines[-1].bits
    by_bus_s = 1.0 / budget.highest_hz
    by_machine_s = worst.sync_to_rpdo.p999_us * 1e-6 + wire / bus.bitrate
    missing = next((p for p in phases if p.missed_tpdo > _RARELY * p.cycles), None)
    if missing is not None:
        share = missing.missed_tpdo / missing.cycles
        text = (
            f"not even bus.cycle_s = {bus.cycle_s:g} is held: {share:.2%} of the TPDOs do not come "
            f"within 80 % of the cycle ({_when(missing)})"
        )
        return ShortestCycle(math.inf, by_bus_s, math.inf, text)
    holds_s = math.ceil(max(by_bus_s, by_machine_s) * 1e5) / 1e5
    if by_bus_s >= by_machine_s:
        why = (
            f"bound by the bus: a cycle has {budget.bits} bits, and {USABLE:.0%} of "
            f"{bus.bitrate / 1000:g} kbit/s may be used; the machine alone would hold "
            f"{by_machine_s * 1e6:.0f} µs"
        )
    else:
        why = (
            f"bound by the machine: {worst.sync_to_rpdo.p999_us:.0f} µs from SYNC to RPDO at p99.9 "
            f"({_when(worst)}), most of it {_largest_part(worst)}{_priority(granted)}, and "
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


def _without_bit_rate(settings: Settings) -> bool:
    bus = settings.bus
    return bus.interface in _WITHOUT_BIT_RATE or bus.channel.startswith("vcan")


def _when(phase: LatencyPart) -> str:
    return "under load" if phase.name == "load" else phase.name


def _largest_part(phase: LatencyPart) -> str:
    """Which part of the way from SYNC to RPDO is the longest, by its p99.9."""
    late, own = phase.sync_error.p999_us, phase.tpdo_to_rpdo.p999_us
    parts = {
        "the SYNC that is late": late,
        "from TPDO to RPDO": own,
        "until the TPDO comes": phase.sync_to_rpdo.p999_us - late - own,
    }
    return max(parts, key=lambda name: parts[name])


def _priority(granted: dict[str, Grant]) -> str:
    return (
        ""
        if granted["scheduling"].found.startswith("SCHED_FIFO")
        else ", without real-time priority"
    )
