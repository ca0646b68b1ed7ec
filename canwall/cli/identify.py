"""Command that finds out what a servo and its operator are like: `identify`."""

import gc
from pathlib import Path
from typing import Annotated

import typer

from canwall.cli.ending import FAILED, failed_if
from canwall.cli.options import (
    ConfigArgument,
    EdsOption,
    JsonOption,
    NoWatchdogOption,
    absolute_path,
    folder_path,
    settings_from,
)
from canwall.cli.output import ProgressDisplay, console, print_json, say
from canwall.errors import InputError
from canwall.extras import how_to_install, is_installed
from canwall.stopping import INTERRUPTED, stop_on_signals


def identify(
    config_file: ConfigArgument = None,
    hand: Annotated[
        bool, typer.Option("--hand", help="Identify the person holding the handle.")
    ] = False,
    inertia: Annotated[
        float | None,
        typer.Option(
            min=1e-9, max=1e3, help="True inertia [kg·m²], for the scale of the torque constant."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(metavar="DIR", parser=folder_path, help="Folder of the record and report."),
    ] = None,
    eds: EdsOption = None,
    accept_no_watchdog: NoWatchdogOption = False,
    as_json: JsonOption = False,
) -> int:
    """Measure inertia, friction, cogging, delay, current loop and shaft of the free handle.

    The handle moves to and fro within the limits of CONFIG for about 40 s: keep clear of it.
    Ctrl-C ends it at any time. With --hand hold the handle still for 12 s. A simulated hand lets
    the handle go, or holds it still.
    """
    if hand and inertia is not None:
        raise InputError("--inertia is that of the free handle; leave it out with --hand")
    settings = settings_from(
        config_file,
        drive__eds=absolute_path(eds),
        drive__accept_no_watchdog=accept_no_watchdog or None,
    )
    with stop_on_signals(held=False) as stop:
        with ProgressDisplay() as display:
            from canwall.identify import identify as measure
            from canwall.identify import (
                json_content,
                refuse_report,
                report_lines,
                toml_fragment,
                with_simulated_hand_still,
                write_report,
            )

            if output is not None:
                refuse_report(output)
            if (
                settings.embedded
                and (still := with_simulated_hand_still(settings, hand)) != settings
            ):
                does = "holds the handle still" if hand else "lets the handle go"
                say(f"the simulated hand {does}, whatever [simulation.hand] says")
                settings = still
            gc.freeze()  # modules stay; the collector need not visit them
            found = measure(settings, output, hand, display.report, display.advance)
        result = found.result
        for trip in result.outcome.trips:
            say(trip)
        told = found.servo is not None or found.hand is not None
        if told:
            write_report(found, settings, inertia)
        if as_json:
            found_content = json_content(found) if told else {}
            print_json({"record": result.folder.path} | found_content)
        else:
            if told:
                for line in report_lines(found, settings, inertia):
                    console.print(line, soft_wrap=True, highlight=False)
                if fragment := toml_fragment(found):
                    console.print(f"\n{fragment}", soft_wrap=True, highlight=False)
            console.print(f"record: {result.folder.path}", soft_wrap=True, highlight=False)
        if told and not is_installed("plot"):
            say(f"no picture: {how_to_install('plot')}")
        for remark in result.remarks:
            say(remark)
        if failed_if((*result.not_restored, *result.notes)):
            return FAILED
        if result.outcome.interrupted or stop():
            say("interrupted; the drive is disabled")
            return INTERRUPTED
        return 0 if told else FAILED
