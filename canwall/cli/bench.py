"""Commands that examine a bench before a wall is rendered on it: `doctor`, `latency`."""

import dataclasses
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from canwall.cli.ending import FAILED, StoppedError, failed_if
from canwall.cli.options import (
    ConfigArgument,
    ConfigFile,
    EdsOption,
    JsonOption,
    NoWatchdogOption,
    absolute_path,
    folder_path,
    refuse_to_overwrite,
    settings_from,
)
from canwall.cli.output import ProgressDisplay, console, errors, print_json, say
from canwall.errors import ConfigError
from canwall.extras import how_to_install, is_installed, need
from canwall.stopping import stop_on_signals

if TYPE_CHECKING:
    from canwall.bench import Finding, Findings

#: More busy processes or threads load no machine further; 100,000 take it down.
_MOST_BUSY = 256


def doctor(
    config_file: ConfigFile,
    move: Annotated[
        bool,
        typer.Option("--move", help="Move the handle a little as well, from 1 % torque on."),
    ] = False,
    as_json: JsonOption = False,
    eds: EdsOption = None,
    accept_no_watchdog: NoWatchdogOption = False,
) -> int:
    """Check whether a bench is ready for a wall, and say what to fix.

    Bus, drive, file, units, limits and timing are checked, and the watchdog is tested: the drive is
    enabled with zero torque. All changes are undone.
    """
    settings = settings_from(
        config_file,
        drive__eds=absolute_path(eds),
        drive__accept_no_watchdog=accept_no_watchdog or None,
    )
    from canwall.bench import Findings, diagnose
    from canwall.drive import REQUIRED_OBJECTS

    def announce(step: str) -> None:
        errors.print(f"doctor: {step}")

    findings = Findings()
    try:
        with stop_on_signals(held=False):
            diagnose(settings, REQUIRED_OBJECTS, announce, findings, move)
    finally:
        if not as_json and findings.lines:
            _print_findings(findings)
    if as_json:
        lines = [dataclasses.asdict(line) for line in findings.lines]
        print_json({"ready": findings.well, "findings": lines})
    else:
        _print_verdict(findings, config_file)
    return 0 if findings.well else FAILED


def dbc(
    config_files: Annotated[
        list[Path], typer.Argument(metavar="CONFIG", help="TOML files, one for each drive.")
    ],
    output: Annotated[Path, typer.Option(metavar="FILE", help="The DBC file.")],
) -> int:
    """Write a DBC file: names, scales and units of the PDOs as a run maps them.

    The drives are set up as for a run, but not enabled, and put back.
    """
    need("dbc")
    refuse_to_overwrite(output)
    many = [settings_from(path) for path in config_files]
    from canwall.bench.dbc import dbc_text, mapped_drive
    from canwall.drive import REQUIRED_OBJECTS
    from canwall.run import check_together, on_the_bus

    check_together(many)
    with stop_on_signals(held=False), on_the_bus(*many) as link:
        drives = [mapped_drive(link, settings, REQUIRED_OBJECTS) for settings in many]
    text = dbc_text(drives)
    try:
        # The encoding and the line ends of a DBC are those of Windows.
        output.write_text(text, encoding="cp1252", errors="replace", newline="")
    except OSError as error:
        raise ConfigError(f"{output}: cannot be written: {error.strerror}") from None
    console.print(f"written: {output}", soft_wrap=True, highlight=False)
    return 0


def latency(
    config_file: ConfigArgument = None,
    duration: Annotated[
        float, typer.Option(min=0.1, max=1e6, help="Seconds of each phase: idle, and under load.")
    ] = 10.0,
    load: Annotated[
        int | None,
        typer.Option(
            min=0, max=_MOST_BUSY, help="Busy processes of the load; without: one per core."
        ),
    ] = None,
    threads: Annotated[
        int,
        typer.Option(
            min=0, max=_MOST_BUSY, help="Busy Python threads in the process of the cycle."
        ),
    ] = 0,
    exchange: Annotated[
        str | None, typer.Option(help="native, python-can or auto, instead of bus.exchange.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", parser=folder_path, help="Folder for picture, histograms and numbers."
        ),
    ] = None,
    eds: EdsOption = None,
    accept_no_watchdog: NoWatchdogOption = False,
    as_json: JsonOption = False,
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
    from canwall.bench.latency_report import (
        json_content,
        prepare_folder,
        report_lines,
        write_latency,
    )

    if output is not None:
        prepare_folder(output)
    processes = os.cpu_count() or 1 if load is None else load
    with ProgressDisplay() as display, stop_on_signals() as stop:
        measured = measure_latency(
            settings, duration, processes, threads, stop, display.report, display.phase
        )
    if measured is None:
        raise StoppedError("interrupted; the drive is as it was before")
    failed = failed_if(measured.not_restored)
    if as_json:
        print_json(json_content(measured))
    else:
        for line in report_lines(measured):
            console.print(line, soft_wrap=True, highlight=False)
    try:
        if output is not None:
            for path in write_latency(measured, output):
                if not as_json:
                    console.print(str(path), soft_wrap=True, highlight=False)
            if not is_installed("plot"):
                say(f"no picture: {how_to_install('plot')}")
    finally:
        if not as_json:
            console.print(measured.shortest_cycle.text, soft_wrap=True, highlight=False)
    return failed


def _print_findings(findings: "Findings") -> None:
    """Print a table on a terminal, otherwise a line for each finding."""
    if not console.is_terminal:
        for line in findings.lines:
            trouble = "" if line.well else "TROUBLE: "
            console.print(
                f"{line.section}: {line.what}: {trouble}{line.found}{_to_do(line)}",
                highlight=False,
                soft_wrap=True,
            )
        return
    table = Table(title="Doctor", title_justify="left")
    for column in ("", "checked", "found", "to do"):
        table.add_column(column)
    section = ""
    for line in findings.lines:
        style = "" if line.well else "bold red"
        heading = "" if line.section == section else line.section
        cells = (heading, line.what, line.found, line.do)
        table.add_row(*cells, style=style)
        section = line.section
    console.print(table)


def _print_verdict(findings: "Findings", config_file: Path) -> None:
    if findings.well:
        lines = [f"ready: canwall run {config_file}"]
    else:
        lines = ["not ready; to mend:"]
        for number, line in enumerate(findings.troubles, start=1):
            lines.append(f"{number:2}. {line.section}, {line.what}: {line.found}{_to_do(line)}")
    for text in lines:
        console.print(text, highlight=False, soft_wrap=True)


def _to_do(line: "Finding") -> str:
    return f" → {line.do}" if line.do else ""
