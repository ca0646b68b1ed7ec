"""Commands that examine a bench before a wall is rendered on it: `doctor`, `latency`."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from canwall.cli.ending import FAILED, StoppedError, failed_if
from canwall.cli.options import (
    ConfigArgument,
    EdsOption,
    NoWatchdogOption,
    absolute_path,
    settings_from,
)
from canwall.cli.output import ProgressDisplay, console, errors
from canwall.stopping import stop_on_signals

if TYPE_CHECKING:
    from canwall.bench import Findings


def doctor(
    config_file: Annotated[Path, typer.Argument(metavar="CONFIG", help="A TOML file.")],
    eds: EdsOption = None,
    accept_no_watchdog: NoWatchdogOption = False,
) -> int:
    """Find the drive, show how it would be set up and why, and test its watchdog.

    The drive is enabled with zero torque for the test. All changes are undone.
    """
    settings = settings_from(
        config_file,
        drive__eds=absolute_path(eds),
        drive__accept_no_watchdog=accept_no_watchdog or None,
    )
    from canwall.bench import Findings, examine
    from canwall.drive import REQUIRED_OBJECTS
    from canwall.run import on_the_bus

    def announce(step: str) -> None:
        errors.print(f"doctor: {step}", markup=False)

    findings = Findings()
    try:
        with on_the_bus(settings) as link:
            examine(link, settings, REQUIRED_OBJECTS, announce, findings)
    finally:
        _print_findings(findings)
    return 0 if findings.well else FAILED


def latency(
    config_file: ConfigArgument = None,
    duration: Annotated[
        float, typer.Option(min=0.1, help="Seconds of each phase: idle, and under load.")
    ] = 10.0,
    load: Annotated[
        int | None,
        typer.Option(min=0, help="Busy processes of the load; without: one per core."),
    ] = None,
    threads: Annotated[
        int, typer.Option(min=0, help="Busy Python threads in the process of the cycle.")
    ] = 0,
    exchange: Annotated[
        str | None, typer.Option(help="native, python-can or auto, instead of bus.exchange.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for picture, histograms and numbers.")
    ] = None,
    eds: EdsOption = None,
    accept_no_watchdog: NoWatchdogOption = False,
) -> int:
    """Measure the timing of the cycle on the bus of CONFIG, and the shortest cycle it can hold.

    SYNC, TPDO and RPDO are exchanged as in a run, idle and then under load, but the drive is not
    enabled and gets zero torque. All changes are undone.
    """
    settings = settings_from(
        config_file,
        bus__exchange=exchange,
        drive__eds=absolute_path(eds),
        drive__accept_no_watchdog=accept_no_watchdog or None,
    )
    from canwall.bench import measure_latency
    from canwall.bench.latency_report import report_lines, write_latency

    processes = os.cpu_count() or 1 if load is None else load
    with ProgressDisplay() as display, stop_on_signals() as stop:
        measured = measure_latency(
            settings, duration, processes, threads, stop, display.report, display.phase
        )
    if measured is None:
        raise StoppedError("interrupted; the drive is as it was before")
    failed = failed_if(measured.not_restored)
    for line in report_lines(measured):
        console.print(line, soft_wrap=True, highlight=False, markup=False)
    if output is not None:
        for path in write_latency(measured, output):
            console.print(str(path), soft_wrap=True, highlight=False)
    console.print(measured.shortest_cycle.text, soft_wrap=True, highlight=False, markup=False)
    return failed


def _print_findings(findings: "Findings") -> None:
    """Print a table on a terminal, otherwise a line for each finding."""
    if not console.is_terminal:
        for line in findings.lines:
            trouble = "" if line.well else "TROUBLE: "
            console.print(
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
        heading = "" if line.section == section else line.section
        table.add_row(*(escape(text) for text in (heading, line.what, line.found)), style=style)
        section = line.section
    if findings.lines:
        console.print(table)
