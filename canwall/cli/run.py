"""Commands that render walls: `run`, `change` during a run, and the simulated `drive`."""

import gc
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich import box
from rich.table import Table

from canwall.cli.ending import FAILED, INTERRUPTED, failed_if
from canwall.cli.options import (
    ConfigArgument,
    EdsOption,
    NoWatchdogOption,
    absolute_path,
    settings_from,
)
from canwall.cli.output import ProgressDisplay, console, say
from canwall.errors import ConfigError
from canwall.stopping import stop_on_signals

if TYPE_CHECKING:
    from canwall.config import Settings
    from canwall.run import RunResult


def run(
    config_files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="CONFIG",
            help="TOML files, one for each drive on the bus; without: config/sim.toml.",
        ),
    ] = None,
    law: Annotated[str | None, typer.Option(help="Law of the wall.")] = None,
    stiffness: Annotated[float | None, typer.Option(help="Stiffness [N·m/rad].")] = None,
    damping: Annotated[float | None, typer.Option(help="Damping [N·m·s/rad].")] = None,
    duration: Annotated[float | None, typer.Option(help="Seconds; without: until Ctrl-C.")] = None,
    output: Annotated[Path | None, typer.Option(help="Folder of the run's record.")] = None,
    eds: EdsOption = None,
    accept_no_watchdog: NoWatchdogOption = False,
    restore: Annotated[
        bool, typer.Option("--restore", help="Put back what the set-up changed in the drive.")
    ] = False,
) -> int:
    """Render the wall: enable the drive, run, record, disable it again.

    Several files: as many drives on one bus, each with its wall, on one SYNC. With --law, changes
    of law in [[schedule]] are skipped.
    """
    from canwall import config

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
            results = run_together(many, recorders, output, display.report, display.advance)
        code = _tell(results)
        return INTERRUPTED if code == 0 and stop() else code


def _tell(results: "Sequence[RunResult]") -> int:
    """Print what came of the walls; return the exit code."""
    code = 0
    for result in results:
        console.print(_strike_table(result.summary["strikes"]))
        console.print(f"record: {result.folder.path}", soft_wrap=True, highlight=False)
        for advice in result.summary["timing"]["advice"] if result is results[0] else ():
            console.print(advice, soft_wrap=True, highlight=False, markup=False)
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
    return code or (INTERRUPTED if outcome.interrupted else 0)


def _run_settings(path: Path, overrides: dict[str, Any]) -> "Settings":
    settings = settings_from(path, **overrides)
    if overrides["wall__damping_nm_s_per_rad"] is not None:
        wall = settings.wall.model_copy(update={"damping_ratio": None})
        settings = settings.model_copy(update={"wall": wall})
    if overrides["wall__law"] is not None:
        kept = tuple(change.model_copy(update={"law": None}) for change in settings.schedule)
        settings = settings.model_copy(update={"schedule": kept})
    return settings


def change(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run in progress.")],
    assignments: Annotated[
        list[str],
        typer.Argument(metavar="KEY=VALUE", help="stiffness_nm_per_rad=80, limits.torque_nm=1"),
    ],
) -> int:
    """Change the wall of a run in progress; the keys are those of [[schedule]]."""
    from canwall.record import RunFolder
    from canwall.run.changes import post_change

    cycle = post_change(RunFolder(folder), assignments)
    console.print(f"in force from cycle {cycle} on", highlight=False)
    return 0


def drive(
    config_file: ConfigArgument = None,
    real_time: Annotated[
        bool, typer.Option("--real-time", help="Measured time instead of a period per SYNC.")
    ] = False,
    eds: EdsOption = None,
) -> int:
    """Simulate a drive, alone on the bus of CONFIG, until stopped."""
    settings = settings_from(config_file, drive__eds=absolute_path(eds))
    if real_time and settings.simulation is not None:
        simulation = settings.simulation.model_copy(update={"real_time": True})
        settings = settings.model_copy(update={"simulation": simulation})
    if settings.bus.interface == "virtual":
        raise ConfigError(
            "bus.interface = 'virtual' ends at this process, so no master could reach the drive; "
            "use 'unixcan' or 'socketcan' (see config/unixcan.toml)"
        )
    from canwall.run import serve_drive

    def announce() -> None:
        console.print(
            f"simulated drive, node {settings.drive.node_id}, "
            f"on {settings.bus.interface} {settings.bus.channel}; Ctrl-C ends it",
            soft_wrap=True,
            highlight=False,
        )

    def report(event: str) -> None:
        console.print(event, soft_wrap=True, highlight=False, markup=False)

    with stop_on_signals() as stop:
        serve_drive(settings, stop, announce, report)
    return 0


def _strike_table(strikes: list[dict[str, Any]]) -> Table:
    # At most eleven columns in a terminal of 80 characters.
    finds = any(_is_found(strike) for strike in strikes)
    table = Table(
        title="Strikes", title_justify="left", box=box.SIMPLE, padding=0, show_edge=not finds
    )
    table.add_column("#", justify="right")
    table.add_column("law", no_wrap=True)
    table.add_column("K asked" if finds else "K\n\\[N·m/rad]", justify="right")
    if finds:
        table.add_column("in\nforce", justify="right")
        table.add_column("mass\n\\[g·m²]", justify="right")
    table.add_column("con-\ntacts" if finds else "contacts", justify="right")
    table.add_column("depth\n\\[mrad]" if finds else "deepest\n\\[mrad]", justify="right")
    table.add_column("first\n÷ ref.", justify="right")
    table.add_column("energy\n\\[mJ]" if finds else "energy\nout \\[mJ]", justify="right")
    table.add_column("ripple\n\\[N]", justify="right")
    table.add_column("chatter", no_wrap=True)
    for number, strike in enumerate(strikes, start=1):
        chatter = "no"
        if strike["chatter"]:
            chatter = f"yes, {strike['chatter_frequency_hz']:.0f} Hz"
        table.add_row(
            str(number),
            strike["law"],
            f"{strike['stiffness']:g}",
            *(_found(strike) if finds else ()),
            str(strike["contacts"]),
            f"{strike['peak_penetration_rad'] * 1e3:.2f}",
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
