"""Commands that render walls: `run`, `change` during a run, and the simulated `drive`."""

import contextlib
import gc
import json
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any

import typer
from rich import box
from rich.table import Table

from canwall.cli.completion import complete_config, complete_law
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
from canwall.errors import ConfigError
from canwall.extras import need
from canwall.stopping import INTERRUPTED, stop_on_signals

if TYPE_CHECKING:
    from canwall.config import Settings
    from canwall.run import RunResult


def run(
    config_files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="CONFIG",
            help="TOML files, one for each drive on the bus; without: config/sim.toml.",
            autocompletion=complete_config,
        ),
    ] = None,
    law: Annotated[
        str | None, typer.Option(help="Law of the wall.", autocompletion=complete_law)
    ] = None,
    stiffness: Annotated[float | None, typer.Option(help="Stiffness [N·m/rad].")] = None,
    damping: Annotated[float | None, typer.Option(help="Damping [N·m·s/rad].")] = None,
    duration: Annotated[float | None, typer.Option(help="Seconds; without: until Ctrl-C.")] = None,
    output: Annotated[
        Path | None,
        typer.Option(metavar="DIR", parser=folder_path, help="Folder of the run's record."),
    ] = None,
    eds: EdsOption = None,
    accept_no_watchdog: NoWatchdogOption = False,
    restore: Annotated[
        bool, typer.Option("--restore", help="Put back what the set-up changed in the drive.")
    ] = False,
    stream: Annotated[
        str | None,
        typer.Option(
            metavar="udp://HOST:PORT",
            help="Send every cycle there as JSON, for PlotJuggler; without HOST: this machine.",
        ),
    ] = None,
    panel: Annotated[
        bool, typer.Option("--panel", help="Show the run in the browser (`canwall panel`).")
    ] = False,
    panel_port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of --panel; 0: a free one.")
    ] = 0,
    as_json: JsonOption = False,
) -> int:
    """Render the wall: enable the drive, run, record, disable it again.

    Several files: as many drives on one bus, each with its wall, on one SYNC. With --law, changes
    of law in [[schedule]] are skipped.
    """
    from canwall import config

    if panel:
        need("panel")
    files = config_files or [config.shipped("config/sim.toml")]
    overrides = {
        "wall__law": law and config.absolute_law(law, Path()),
        "wall__stiffness_nm_per_rad": stiffness,
        "wall__damping_nm_s_per_rad": damping,
        "run__duration_s": duration,
        "drive__eds": absolute_path(eds),
        "drive__accept_no_watchdog": accept_no_watchdog or None,
        "drive__restore": restore or None,
    }
    many = [_run_settings(path, overrides) for path in files]
    from canwall.record import start_recorders

    with stop_on_signals(held=False) as stop:
        with ProgressDisplay() as display, start_recorders(len(many)) as recorders:
            from canwall.run import run_together  # while the writers of the record start

            gc.freeze()  # modules stay; the collector need not visit them
            results = run_together(
                many,
                recorders,
                output,
                display.report,
                display.advance,
                stream=stream,
                live=partial(_open_panel, panel_port) if panel else lambda folder: None,
            )
        code = _tell(results, as_json)
        if code == 0 and (stop() or results[0].outcome.interrupted):
            # Here, where signals are still held.
            say("interrupted; the drive is disabled")
            return INTERRUPTED
        return code


def _open_panel(port: int, folder: Path) -> None:
    """Open the panel of a run in a process of its own, which Ctrl-C for this one does not reach.

    Its address goes to standard error, since the result of a run may be read from standard output.
    """
    words = [sys.executable, "-m", "canwall", "panel", str(folder), "--port", str(port)]
    words.append("--with-run")
    try:
        subprocess.Popen(
            words, stdin=subprocess.DEVNULL, stdout=sys.stderr.fileno(), start_new_session=True
        )
    except OSError as error:
        say(f"the panel does not start: {error}; canwall panel {folder} opens it")


def _tell(results: "Sequence[RunResult]", as_json: bool) -> int:
    """Print what came of the walls; return the exit code but for Ctrl-C."""
    code = 0
    for result in results:
        if as_json:
            print_json({"record": result.folder.path} | result.summary)
        else:
            strikes = result.summary["strikes"]
            console.print(_strike_table(strikes) if strikes else "No strike: nothing has pressed.")
            console.print(f"record: {result.folder.path}", soft_wrap=True, highlight=False)
            for advice in result.summary["timing"]["advice"] if result is results[0] else ():
                console.print(advice, soft_wrap=True, highlight=False)
        for remark in result.remarks:
            say(remark)
        code |= failed_if((*result.not_restored, *result.notes))
    outcome = results[0].outcome
    for trip in outcome.trips:
        say(trip)
    if outcome.error is not None:
        raise outcome.error
    if outcome.trips:
        return FAILED
    return code


def _run_settings(path: Path, overrides: dict[str, Any]) -> "Settings":
    settings = settings_from(path, **overrides)
    return settings.without_replacements(law=overrides["wall__law"] is not None)


def change(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run in progress.")],
    assignments: Annotated[
        list[str],
        typer.Argument(metavar="KEY=VALUE", help="stiffness_nm_per_rad=80, limits.torque_nm=1"),
    ],
    as_json: JsonOption = False,
) -> int:
    """Change the wall of a run in progress; the keys are those of [[schedule]]."""
    from canwall.record import RunFolder
    from canwall.run.changes import post_change

    cycle = post_change(RunFolder(folder), assignments)
    if as_json:
        print_json({"cycle": cycle})
    else:
        console.print(f"in force from cycle {cycle} on", highlight=False)
    return 0


def drive(
    config_file: ConfigArgument = None,
    real_time: Annotated[
        bool, typer.Option("--real-time", help="Run by the clock instead of one period per SYNC.")
    ] = False,
    eds: EdsOption = None,
    ready_fd: Annotated[
        int | None,
        typer.Option(
            "--ready-fd", metavar="N", help="Write a line to this descriptor when ready; close it."
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print what happens as JSON, a line for each event.")
    ] = False,
) -> int:
    """Simulate a drive, alone on the bus of CONFIG, until stopped."""
    gc.disable()  # nothing of what is imported now is garbage; it takes a fifth longer
    settings = settings_from(config_file, drive__eds=absolute_path(eds))
    if real_time and settings.simulation is not None:
        simulation = settings.simulation.model_copy(update={"real_time": True})
        settings = settings.model_copy(update={"simulation": simulation})
    if settings.bus.interface == "virtual":
        raise ConfigError(
            "bus.interface = 'virtual' ends at this process, so no master could reach the drive; "
            "use 'unixcan' or 'socketcan' (see config/unixcan.toml)"
        )
    ready = None if ready_fd is None else _opened(ready_fd)
    from canwall.library.simulated_drive import SimulatedDrive

    def tell(line: str, event: str, **more: Any) -> None:
        if as_json:
            line = json.dumps({"event": event} | more, ensure_ascii=False)
        console.print(line, soft_wrap=True, highlight=False)

    def report(line: str) -> None:
        tell(line, "report", text=line)

    with (
        stop_on_signals() as stop,
        SimulatedDrive.from_settings(settings, report) as simulated,
    ):
        tell(
            f"simulated drive, node {simulated.node_id}, "
            f"on {simulated.interface} {simulated.channel}; Ctrl-C ends it",
            "ready",
            node_id=simulated.node_id,
            interface=simulated.interface,
            channel=simulated.channel,
            eds=str(simulated.eds),
        )
        gc.freeze()
        gc.enable()
        if ready is not None:
            _notify(ready)
        simulated.wait_until(stop, timeout_s=None)
    return 0


def _opened(descriptor: int) -> IO[bytes]:
    """Return a descriptor that the process was started with, to be written to."""
    try:
        return open(descriptor, "wb", buffering=0)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise ConfigError(
            f"--ready-fd {descriptor}: {why}; start the command with this descriptor open for "
            f"writing"
        ) from None


def _notify(ready: IO[bytes]) -> None:
    """Write the line that says that the drive is ready, if anybody still waits for it."""
    with contextlib.suppress(OSError), ready:
        ready.write(b"ready\n")


def _strike_table(strikes: list[dict[str, Any]]) -> Table:
    # At most eleven columns in a terminal of 80 characters; a long name of a law is folded.
    from canwall.config import short_law

    finds = any(_is_found(strike) for strike in strikes)
    title = "Strikes, K in N·m/rad" if finds else "Strikes"
    table = Table(title=title, title_justify="left", box=box.SIMPLE, padding=0, show_edge=not finds)
    headings = [
        "#",
        "law",
        "K\nasked" if finds else "K\n[N·m/rad]",
        *(["in\nforce", "mass\n[g·m²]"] if finds else []),
        "con-\ntacts" if finds else "contacts",
        "depth\n[mrad]" if finds else "deepest\n[mrad]",
        "first\n÷ ref.",
        "energy\n[mJ]" if finds else "energy\nout [mJ]",
        "ripple\n[N]",
        "chatter",
    ]
    for heading in headings:
        is_law, is_text = heading == "law", heading in ("law", "chatter")
        table.add_column(
            heading,
            justify="left" if is_text else "right",
            no_wrap=not is_law,
            overflow="fold" if is_law else "ellipsis",
        )
    for count, strike in enumerate(strikes, start=1):
        chatter = "no"
        if strike["chatter"]:
            frequency = strike["chatter_frequency_hz"]
            chatter = f"yes, {frequency:.0f} Hz" if frequency else "yes"
        table.add_row(
            str(count),
            short_law(strike["law"]),
            f"{strike['stiffness']:g}",
            *(_found(strike) if finds else ()),
            str(strike["contacts"]),
            f"{strike['peak_penetration_rad'] * 1e3:z.2f}",
            _depth_ratio(strike),
            f"{strike['energy_out_j'] * 1e3:z.2f}",
            "–" if strike["felt_ripple_n"] is None else f"{strike['felt_ripple_n']:.2f}",
            chatter,
        )
    return table


def _is_found(strike: dict[str, Any]) -> bool:
    """Return True if the cycle has found the mass itself, or lowered the stiffness."""
    asked: float = strike["stiffness"]
    return strike["mass_spread"] > 0.0 or strike["stiffness_in_force_least"] < asked


def _found(strike: dict[str, Any]) -> tuple[str, str]:
    return f"{strike['stiffness_in_force']:.3g}", f"{1e3 * strike['mass_est_kg_m2']:.3g}"


def _depth_ratio(strike: dict[str, Any]) -> str:
    depth, referent = strike["first_depth_rad"], strike["referent_first_depth_rad"]
    return "–" if depth is None or referent is None else f"{depth / referent:.2f}"
