"""One run from configuration to folder: the rooms put together, and nothing else.

Prepare everything that can fail on bad input, then touch the bus, then the drive.
"""

import json
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import can
import numpy as np
import pyarrow as pa
from canopen.objectdictionary import ObjectDictionary
from numpy.typing import NDArray

from canwall import simdrive
from canwall.config import ConfigError, Settings
from canwall.cycle import (
    Axis,
    Change,
    Exchange,
    ExternalSync,
    NativeExchange,
    Outcome,
    PythonCanExchange,
    Watch,
    real_time_machine,
    run_laws,
    run_loop,
    timing_summary,
)
from canwall.drive import (
    REQUIRED_OBJECTS,
    DriveError,
    DriveNode,
    DriveSetup,
    Link,
    refuse_second_master,
    set_up,
)
from canwall.eds import load_eds
from canwall.errors import RunFailedError
from canwall.live import open_to_changes
from canwall.pair import pair
from canwall.plots import plot_run
from canwall.record import Recorder, RecordError, Ring, RunFolder, read_signals
from canwall.referent import referent_positions
from canwall.summary import summarise
from canwall.walls import Law

Array = NDArray[np.float64]

#: What asks a run to end.
_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
#: How long compiled code keeps the cycle before the loop looks after signals, messages and changes
#: [s of bus time].
_LOOKS_S, _SIMULATED_LOOKS_S = 0.02, 1.0


class StopRequest:
    """Whether somebody asked the run to end."""

    def __init__(self) -> None:
        self.requested = False

    def __call__(self) -> bool:
        """Whether it was asked for."""
        return self.requested


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Ctrl-C, SIGTERM and a terminal that is closed ask for an end instead of ending.

    The drive is to be disabled first. What the program was started to ignore (nohup) it ignores.
    """
    stop = StopRequest()

    def request(number: int, frame: object) -> None:
        stop.requested = True

    ends = [s for s in _ENDING if signal.getsignal(s) is not signal.SIG_IGN]
    previous = {s: signal.signal(s, request) for s in ends}
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


def make_simulated_drive(
    settings: Settings, report: Callable[[str], None] = lambda line: None
) -> simdrive.FaultyDrive:
    """The drive of `[simulation]`, from the dictionary of `[drive]`.

    report is told in a line when one of its faults begins or ends. Raises
    ConfigError, DictionaryError.
    """
    if settings.simulation is None:
        raise ConfigError("[simulation] is missing: there is no drive to simulate")
    bus = settings.bus
    return simdrive.make_drive(
        settings.drive, settings.simulation, bus.cycle_s, bus.bitrate, report
    )


def serve_drive(
    settings: Settings,
    stop: Callable[[], bool],
    joined: Callable[[], None],
    report: Callable[[str], None] = lambda line: None,
) -> None:
    """A simulated drive alone on its bus, until stopped (`canwall drive`).

    `joined` is called when it hears what is on the bus, report is told of its faults, and of the
    bus being gone.
    """
    drive = make_simulated_drive(settings, report)
    with open_bus(settings) as bus:
        # A controller makes its own error frames; given one, it sends it as data.
        virtual = settings.bus.interface == "unixcan" or settings.bus.channel.startswith("vcan")
        runner = simdrive.BusRunner(drive, bus, error_frames=virtual, report=report)
        joined()
        runner.run(stop)


def drive_dictionary(settings: Settings) -> ObjectDictionary:
    """The object dictionary of `[drive]`, with all that a wall needs. Raises DictionaryError."""
    return load_eds(settings.drive.eds, settings.drive.node_id, REQUIRED_OBJECTS)


def make_axis(
    link: Link,
    settings: Settings,
    dictionary: ObjectDictionary,
    laws: Sequence[Law],
    ring: Ring,
) -> Axis:
    """Set the drive up for its wall, the rows of its cycles going into the ring.

    `dictionary` is what `[drive] eds` describes. Nothing is enabled yet. Raises DriveError.
    """
    node = DriveNode(link, settings.drive.node_id, dictionary)
    try:
        setup = set_up(node, settings.drive, settings.bus, settings.real_time)
    except BaseException:
        if settings.drive.restore:
            node.restore()
        raise
    period = settings.bus.cycle_s
    changes = [
        Change(round(at_s / period), wall, limits) for at_s, wall, limits in settings.stages[1:]
    ]
    return Axis(node, setup, settings, laws, ring, changes)


def make_exchange(link: Link, axes: Sequence[Axis]) -> Exchange:
    """The cycle of all axes, on the SYNC and by the exchange that `[bus]` says.

    Raises DriveError, and ConfigError for an exchange that the bus does not have.
    """
    settings, setup = axes[0].settings, axes[0].setup
    for axis in axes[1:]:
        other = axis.setup
        if (other.sync_cob_id, other.sync_counter_overflow) != (
            setup.sync_cob_id,
            setup.sync_counter_overflow,
        ):
            raise DriveError(
                f"{axis.name} wants another SYNC than {axes[0].name}: make 0x1005 and 0x1019 equal"
            )
    external = settings.bus.sync == "external"
    if settings.bus.exchange != "python-can":
        try:
            exchange = NativeExchange(link, axes, settings.real_time, external)
            looks_s = _LOOKS_S if settings.real_time else _SIMULATED_LOOKS_S
            exchange.ahead = max(1, round(looks_s / settings.bus.cycle_s))
            return exchange
        except can.CanInitializationError as error:
            if settings.bus.exchange == "native":
                raise ConfigError(f"bus.exchange = 'native': {error}") from None
    sync = None
    if external:
        sync = ExternalSync(link, setup.sync_cob_id, settings.bus.cycle_s)
    return PythonCanExchange(link, axes, settings.real_time, sync)


def make_watch(link: Link, axes: Sequence[Axis]) -> Watch:
    """What ends the walls beside the cycle; a second SYNC as well, where the master sends it."""
    external = axes[0].settings.bus.sync == "external"
    return Watch(link, axes, None if external else axes[0].setup.sync_cob_id)


def render(
    exchange: Exchange,
    stop: Callable[[], bool],
    progress: Callable[[float], None] = lambda now_s: None,
) -> Outcome:
    """Enable the drives, render the walls for `[run] duration_s` or until stopped, disable them.

    progress is told the seconds of bus time about every 100 ms of them.
    """
    settings = exchange.axes[0].settings
    period, end_s = settings.bus.cycle_s, settings.run.duration_s
    cycles = None if end_s is None else round(end_s / period)
    return run_loop(exchange, cycles, stop, lambda j: progress(j * period))


@dataclass(frozen=True)
class RunResult:
    """What a run came to: notes are what the record lacks, remarks what the drive would not do."""

    folder: RunFolder
    summary: dict[str, Any]
    outcome: Outcome
    notes: list[str]
    remarks: list[str]


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
    (result,) = run_together([settings], output, report, progress)
    return result


def run_together(
    many: Sequence[Settings],
    output: Path | None,
    report: Callable[[str], None] = lambda what: None,
    progress: Callable[[float, float | None], None] = lambda now_s, end_s: None,
) -> list[RunResult]:
    """`run` for several drives on one bus, each with its wall, on one SYNC.

    Their `[bus]` and `[run]` have to be the same. Each drive's record has a folder of its own,
    `node5` …; the bus log lies beside these folders.
    """
    _check_together(many)
    laws = [run_laws(settings) for settings in many]
    dictionaries = [drive_dictionary(settings) for settings in many]
    first = many[0]
    with on_the_bus(*many) as link:
        folders = _run_folders(many, output)
        recorders: list[Recorder] = []
        notes: list[list[str]] = []
        try:
            for settings, folder, known in zip(many, folders, laws, strict=True):
                folder.config.write_text(settings.to_toml(), encoding="utf-8")
                # One log of the bus for all of them.
                log = first.run.bus_log if len(many) == 1 else f"../{first.run.bus_log}"
                names = [law.name for law in known]
                recorders.append(
                    Recorder(folder.path, None if recorders else log, first.bus.channel, names)
                )
            link.log = recorders[0].ring.log_frame
            report("setting up the drive" if len(many) == 1 else "setting up the drives")
            with restored() as (axes, not_restored):
                for settings, dictionary, known, recorder in zip(
                    many, dictionaries, laws, recorders, strict=True
                ):
                    axes.append(make_axis(link, settings, dictionary, known, recorder.ring))
                exchange = make_exchange(link, axes)
                watch = make_watch(link, axes)
                report("rendering")
                with (
                    closing(exchange),
                    open_to_changes(axes, folders),
                    stop_on_signals() as stop,
                    scheduled(first) as scheduling,
                ):
                    outcome = render(
                        exchange, stop, lambda now_s: progress(now_s, first.run.duration_s)
                    )
        finally:
            notes = [recorder.close() for recorder in recorders]
    report("summarising")
    results = []
    for axis, folder, noted in zip(axes, folders, notes, strict=True):
        said = [*noted, *watch.notes] if axis is axes[0] else noted
        remarks = [*_remarks(axis.setup, axis.settings), *not_restored.get(axis.name, [])]
        results.append(_result(axis, exchange, watch, scheduling, folder, outcome, said, remarks))
    report("drawing")
    for folder in folders:
        plot_run(folder)
    return results


@contextmanager
def restored() -> Iterator[tuple[list[Axis], dict[str, list[str]]]]:
    """Axes whose drives are put back at the end, where `[drive] restore` asks for it.

    Yields the list to fill with them, and what will be left by their names: that which could not
    be put back.
    """
    axes: list[Axis] = []
    left: dict[str, list[str]] = {}
    try:
        yield axes, left
    finally:
        for axis in axes:
            if axis.settings.drive.restore:
                left[axis.name] = axis.node.restore()


def scheduled(settings: Settings) -> AbstractContextManager[dict[str, str]]:
    """The machine's set-up for a run that keeps to the clock; tells what was granted."""
    if settings.real_time:
        return real_time_machine(settings.bus.processor)
    return nullcontext({"scheduling": "simulated time"})


def _check_together(many: Sequence[Settings]) -> None:
    first = many[0]
    for settings in many[1:]:
        for section in ("bus", "run"):
            if getattr(settings, section) != getattr(first, section):
                raise ConfigError(
                    f"[{section}] differs between the configurations: drives that run together "
                    "share the bus and its SYNC; make the sections equal"
                )
    nodes = [settings.drive.node_id for settings in many]
    if len(set(nodes)) < len(nodes):
        raise ConfigError(f"drive.node_id: {nodes}: every drive needs one of its own")


def _run_folders(many: Sequence[Settings], output: Path | None) -> list[RunFolder]:
    if len(many) == 1:
        return [RunFolder.create(output)]
    base = output or RunFolder.default_path()
    return [RunFolder.create(base / f"node{settings.drive.node_id}") for settings in many]


def _result(
    axis: Axis,
    exchange: Exchange,
    watch: Watch,
    scheduling: dict[str, str],
    folder: RunFolder,
    outcome: Outcome,
    notes: list[str],
    remarks: list[str],
) -> RunResult:
    """Summary of one axis, and its last cycles where it tripped."""
    settings = axis.settings
    signals = _recorded(folder, [*outcome.trips, *notes])
    asked_for = (signals[name].to_numpy() for name in ("stiffness", "damping", "wall_position_rad"))
    referent = referent_positions(settings, *asked_for)
    summary = summarise(signals, settings, axis.setup.units, referent)
    summary |= {
        "missed_tpdo": int(axis.cycle["missed_tpdo"][0]),
        "late_rpdo": axis.late_rpdo,
        "error_frames": watch.error_frames,
        "trips": outcome.trips,
        "trip_cycle": outcome.trip_cycle,
        "interrupted": outcome.interrupted,
        "delay_cycles": axis.delay,
        "drive": _described(axis.setup),
        "timing": {
            "exchange": exchange.name,
            **scheduling,
            "sync_interval": timing_summary(exchange.sync_interval),
            "tpdo_to_rpdo": timing_summary(axis.latency),
        },
    }
    folder.summary.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    if outcome.trip_cycle is not None:
        folder.write_trip(signals, outcome.trip_cycle)
    return RunResult(folder, summary, outcome, notes, remarks)


def _recorded(folder: RunFolder, troubles: list[str]) -> pa.Table:
    """The signals of the run; without any, its troubles are all that is left to say."""
    try:
        signals = read_signals(folder.signals)
    except ConfigError as error:
        raise RecordError("; ".join(troubles) or str(error)) from None
    if signals.num_rows == 0:
        raise RunFailedError("; ".join(troubles))
    return signals


@contextmanager
def on_the_bus(*many: Settings) -> Iterator[Link]:
    """A link to the bus; embedded drives live on the same bus, in the master's idle time.

    Raises ConfigError and DictionaryError, DriveError where another master is on it.
    """
    if not many[0].embedded:
        with open_bus(many[0]) as bus:
            link = Link(bus)
            nodes = [settings.drive.node_id for settings in many]
            refuse_second_master(link, many[0].bus, nodes)
            yield link
        return
    drives = [make_simulated_drive(settings) for settings in many]
    with ExitStack() as stack:
        if len(many) == 1 and many[0].bus.exchange == "native":
            bus, drive_bus = (stack.enter_context(end) for end in pair(many[0].bus.channel))
            runner = simdrive.CompiledRunner(drives[0], drive_bus)
            yield Link(bus, runner.poll, runner.compiled)
            return
        bus = stack.enter_context(open_bus(many[0]))
        polls = [
            simdrive.BusRunner(drive, stack.enter_context(open_bus(settings))).poll
            for drive, settings in zip(drives, many, strict=True)
        ]
        yield Link(bus, idle=polls[0] if len(polls) == 1 else partial(_call_all, polls))


def _call_all(functions: Sequence[Callable[[], None]]) -> None:
    for function in functions:
        function()


def _remarks(setup: DriveSetup, settings: Settings) -> list[str]:
    remarks = [f"the drive: {note}" for note in setup.notes]
    if setup.torque_limit_nm < settings.limits.torque_nm and setup.scales is not None:
        whence = setup.scales.sources[-1][1]
        remarks.append(
            f"the drive holds the torque to {setup.torque_limit_nm:g} N·m ({whence}), below "
            f"limits.torque_nm = {settings.limits.torque_nm:g}; [drive.parameters] may raise it"
        )
    if setup.watchdog.kind == "none":
        remarks.append("the drive has no watchdog: a master that dies leaves the torque on")
    return remarks


def _described(setup: DriveSetup) -> dict[str, Any]:
    return {
        "mode": str(setup.mode),
        "watchdog": str(setup.watchdog),
        "notes": list(setup.notes),
        "rad_per_count": setup.units.rad_per_count,
        "nm_per_mille": setup.units.nm_per_mille,
        "tpdo_cob_id": setup.tpdo.cob_id,
        "rpdo_cob_id": setup.rpdo.cob_id,
    }
