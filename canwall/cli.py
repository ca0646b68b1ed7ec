"""The commands, thin: options in, one call, tables and error lines out."""

import math
import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from can import CanError
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from canwall import config
from canwall.config import ConfigError, Settings, absolute_law
from canwall.errors import InputError, RunFailedError

if TYPE_CHECKING:
    from canwall.bench import Findings

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="A stiff virtual wall without chatter on a CANopen servo drive.",
)

#: Exit codes: a run that failed or tripped, bad input, and Ctrl-C with the drive disabled.
FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130

_console = Console()
_errors = Console(stderr=True, soft_wrap=True, highlight=False)

_ConfigArgument = Annotated[
    Path | None, typer.Argument(metavar="[CONFIG]", help="A TOML file; without: config/sim.toml.")
]
_EdsOption = Annotated[
    Path | None, typer.Option("--eds", metavar="PATH", help="The drive's EDS or DCF.")
]
_NoWatchdogOption = Annotated[
    bool,
    typer.Option("--accept-no-watchdog", help="Go on with a drive that has no watchdog."),
]


def _settings(path: Path | None, **overrides: Any) -> Settings:
    """The settings of a file, with what was given on the command line instead."""
    dotted = {
        key.replace("__", "."): value for key, value in overrides.items() if value is not None
    }
    return config.load(path or config.shipped("config/sim.toml"), dotted)


def _absolute(path: Path | None) -> Path | None:
    """What is given on the command line is relative to where one is, not to the configuration."""
    return path and path.resolve()


@app.command()
def run(
    config_files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[CONFIG]...",
            help="TOML files, one for each drive on the bus; without: config/sim.toml.",
        ),
    ] = None,
    law: Annotated[str | None, typer.Option(help="Law of the wall.")] = None,
    stiffness: Annotated[float | None, typer.Option(help="Stiffness [N·m/rad].")] = None,
    damping: Annotated[float | None, typer.Option(help="Damping [N·m·s/rad].")] = None,
    duration: Annotated[float | None, typer.Option(help="Seconds; without: until Ctrl-C.")] = None,
    output: Annotated[Path | None, typer.Option(help="Folder of the run's record.")] = None,
    eds: _EdsOption = None,
    accept_no_watchdog: _NoWatchdogOption = False,
    restore: Annotated[
        bool, typer.Option("--restore", help="Put back what the set-up changed in the drive.")
    ] = False,
) -> int:
    """Render the wall: enable the drive, run, record, disable it again.

    Several files: as many drives on one bus, each with its wall, on one SYNC. --law also ends the
    changes of law that the file schedules.
    """
    files = config_files or [config.shipped("config/sim.toml")]
    overrides = {
        "wall__law": law and absolute_law(law, Path()),
        "wall__stiffness_nm_per_rad": stiffness,
        "wall__damping_nm_s_per_rad": damping,
        "run__duration_s": duration,
        "drive__eds": _absolute(eds),
        "drive__accept_no_watchdog": accept_no_watchdog or None,
        "drive__restore": restore or None,
    }
    many = [_run_settings(path, overrides) for path in files]
    from canwall.run import run_together  # numba takes a second to load: not for --help

    with _RunProgress() as shown:
        results = run_together(many, output, shown.report, shown.advance)
    for result in results:
        _console.print(_strike_table(result.summary["strikes"]))
        _console.print(f"record: {result.folder.path}", soft_wrap=True, highlight=False)
        for advice in result.summary["timing"]["advice"] if result is results[0] else ():
            _console.print(advice, soft_wrap=True, highlight=False, markup=False)
        for remark in result.remarks:
            _error(remark)
        for note in result.notes:
            _error(note)
    outcome = results[0].outcome
    for trip in outcome.trips:
        _error(trip)
    if outcome.trips or any(result.notes for result in results):
        return FAILED
    return INTERRUPTED if outcome.interrupted else 0


def _run_settings(path: Path, overrides: dict[str, Any]) -> Settings:
    settings = _settings(path, **overrides)
    if overrides["wall__law"] is not None:
        kept = tuple(change.model_copy(update={"law": None}) for change in settings.schedule)
        settings = settings.model_copy(update={"schedule": kept})
    return settings


@app.command()
def change(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run that goes on.")],
    assignments: Annotated[
        list[str],
        typer.Argument(metavar="KEY=VALUE...", help="stiffness_nm_per_rad=80, limits.torque_nm=1"),
    ],
) -> int:
    """Change the wall of a run while it is rendered; the keys are those of [[schedule]]."""
    from canwall.live import change as post
    from canwall.record import RunFolder

    cycle = post(RunFolder(folder), assignments)
    _console.print(f"in force from cycle {cycle} on", highlight=False)
    return 0


@app.command()
def drive(
    config_file: _ConfigArgument = None,
    real_time: Annotated[
        bool, typer.Option("--real-time", help="Time as measured, not a period per SYNC.")
    ] = False,
    eds: _EdsOption = None,
) -> int:
    """A simulated drive, alone on the bus of CONFIG, until stopped."""
    settings = _settings(config_file, drive__eds=_absolute(eds))
    if real_time and settings.simulation is not None:
        simulation = settings.simulation.model_copy(update={"real_time": True})
        settings = settings.model_copy(update={"simulation": simulation})
    if settings.bus.interface == "virtual":
        raise ConfigError(
            "bus.interface = 'virtual' ends at this process, so nobody could reach the drive; "
            "use 'unixcan' or 'socketcan' (see config/unixcan.toml)"
        )
    from canwall.run import serve_drive, stop_on_signals

    def joined() -> None:
        _console.print(
            f"simulated drive, node {settings.drive.node_id}, "
            f"on {settings.bus.interface} {settings.bus.channel}; Ctrl-C ends it",
            soft_wrap=True,
            highlight=False,
        )

    def reported(fault: str) -> None:
        _console.print(fault, soft_wrap=True, highlight=False, markup=False)

    with stop_on_signals() as stop:
        serve_drive(settings, stop, joined, reported)
    return 0


@app.command()
def doctor(
    config_file: Annotated[Path, typer.Argument(metavar="CONFIG", help="A TOML file.")],
    eds: _EdsOption = None,
    accept_no_watchdog: _NoWatchdogOption = False,
) -> int:
    """Find the drive, show how it would be set up and why, and test its watchdog.

    The drive is enabled with zero torque for the test. What was changed is put back.
    """
    settings = _settings(
        config_file,
        drive__eds=_absolute(eds),
        drive__accept_no_watchdog=accept_no_watchdog or None,
    )
    from canwall.bench import Findings, examine
    from canwall.drive import REQUIRED_OBJECTS
    from canwall.run import on_the_bus

    def announce(what: str) -> None:
        _errors.print(f"doctor: {what}", markup=False)

    findings = Findings()
    try:
        with on_the_bus(settings) as link:
            examine(link, settings, REQUIRED_OBJECTS, announce, findings)
    finally:
        _show_findings(findings)
    return 0 if findings.well else FAILED


@app.command()
def latency(
    config_file: _ConfigArgument = None,
    duration: Annotated[
        float, typer.Option(min=0.1, help="Seconds of each part: idle, and under load.")
    ] = 10.0,
    load: Annotated[
        int | None,
        typer.Option(min=0, help="Processes that compute meanwhile; without: one per core."),
    ] = None,
    threads: Annotated[
        int, typer.Option(min=0, help="Python threads of the same process that compute as well.")
    ] = 0,
    exchange: Annotated[
        str | None, typer.Option(help="native, python-can or auto, instead of bus.exchange.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for picture, histograms and numbers.")
    ] = None,
    eds: _EdsOption = None,
    accept_no_watchdog: _NoWatchdogOption = False,
) -> int:
    """How well the cycle keeps to the clock on the bus of CONFIG, and what cycle is held.

    SYNC, TPDO and RPDO go as in a run, idle and then under load, but the drive is not enabled and
    gets zero torque. What was changed is put back.
    """
    settings = _settings(
        config_file,
        bus__exchange=exchange,
        drive__eds=_absolute(eds),
        drive__accept_no_watchdog=accept_no_watchdog or None,
    )
    from canwall.bench import measure_latency
    from canwall.bench.latency_sheet import lines, write_latency
    from canwall.run import stop_on_signals

    processes = os.cpu_count() or 1 if load is None else load
    with _RunProgress() as shown, stop_on_signals() as stop:
        found = measure_latency(
            settings, duration, processes, threads, stop, shown.report, shown.part
        )
    if found is None:
        raise _InterruptedError("interrupted; the drive is as it was")
    for line in lines(found):
        _console.print(line, soft_wrap=True, highlight=False, markup=False)
    if output is not None:
        for path in write_latency(found, output):
            _console.print(str(path), soft_wrap=True, highlight=False)
    for note in found.notes:
        _error(note)
    _console.print(found.verdict.text, soft_wrap=True, highlight=False, markup=False)
    return 0


def _show_findings(findings: "Findings") -> None:
    """A table for people at a terminal, a line each for everybody else."""
    if not _console.is_terminal:
        for line in findings.lines:
            trouble = "" if line.well else "TROUBLE: "
            _console.print(
                f"{line.section}: {line.what}: {trouble}{line.found}",
                markup=False,
                highlight=False,
                soft_wrap=True,
            )
        return
    table = Table(title="Doctor", title_justify="left")
    for column in ("", "from", "found"):
        table.add_column(column)
    section = ""
    for line in findings.lines:
        style = "" if line.well else "bold red"
        shown = "" if line.section == section else line.section
        table.add_row(*(escape(text) for text in (shown, line.what, line.found)), style=style)
        section = line.section
    if findings.lines:
        _console.print(table)


@app.command()
def sweep(
    config_file: Annotated[Path, typer.Argument(metavar="CONFIG", help="A TOML file.")],
    output: Annotated[Path, typer.Option(metavar="FILE.nc", help="NetCDF file of the result.")],
    law: Annotated[list[str] | None, typer.Option(help="A law; may be repeated.")] = None,
    stiffness: Annotated[
        str | None,
        typer.Option(
            metavar="LO:HI:N", help="K [N·m/rad]; without any, the K-limits are searched."
        ),
    ] = None,
    damping: Annotated[str | None, typer.Option(metavar="LO:HI:N", help="B [N·m·s/rad].")] = None,
    rate: Annotated[str | None, typer.Option(metavar="LO:HI:N", help="Rate [Hz].")] = None,
    operator: Annotated[
        list[str] | None, typer.Option(help="none, finger, grip, hand; may be repeated.")
    ] = None,
    axis: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUES",
            help="Any other axis: a key of the configuration, or delay, counts, torque_step, "
            "model, model_error, servo, speed, phase, start, press, stiffness_normalised, "
            "damping_normalised; VALUES: A,B,C or LO:HI:N.",
        ),
    ] = None,
    through: Annotated[str, typer.Option(help="sim: in memory; bus: by frames.")] = "sim",
    workers: Annotated[int | None, typer.Option(min=1, help="Cores; without: all.")] = None,
    dask: Annotated[str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler.")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a sweep that was interrupted.")
    ] = False,
) -> int:
    """How stiff the wall can be: strikes over any axes, or the K-limit at each of their points."""
    if workers is not None and dask is not None:
        raise InputError("--workers and --dask: keep one; a cluster has workers of its own")
    given: dict[str, object] = {}
    for name, equals, values in (text.partition("=") for text in axis or []):
        if not equals or name in given:
            raise InputError(f"--axis {name}: has to be NAME=VALUES, each name once")
        given[name] = values
    named = {
        "law": law and [absolute_law(name, Path()) for name in law],
        "stiffness": stiffness,
        "damping": damping,
        "rate": rate,
        "operator": operator,
    }
    given |= {name: values for name, values in named.items() if values}
    settings = _settings(config_file)
    from canwall.sweep import make_plan, sweep_table
    from canwall.sweep import sweep as swept

    with _RunProgress() as shown:
        plan = make_plan(settings, given, through)
        try:
            dataset = swept(plan, output, resume, workers, dask, partial(shown.count, "sweeping"))
        except KeyboardInterrupt:
            raise _InterruptedError(f"interrupted; --resume goes on with {output}") from None
    _console.print(sweep_table(dataset))
    _console.print(
        f"{plan.points_in_all} points: {output}; canwall plot {output} draws them",
        soft_wrap=True,
        highlight=False,
    )
    return 0


@app.command()
def plot(
    what: Annotated[
        Path, typer.Argument(metavar="DIR|FILE.nc", help="Folder of a run, or result of a sweep.")
    ],
) -> int:
    """Draw the picture of a recorded run again, or the figures of a sweep."""
    if what.suffix == ".nc":
        from canwall.sweep import read_sweep
        from canwall.sweep.figures import write_sweep_figures

        for picture in write_sweep_figures(read_sweep(what), what.with_suffix("")):
            _console.print(str(picture), soft_wrap=True, highlight=False)
        return 0
    from canwall.plots import plot_run
    from canwall.record import RunFolder

    _console.print(str(plot_run(RunFolder(what))), soft_wrap=True, highlight=False)
    return 0


@app.command()
def ball(
    law: Annotated[str, typer.Option(help="Law of the floor, or 'continuous' for its referent.")],
    output: Annotated[Path, typer.Option(help="CSV file: t, y, v, f.")],
    stiffness: Annotated[float, typer.Option(help="Floor's stiffness K [N/m].")] = 1.0,
    damping: Annotated[float, typer.Option(help="Floor's damping B [N·s/m].")] = 0.0,
    mass: Annotated[float, typer.Option(help="Ball's mass m [kg].")] = 1.0,
    viscous: Annotated[float, typer.Option(help="Ball's viscous damping b [N·s/m].")] = 0.0,
    spring: Annotated[float, typer.Option(help="Spring k_h on the ball [N/m].")] = 0.0,
    gravity: Annotated[float, typer.Option(help="Gravity g [m/s²].")] = 1.0,
    height: Annotated[float, typer.Option(help="Height at the start [m].")] = 1.0,
    speed: Annotated[float, typer.Option(help="Velocity at the start [m/s].")] = 0.0,
    period: Annotated[float, typer.Option(help="Sampling period T [s].")] = 0.1,
    periods: Annotated[int, typer.Option(help="How many periods.")] = 3000,
    deadbeat: Annotated[bool, typer.Option("--deadbeat", help="Add the compensation.")] = False,
    tension: Annotated[str, typer.Option(help="allow, clamp or budget.")] = "allow",
    passivity: Annotated[float, typer.Option(help="Passivity controller's damping.")] = 0.0,
    option: Annotated[list[str] | None, typer.Option(help="Law's option, NAME=VALUE.")] = None,
) -> int:
    """A ball bouncing on a floor that is the wall: exact state, no delay, held force."""
    from canwall.workbench import CONTINUOUS, Ball, bounced, write_ball

    ball = Ball(
        stiffness=stiffness,
        damping=damping,
        mass=mass,
        viscous=viscous,
        spring=spring,
        gravity=gravity,
        height=height,
        speed=speed,
        period=period,
        periods=periods,
        tension=tension,
        passivity=passivity,
    )
    if law == CONTINUOUS and (deadbeat or option or tension != "allow" or passivity):
        raise InputError(
            "--law continuous is no law: it has no --deadbeat, --tension, --passivity, --option"
        )
    name = law if law == CONTINUOUS else absolute_law(law, Path())
    y, v, force = bounced(ball, name, deadbeat, _named_numbers(option or []))
    write_ball(output, ball, y, v, force)
    energy = ball.energy(y, v)
    outside = (y >= 0.0).nonzero()[0]
    end = "never outside"
    if len(outside):
        last = int(outside[-1])
        end = f"{energy[last]:.9g} at the last sample outside (t = {last * period:g})"
    _console.print(
        f"θ = {ball.theta:g}; energy {energy[0]:.9g} at the start, {end}",
        highlight=False,
        soft_wrap=True,
    )
    return 0


def _named_numbers(given: list[str]) -> dict[str, float]:
    numbers = {}
    for text in given:
        name, equals, value = text.partition("=")
        try:
            numbers[name] = float(value)
        except ValueError:
            equals = ""
        if not equals or not math.isfinite(numbers[name]):
            raise InputError(f"--option {text}: has to be NAME=NUMBER")
    return numbers


@app.command()
def figures(
    output: Annotated[Path, typer.Option(help="Folder for pictures, data and index.md.")],
) -> int:
    """The chapter's figures, drawn anew, each beside its data; and all laws compared."""
    from canwall.workbench.figures import write_figures

    with _RunProgress() as shown:
        index = write_figures(output, progress=shown.count)
    _console.print(str(index), soft_wrap=True, highlight=False)
    return 0


class _RunProgress:
    """Progress: what is being done, then seconds of bus time, or steps."""

    def __init__(self) -> None:
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[clock]}"),
            TimeRemainingColumn(),
            console=_errors,
            disable=not _errors.is_terminal,
        )
        self._task = self._progress.add_task("preparing", total=None, clock="")

    def __enter__(self) -> "_RunProgress":
        self._progress.start()
        return self

    def __exit__(self, error: type[BaseException] | None, *exc_info: object) -> None:
        # The line that an error becomes stands alone.
        self._progress.live.transient = error is not None
        self._progress.stop()

    def report(self, what: str) -> None:
        self._progress.update(self._task, description=what)

    def advance(self, now_s: float, end_s: float | None) -> None:
        clock = f"{now_s:.1f} s" if end_s is None else f"{now_s:.1f} of {end_s:g} s"
        self._progress.update(self._task, completed=now_s, total=end_s, clock=clock)

    def part(self, what: str, now_s: float, end_s: float) -> None:
        """So many seconds of so many, of a part that has a name."""
        self.report(what)
        self.advance(now_s, end_s)

    def count(self, what: str, done: int, total: int) -> None:
        """So many steps of so many."""
        clock = f"{done} of {total}"
        self._progress.update(
            self._task, description=what, completed=done, total=total, clock=clock
        )


def _strike_table(strikes: list[dict[str, Any]]) -> Table:
    table = Table(title="Strikes", title_justify="left")
    table.add_column("#", justify="right")
    table.add_column("law", no_wrap=True)
    table.add_column("K\n\\[N·m/rad]", justify="right")
    table.add_column("contacts", justify="right")
    table.add_column("deepest\n\\[mrad]", justify="right")
    table.add_column("energy out\n\\[mJ]", justify="right")
    table.add_column("chatter", no_wrap=True)
    for number, strike in enumerate(strikes, start=1):
        chatter = "no"
        if strike["chatter"]:
            chatter = f"yes, {strike['chatter_frequency_hz']:.0f} Hz"
        table.add_row(
            str(number),
            strike["law"],
            f"{strike['stiffness']:g}",
            str(strike["contacts"]),
            f"{strike['peak_penetration_rad'] * 1e3:.2f}",
            f"{strike['energy_out_j'] * 1e3:z.2f}",
            chatter,
        )
    return table


class _InterruptedError(Exception):
    """Ctrl-C, and what to say of it."""


def _error(text: str) -> None:
    _errors.print(f"canwall: {text}", markup=False)


def main() -> NoReturn:
    """Entry point of the command `canwall`; ends the process with the exit code."""
    sys.exit(guarded(lambda: app(standalone_mode=False)))


def guarded(command: Callable[[], object]) -> int:
    """Every error as one line; a traceback is a bug."""
    try:
        result = command()
    except _InterruptedError as interrupted:
        _error(str(interrupted))
        return INTERRUPTED
    except (KeyboardInterrupt, typer.Abort):
        return INTERRUPTED
    except typer.TyperException as error:
        if text := error.format_message():  # none where the help was shown instead
            _error(text)
        return BAD_INPUT
    except InputError as error:
        _error(str(error))
        return BAD_INPUT
    except (RunFailedError, CanError) as error:
        _error(str(error))
        return FAILED
    return result if isinstance(result, int) else 0
