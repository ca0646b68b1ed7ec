"""Commands for sweeps: `sweep`, and `plot`, which draws recorded runs and sweeps."""

import tempfile
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from canwall.cli.ending import StoppedError
from canwall.cli.options import (
    ConfigArgument,
    JsonOption,
    LawsOption,
    file_path,
    refuse_what_exists,
    settings_from,
)
from canwall.cli.output import ProgressDisplay, console, print_json, print_text, say
from canwall.errors import InputError, RunFailedError
from canwall.extras import need

if TYPE_CHECKING:
    from xarray import Dataset


def sweep(
    config_file: ConfigArgument = None,
    output: Annotated[
        Path | None,
        typer.Option(metavar="FILE.nc", parser=file_path, help="NetCDF file of the result."),
    ] = None,
    law: LawsOption = None,
    stiffness: Annotated[
        str | None,
        typer.Option(
            metavar="LO:HI:N", help="K [N·m/rad]; without any, the K-limits are searched."
        ),
    ] = None,
    damping: Annotated[str | None, typer.Option(metavar="LO:HI:N", help="B [N·m·s/rad].")] = None,
    rate: Annotated[str | None, typer.Option(metavar="LO:HI:N", help="Rate [Hz].")] = None,
    operator: Annotated[
        list[str] | None,
        typer.Option(help="none, fingertip, finger, grip, hand, arm; may be repeated."),
    ] = None,
    axis: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUES",
            help="Any other axis: a key of the configuration, or delay, counts, torque_step, "
            "model, model_error, delay_error, servo, friction, breakaway, speed, phase, start, "
            "press, press_torque, sync_jitter, stiffness_normalised, damping_normalised; "
            "VALUES: A,B,C or LO:HI:N.",
        ),
    ] = None,
    through: Annotated[str, typer.Option(help="sim: in memory; bus: by frames.")] = "sim",
    workers: Annotated[int | None, typer.Option(min=1, help="Cores; without: all.")] = None,
    dask: Annotated[str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler.")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue a sweep that was interrupted.")
    ] = False,
    table: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Print a Markdown table: laws (K-limits), cap, bench, first-strike, or shaft; for "
            "laws (--law) and operators (--operator; without: all). Its other axes are fixed; "
            "[sweep] of CONFIG is ignored. With --output, the result is written as well.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> int:
    """Sweep strikes over any axes and judge each wall, or search the K-limit at each point."""
    if workers is not None and dask is not None:
        raise InputError("--workers and --dask: keep one; a cluster has workers of its own")
    need("sweep", *(["dask"] if dask is not None else []))
    from canwall.config import absolute_law

    laws = [absolute_law(name, Path()) for name in law or []]
    if table is not None:
        unused = {
            "--stiffness": stiffness,
            "--damping": damping,
            "--rate": rate,
            "--axis": axis,
            "--resume": resume,
        }
        if given := ", ".join(option for option, value in unused.items() if value or value == ""):
            raise InputError(f"--table has fixed axes: leave out {given}")
        compute = partial(_compute_law_table, config_file, table, output, laws, operator)
        dataset = compute(through, workers, dask)
        from canwall.sweep import format_law_table

        if as_json:
            print_json(dataset.to_dict())
        else:
            print_text(format_law_table(dataset))
        return 0
    if output is None:
        raise InputError("--output is missing: give the FILE.nc of the result")
    axes = _parse_axes(axis or [])
    options = {
        "law": laws or None,
        "stiffness": stiffness,
        "damping": damping,
        "rate": rate,
        "operator": operator,
    }
    by_option = {name: values for name, values in options.items() if values is not None}
    if twice := [name for name in by_option if name in axes]:
        raise InputError(f"--{twice[0]} and --axis {twice[0]}: keep one of them")
    axes |= by_option
    settings = settings_from(config_file)
    from canwall.sweep import how_to_go_on, ineffective_axis_notes, make_plan, sweep_table
    from canwall.sweep import sweep as run_sweep

    with ProgressDisplay() as display:
        plan = make_plan(settings, axes, through)
        progress = partial(display.count, "sweeping")
        try:
            dataset = run_sweep(plan, output, resume, workers, dask, progress)
        except KeyboardInterrupt:
            raise StoppedError(f"interrupted{how_to_go_on(output)}") from None
        except RunFailedError as error:
            raise RunFailedError(f"{error}{how_to_go_on(output)}") from None
    if as_json:
        print_json(dataset.to_dict())
        return 0
    console.print(sweep_table(dataset))
    for note in ineffective_axis_notes(dataset):
        console.print(note, soft_wrap=True, highlight=False)
    # A single stiffness makes no figure.
    drawable = plan.stiffness is None or len(plan.stiffness.values) > 1
    drawn = f"; canwall plot {output} draws them" if drawable else ""
    console.print(
        f"{plan.point_count} points: {output}{drawn}",
        soft_wrap=True,
        highlight=False,
    )
    return 0


def _parse_axes(assignments: list[str]) -> dict[str, object]:
    """Split NAME=VALUES of --axis."""
    axes: dict[str, object] = {}
    for name, equals, values in (text.partition("=") for text in assignments):
        if not equals or name in axes:
            raise InputError(f"--axis {name}: has to be NAME=VALUES, each name once")
        axes[name] = values
    return axes


def _compute_law_table(
    config_file: Path | None,
    table: str,
    output: Path | None,
    laws: list[str],
    operators: list[str] | None,
    through: str,
    workers: int | None,
    dask: str | None,
) -> "Dataset":
    settings = settings_from(config_file)
    from canwall.sweep import OPERATORS, check_name, compute_law_table, write_sweep

    if output is not None:
        check_name(output)
        refuse_what_exists(output)
        _refuse_unwritable(output)
    with ProgressDisplay() as display:
        progress = partial(display.count, "striking walls")
        operators = operators or list(OPERATORS)
        dataset = compute_law_table(
            table, settings, laws, operators, through, workers, dask, progress
        )
    if output is not None:
        write_sweep(dataset, output)
    return dataset


def _refuse_unwritable(output: Path) -> None:
    """Raise InputError unless a file can be made there: a table takes long."""
    try:
        with tempfile.TemporaryFile(dir=output.parent):
            pass
    except OSError as error:
        raise InputError(f"{output}: cannot be written: {error.strerror}") from None


def plot(
    what: Annotated[
        Path, typer.Argument(metavar="DIR|FILE.nc", help="Folder of a run, or result of a sweep.")
    ],
) -> int:
    """Draw the picture of a recorded run again, or the figures of a sweep.

    The folder of a run that did not end by itself is completed from its rows first.
    """
    if what.suffix == ".nc":
        need("plot", "sweep")
        from canwall.sweep import read_sweep
        from canwall.sweep.figures import write_sweep_figures

        for picture in write_sweep_figures(read_sweep(what), what.with_suffix("")):
            console.print(str(picture), soft_wrap=True, highlight=False)
        return 0
    need("plot")
    from canwall.record import RunFolder
    from canwall.record.pictures import DRAWN, draw_run
    from canwall.run import read_run

    folder = RunFolder(what)
    recorded = read_run(folder, DRAWN)
    if recorded.remark:
        say(recorded.remark)
    picture = draw_run(folder.picture, recorded.signals, recorded.summary["strikes"])
    console.print(str(picture), soft_wrap=True, highlight=False)
    return 0
