"""Execution of a run, from configuration to folder.

Everything that can fail on bad input comes first, then the bus, then the drive.
"""

from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from pathlib import Path

from canwall.config import ConfigError, Settings
from canwall.cycle import Exchange, Experiment, Outcome, WallAxis, WallGivenUpError, run_laws
from canwall.errors import InputError, RunFailedError
from canwall.extras import how_to_install, is_installed
from canwall.record import Recorder, RunFolder, Stream, parse_target, start_recorders
from canwall.run.assembly import (
    drive_dictionary,
    make_axis,
    make_exchange,
    make_monitor,
    render,
    restoring_drives,
)
from canwall.run.buses import on_the_bus
from canwall.run.changes import open_to_changes
from canwall.run.result import RunResult, remarks_on, write_result
from canwall.stopping import stop_on_signals


def run(
    settings: Settings,
    output: Path | None,
    report: Callable[[str], None] = lambda what: None,
    progress: Callable[[float, float | None], None] = lambda now_s, end_s: None,
    stopped: Callable[[], bool] = lambda: False,
    experiment: Callable[[WallAxis], Experiment] | None = None,
) -> RunResult:
    """Enable the drive, render the wall, record, summarise, draw (`canwall run`).

    Args:
        settings: Configuration of the run.
        output: Folder of its record; None: a new folder below `runs`.
        report: Called with each step.
        progress: Called with the bus time done and its end [s], None without an end.
        stopped: Asked whether to end the run, in addition to signals.
        experiment: Makes the experiment that takes the wall's place, if there is one.

    Returns:
        The result; a trip is part of its outcome.

    Raises:
        ConfigError: For bad input; nothing has been enabled.
        DictionaryError: If the object dictionary cannot be used; nothing has been enabled.
        DriveError: If the drive cannot be set up.
        RunFailedError: If no cycle was rendered or recorded.
        Exception: A failure of the program itself, once the record is complete.
    """
    with stop_on_signals(held=False), start_recorders(1) as recorders:
        (result,) = run_together(
            [settings], recorders, output, report, progress, stopped, experiment
        )
    if result.outcome.error is not None:
        raise result.outcome.error
    return result


def run_together(
    many: Sequence[Settings],
    recorders: Sequence[Recorder],
    output: Path | None,
    report: Callable[[str], None] = lambda what: None,
    progress: Callable[[float, float | None], None] = lambda now_s, end_s: None,
    stopped: Callable[[], bool] = lambda: False,
    experiment: Callable[[WallAxis], Experiment] | None = None,
    stream: str | None = None,
    live: Callable[[Path], None] = lambda folder: None,
) -> list[RunResult]:
    """Call `run` for several drives on one bus, each with its wall, on one SYNC.

    Their `[bus]` and `[run]` have to be equal. Each drive's record has a recorder and a folder of
    its own, `node5` …; the bus log is next to these folders.

    Signals are held from the first cycle on; a second one gives up the picture. A failure of the
    program itself is in the outcome, for the caller to raise.

    With `stream`, udp://HOST:PORT, every row is also sent there while the walls are rendered
    (`canwall.record.stream`).

    `live` is called with the folder of the run, or that of the drives' folders, once other
    processes can attach to it.
    """
    check_together(many)
    target = None if stream is None else parse_target(stream)
    laws = [run_laws(settings) for settings in many]
    dictionaries = [drive_dictionary(settings) for settings in many]
    first, outcome = many[0], Outcome()
    with stop_on_signals(held=False) as stop, ExitStack() as streams:
        try:
            with on_the_bus(*many) as link:
                # One log of the bus for all of them.
                log = first.run.bus_log if len(many) == 1 else f"../{first.run.bus_log}"
                folders = _run_folders(many, output, log)
                notes: list[list[str]] = []
                for settings, folder, known, recorder in zip(
                    many, folders, laws, recorders, strict=True
                ):
                    bus_log = log if recorder is recorders[0] else ""
                    names = [law.name for law in known]
                    recorder.begin(folder.path, bus_log, first.bus.channel, names)
                    if target is not None:
                        streams.enter_context(
                            Stream(recorder.ring, target, f"node{settings.drive.node_id}", names)
                        )
                try:
                    link.log = recorders[0].ring.log_frame
                    report("setting up the drive" if len(many) == 1 else "setting up the drives")
                    with restoring_drives() as (axes, not_restored):
                        for settings, dictionary, known, recorder in zip(
                            many, dictionaries, laws, recorders, strict=True
                        ):
                            axes.append(make_axis(link, settings, dictionary, known, recorder.ring))
                        exchange = make_exchange(link, axes)
                        monitor = make_monitor(link, axes)
                        experiments = [experiment(axis) for axis in axes] if experiment else []
                        report("measuring" if experiments else "rendering")
                        with (
                            closing(exchange),
                            open_to_changes(axes, folders, exchange, outcome, stop.request),
                        ):
                            stop.hold(exchange.attend)
                            live(folders[0].path if len(many) == 1 else folders[0].path.parent)
                            _render(
                                exchange,
                                lambda: _recorded(recorders) and (stop() or stopped()),
                                progress,
                                outcome,
                                experiments,
                            )
                finally:
                    notes = [recorder.close() for recorder in recorders]
            report("summarising")
            results = []
            for axis, folder, of_record in zip(axes, folders, notes, strict=True):
                of_axis = [*of_record, *monitor.notes] if axis is axes[0] else of_record
                remarks = remarks_on(axis.setup, axis.settings)
                kept = not_restored.get(axis.name, [])
                result = write_result(
                    axis, exchange, monitor, folder, outcome, of_axis, remarks, kept
                )
                if len(axes) > 1:
                    result.remarks[:] = [f"{axis.name}: {text}" for text in result.remarks]
                results.append(result)
            results[0].remarks.extend(outcome.notes)
        except Exception as error:
            if (told := _told(outcome, error)) is error:
                raise
            raise told from error
        if not is_installed("plot"):
            results[0].remarks.append(f"no picture: {how_to_install('plot')}, then canwall plot")
            return results
        report("drawing")
        enough = 1 if outcome.interrupted else 0
        for recorder, result in zip(recorders, results, strict=True):
            picture = recorder.draw(lambda: stop.count > enough)
            (result.remarks if stop.count > enough else result.notes).extend(picture)
    return results


def _render(
    exchange: Exchange,
    stop: Callable[[], bool],
    progress: Callable[[float, float | None], None],
    outcome: Outcome,
    experiments: Sequence[Experiment],
) -> None:
    """Render the walls; a failure of the program itself is in the outcome."""
    end_s = exchange.axes[0].settings.run.duration_s
    try:
        render(
            exchange,
            stop,
            lambda now_s: progress(now_s, end_s),
            outcome,
            experiments,
        )
    except Exception as error:
        outcome.error = outcome.error or error


def _told(outcome: Outcome, error: Exception) -> Exception:
    """Return the error, preceded by the trips if it does not tell them itself."""
    trips = "; ".join(outcome.trips)
    if not trips or trips in str(error):
        return error
    named = isinstance(error, (InputError, RunFailedError))
    what = str(error) if named else f"{type(error).__name__}: {error}"
    told = RunFailedError(f"{trips}; then: {what}")
    for note in getattr(error, "__notes__", ()):
        told.add_note(note)
    return told


def check_together(many: Sequence[Settings]) -> None:
    """Raise ConfigError unless the drives can be on one bus and one SYNC."""
    first = many[0]
    for settings in many[1:]:
        for section in ("bus", "run"):
            ours, others = getattr(first, section), getattr(settings, section)
            for key in type(ours).model_fields:
                if getattr(ours, key) != getattr(others, key):
                    raise ConfigError(
                        f"{section}.{key} differs between the configurations: drives that run "
                        f"together share the bus and its SYNC; make the [{section}] of all equal"
                    )
    nodes = [settings.drive.node_id for settings in many]
    if len(set(nodes)) < len(nodes):
        raise ConfigError(f"drive.node_id: {nodes}: every drive needs one of its own")


def _recorded(recorders: Sequence[Recorder]) -> bool:
    """Return True while the run is recorded. Raises WallGivenUpError once it is not."""
    for recorder in recorders:
        if failure := recorder.failure():
            raise WallGivenUpError(failure)
    return True


def _run_folders(many: Sequence[Settings], output: Path | None, bus_log: str) -> list[RunFolder]:
    if len(many) == 1:
        return [RunFolder.create(output, many[0].to_toml(), bus_log)]
    base = output or RunFolder.default_path()
    folders: list[RunFolder] = []
    try:
        for settings in many:
            path = base / f"node{settings.drive.node_id}"
            folders.append(RunFolder.create(path, settings.to_toml(), bus_log))
    except ConfigError:
        for folder in folders:
            folder.config.unlink(missing_ok=True)
        raise
    return folders
