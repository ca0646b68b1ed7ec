"""One run from configuration to folder: the rooms put together, and nothing else.

Prepare everything that can fail on bad input, then touch the bus, then the drive.
"""

import json
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import numpy as np
import pyarrow as pa
from canopen.objectdictionary import ObjectDictionary
from numpy.typing import NDArray

from canwall import simdrive
from canwall.compiled import Record, compiled
from canwall.config import ConfigError, Settings
from canwall.cycle import (
    MAX_LAWS,
    Change,
    Outcome,
    PythonCanExchange,
    make_cycle,
    run_loop,
    timing_summary,
)
from canwall.drive import REQUIRED_OBJECTS, DriveNode, DriveSetup, Link, set_up
from canwall.eds import load_eds
from canwall.errors import RunFailedError
from canwall.physics import advance, make_plant
from canwall.plots import plot_run
from canwall.record import Recorder, RecordError, Ring, RunFolder, read_signals
from canwall.summary import summarise
from canwall.walls import Law, UnknownLawError, find_law

Array = NDArray[np.float64]


class StopRequest:
    """Whether somebody asked the run to end."""

    def __init__(self) -> None:
        self.requested = False

    def __call__(self) -> bool:
        """Whether it was asked for."""
        return self.requested


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Ctrl-C and SIGTERM ask for an end instead of ending: the drive is to be disabled first."""
    stop = StopRequest()

    def request(number: int, frame: object) -> None:
        stop.requested = True

    previous = {s: signal.signal(s, request) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def open_bus(settings: Settings) -> can.BusABC:
    """The bus of `[bus]`. Raises ConfigError where there is none."""
    bus = settings.bus
    try:
        return can.Bus(interface=bus.interface, channel=bus.channel, bitrate=bus.bitrate)
    except (can.CanError, OSError, ValueError, ImportError, TypeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConfigError(
            f"bus.interface = {bus.interface!r}, bus.channel = {bus.channel!r}: {reason}"
        ) from None


def make_simulated_drive(settings: Settings) -> simdrive.SimulatedDrive:
    """The drive of `[simulation]`, from the dictionary of `[drive]`.

    Raises ConfigError, DictionaryError.
    """
    if settings.simulation is None:
        raise ConfigError("[simulation] is missing: there is no drive to simulate")
    bus = settings.bus
    return simdrive.make_drive(settings.drive, settings.simulation, bus.cycle_s, bus.bitrate)


def serve_drive(settings: Settings, stop: Callable[[], bool], joined: Callable[[], None]) -> None:
    """A simulated drive alone on its bus, until stopped (`canwall drive`).

    `joined` is called when it hears what is on the bus.
    """
    drive = make_simulated_drive(settings)
    with open_bus(settings) as bus:
        runner = simdrive.BusRunner(drive, bus)
        joined()
        runner.run(stop)


def drive_dictionary(settings: Settings) -> ObjectDictionary:
    """The object dictionary of `[drive]`, with all that a wall needs. Raises DictionaryError."""
    return load_eds(settings.drive.eds, settings.drive.node_id, REQUIRED_OBJECTS)


@dataclass(frozen=True)
class Bench:
    """A drive that is set up, and the cycle that will render the wall on it."""

    node: DriveNode
    setup: DriveSetup
    cycle: NDArray[np.void]
    exchange: PythonCanExchange


def set_up_bench(
    link: Link,
    settings: Settings,
    dictionary: ObjectDictionary,
    laws: Sequence[Law],
    ring: Ring,
) -> Bench:
    """Set the drive up for its wall, the rows of its cycles going into the ring.

    `dictionary` is what `[drive] eds` describes. Nothing is enabled yet. Raises DriveError.
    """
    node = DriveNode(link, settings.drive.node_id, dictionary)
    setup = set_up(node, settings.drive, settings.bus, settings.real_time)
    cycle = make_cycle(settings, setup, laws)
    exchange = PythonCanExchange(link, setup, cycle, ring, settings.real_time)
    return Bench(node, setup, cycle, exchange)


def render(
    bench: Bench,
    settings: Settings,
    laws: Sequence[Law],
    stop: Callable[[], bool],
    progress: Callable[[float], None] = lambda now_s: None,
) -> Outcome:
    """Enable the drive, render the wall for `[run] duration_s` or until stopped, disable it.

    progress is told the seconds of bus time about every 100 ms of them.
    """
    period, end_s = settings.bus.cycle_s, settings.run.duration_s
    return run_loop(
        bench.exchange,
        bench.cycle,
        bench.node,
        laws,
        [Change(round(at_s / period), wall) for at_s, wall in settings.walls[1:]],
        None if end_s is None else round(end_s / period),
        stop,
        lambda j: progress(j * period),
    )


@dataclass(frozen=True)
class RunResult:
    """What a run came to."""

    folder: RunFolder
    summary: dict[str, Any]
    outcome: Outcome
    notes: list[str]


def run(
    settings: Settings,
    output: Path | None,
    report: Callable[[str], None] = lambda what: None,
    progress: Callable[[float, float | None], None] = lambda now_s, end_s: None,
) -> RunResult:
    """Enable the drive, render the wall, record, summarise, draw (`canwall run`).

    report is told the steps, progress the seconds of bus time done and their end. Raises
    ConfigError and DictionaryError before anything is enabled, DriveError where the drive cannot
    be set up, RunFailedError where no cycle came about or none was recorded.
    """
    laws = run_laws(settings)
    dictionary = drive_dictionary(settings)
    with on_the_bus(settings) as link:
        folder = RunFolder.create(output)
        folder.config.write_text(settings.to_toml(), encoding="utf-8")
        names = [law.name for law in laws]
        recorder = Recorder(folder.path, settings.run.bus_log, settings.bus.channel, names)
        try:
            link.log = recorder.ring.log_frame
            report("setting up the drive")
            bench = set_up_bench(link, settings, dictionary, laws, recorder.ring)
            report("rendering")
            with stop_on_signals() as stop:
                outcome = render(
                    bench,
                    settings,
                    laws,
                    stop,
                    lambda now_s: progress(now_s, settings.run.duration_s),
                )
        finally:
            notes = recorder.close()
    report("summarising")
    signals = _recorded(folder, [*outcome.trips, *notes])
    asked_for = (signals[name].to_numpy() for name in ("stiffness", "damping", "wall_position_rad"))
    referent = referent_positions(settings, *asked_for)
    summary = summarise(signals, settings, bench.setup.units, referent)
    summary |= {
        "missed_tpdo": int(bench.cycle["missed_tpdo"][0]),
        "late_rpdo": bench.exchange.late_rpdo,
        "trips": outcome.trips,
        "interrupted": outcome.interrupted,
        "drive": _described(bench.setup),
        "timing": {
            "sync_interval": timing_summary(bench.exchange.sync_interval),
            "tpdo_to_rpdo": timing_summary(bench.exchange.latency),
        },
    }
    folder.summary.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    report("drawing")
    plot_run(folder)
    return RunResult(folder, summary, outcome, notes)


def _recorded(folder: RunFolder, troubles: list[str]) -> pa.Table:
    """The signals of the run; without any, its troubles are all that is left to say."""
    try:
        signals = read_signals(folder.signals)
    except ConfigError as error:
        raise RecordError("; ".join(troubles) or str(error)) from None
    if signals.num_rows == 0:
        raise RunFailedError("; ".join(troubles))
    return signals


def run_laws(settings: Settings) -> list[Law]:
    """The laws of the run, each once, in the order in which they are first used.

    Raises ConfigError for a law that is not there or has not the options that it is given.
    """
    laws: dict[str, Law] = {}
    for _, wall in settings.walls:
        try:
            law = find_law(wall.law, wall.deadbeat)
            law.option_values(wall.options)
        except UnknownLawError as error:
            raise ConfigError(f"wall.law: {error}") from None
        laws[law.name] = law
    if len(laws) > MAX_LAWS:
        raise ConfigError(f"schedule: {len(laws)} laws; a run may change among {MAX_LAWS}")
    return list(laws.values())


@contextmanager
def on_the_bus(settings: Settings) -> Iterator[Link]:
    """A link to the bus; an embedded drive lives on the same bus, in the master's idle time.

    Raises ConfigError and DictionaryError.
    """
    if not settings.embedded:
        with open_bus(settings) as bus:
            yield Link(bus)
        return
    drive = make_simulated_drive(settings)
    with open_bus(settings) as bus, open_bus(settings) as drive_bus:
        yield Link(bus, idle=simdrive.BusRunner(drive, drive_bus).poll)


def _described(setup: DriveSetup) -> dict[str, float]:
    return {
        "rad_per_count": setup.units.rad_per_count,
        "nm_per_mille": setup.units.nm_per_mille,
        "tpdo_cob_id": setup.tpdo.cob_id,
        "rpdo_cob_id": setup.rpdo.cob_id,
    }


def referent_positions(
    settings: Settings, stiffness: Array, damping: Array, wall_position: Array
) -> Array | None:
    """Positions relative to the wall, at each SYNC of a run, of the continuous referent; (n,).

    The referent is the same hand with the same script on the same handle, against the continuous
    wall that each cycle asked for: stiffness [N·m/rad], damping [N·m·s/rad] and position [rad],
    each of shape (n,). None where the hand is a person's.
    """
    if settings.simulation is None:
        return None
    simulation, period = settings.simulation, settings.bus.cycle_s
    side = 1.0 if settings.wall.side == "below" else -1.0
    origin = side * wall_position
    constant, slope = simdrive.hand_force(simulation.hand, period, len(stiffness))
    # Measured from the wall, the hand's spring pulls from another place.
    pull = side * constant - simulation.hand.stiffness_nm_per_rad * origin
    y = np.empty(len(stiffness))
    y[0] = side * simulation.hand.rest_rad - origin[0]
    plant = make_plant(**simdrive.hand_plant(simulation))
    _follow(plant, stiffness, damping, origin, pull, side * slope, period, y)
    return y


@compiled
def _follow(
    plants: NDArray[np.void],
    stiffness: Array,
    damping: Array,
    origin: Array,
    constant: Array,
    slope: Array,
    period: float,
    y: Array,
) -> None:
    """Fill y from its first value on, starting at rest."""
    plant: Record = plants[0]
    v = 0.0
    for j in range(len(y) - 1):
        plant.wall_stiffness = stiffness[j]
        plant.wall_damping = damping[j]
        y_next, v, _ = advance(plant, y[j], v, constant[j], slope[j], period)
        y[j + 1] = y_next + origin[j] - origin[j + 1]
