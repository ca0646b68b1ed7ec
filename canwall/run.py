"""One run from configuration to folder: the rooms put together, and nothing else.

Prepare everything that can fail on bad input, then touch the bus, then the drive.
"""

import json
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from canwall import simdrive
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
from canwall.record import Recorder, RecordError, RunFolder, read_signals
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

    Raises ConfigError.
    """
    if settings.simulation is None:
        raise ConfigError("[simulation] is missing: there is no drive to simulate")
    try:
        return simdrive.make_drive(settings.drive, settings.simulation, settings.bus.cycle_s)
    except simdrive.DictionaryError as error:
        raise ConfigError(f"drive.eds: {error}") from None


def serve_drive(settings: Settings, stop: Callable[[], bool]) -> None:
    """A simulated drive alone on its bus, until stopped (`canwall drive`)."""
    drive = make_simulated_drive(settings)
    with open_bus(settings) as bus:
        simdrive.BusRunner(drive, bus).run(stop)


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

    report is told the steps before and after the loop, progress the seconds of bus time done and
    their end. Raises ConfigError and DictionaryError before anything is enabled, DriveError where
    the drive cannot be set up, RunFailedError where no cycle came about or none was recorded.
    """
    laws = run_laws(settings)
    dictionary = load_eds(settings.drive.eds, settings.drive.node_id, REQUIRED_OBJECTS)
    simulated = make_simulated_drive(settings) if settings.embedded else None
    with _on_the_bus(settings, simulated) as link:
        folder = RunFolder.create(output)
        folder.config.write_text(settings.to_toml(), encoding="utf-8")
        recorder = Recorder(
            folder.path, settings.run.bus_log, settings.bus.channel, [law.name for law in laws]
        )
        try:
            link.log = recorder.ring.log_frame
            report("setting up the drive")
            node = DriveNode(link, settings.drive.node_id, dictionary)
            setup = set_up(node, settings.drive)
            cycle = make_cycle(settings, setup, laws)
            exchange = PythonCanExchange(link, setup, cycle, recorder.ring, settings.real_time)
            end_s = settings.run.duration_s
            report("rendering")
            with stop_on_signals() as stop:
                outcome = run_loop(
                    exchange,
                    cycle,
                    node,
                    laws,
                    _changes(settings),
                    None if end_s is None else round(end_s / settings.bus.cycle_s),
                    stop,
                    lambda j: progress(j * settings.bus.cycle_s, end_s),
                )
        finally:
            notes = recorder.close()
    report("summarising")
    signals = _recorded(folder, [*outcome.trips, *notes])
    summary = summarise(signals, settings, setup.units, referent_positions(settings, signals))
    summary |= {
        "missed_tpdo": int(cycle["missed_tpdo"][0]),
        "late_rpdo": exchange.late_rpdo,
        "trips": outcome.trips,
        "interrupted": outcome.interrupted,
        "drive": _described(setup),
        "timing": {
            "sync_interval": timing_summary(exchange.sync_interval),
            "tpdo_to_rpdo": timing_summary(exchange.latency),
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


def _changes(settings: Settings) -> list[Change]:
    period = settings.bus.cycle_s
    return [Change(round(at_s / period), wall) for at_s, wall in settings.walls[1:]]


@contextmanager
def _on_the_bus(settings: Settings, simulated: simdrive.SimulatedDrive | None) -> Iterator[Link]:
    """A link to the bus; an embedded drive lives on the same bus, in the master's idle time."""
    if simulated is None:
        with open_bus(settings) as bus:
            yield Link(bus)
    else:
        with open_bus(settings) as bus, open_bus(settings) as drive_bus:
            runner = simdrive.BusRunner(simulated, drive_bus)
            yield Link(bus, idle=runner.poll)


def _described(setup: DriveSetup) -> dict[str, float]:
    return {
        "rad_per_count": setup.units.rad_per_count,
        "nm_per_mille": setup.units.nm_per_mille,
        "tpdo_cob_id": setup.tpdo.cob_id,
        "rpdo_cob_id": setup.rpdo.cob_id,
    }


def referent_positions(settings: Settings, signals: Any) -> Array | None:
    """Positions relative to the wall, at each SYNC of the record, of the continuous referent.

    The referent is the same hand with the same script on the same handle, against the continuous
    wall that each cycle asks for; shape (n,). None where the hand is a person's.
    """
    if settings.simulation is None:
        return None
    simulation, period = settings.simulation, settings.bus.cycle_s
    count = signals.num_rows
    stiffness = signals["stiffness"].to_numpy()
    damping = signals["damping"].to_numpy()
    wall_position = signals["wall_position_rad"].to_numpy()
    side = 1.0 if settings.wall.side == "below" else -1.0
    constant, slope = simdrive.hand_force(simulation.hand, period, count)
    plant = make_plant(**simdrive.hand_plant(simulation))
    y, v = side * (simulation.hand.rest_rad - wall_position[0]), 0.0
    positions = np.empty(count)
    for j in range(count):
        positions[j] = y
        origin = side * wall_position[j]
        plant["wall_stiffness"], plant["wall_damping"] = stiffness[j], damping[j]
        # The hand's spring is measured from the wall as well.
        pull = side * constant[j] - simulation.hand.stiffness_nm_per_rad * origin
        y, v, _ = advance(plant[0], y, v, pull, side * slope[j], period)
        if j + 1 < count:
            y += origin - side * wall_position[j + 1]
    return positions
