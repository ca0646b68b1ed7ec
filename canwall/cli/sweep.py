"""Commands for sweeps: `sweep`, and `plot`, which draws what sweeps and runs have left."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from canwall.cli.ending import StoppedError
from canwall.cli.options import settings_from
from canwall.cli.output import ShownProgress, console
from canwall.errors import InputError, RunFailedError


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
    from canwall.config import absolute_law

    named = {
        "law": law and [absolute_law(name, Path()) for name in law],
        "stiffness": stiffness,
        "damping": damping,
        "rate": rate,
        "operator": operator,
    }
    given |= {name: values for name, values in named.items() if values}
    settings = settings_from(config_file)
    from canwall.sweep import make_plan, sweep_table, without_effect
    from canwall.sweep import sweep as swept

    with ShownProgress() as shown:
        plan = make_plan(settings, given, through)
        try:
            dataset = swept(plan, output, resume, workers, dask, partial(shown.count, "sweeping"))
        except KeyboardInterrupt:
            raise StoppedError(f"interrupted; --resume goes on with {output}") from None
        except RunFailedError as error:
            raise RunFailedError(f"{error}; --resume goes on with {output}") from None
    console.print(sweep_table(dataset))
    for line in without_effect(dataset):
        console.print(line, soft_wrap=True, highlight=False)
    console.print(
        f"{plan.points_in_all} points: {output}; canwall plot {output} draws them",
        soft_wrap=True,
        highlight=False,
    )
    return 0


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
            console.print(str(picture), soft_wrap=True, highlight=False)
        return 0
    from canwall.record import RunFolder
    from canwall.record.pictures import plot_run

    console.print(str(plot_run(RunFolder(what))), soft_wrap=True, highlight=False)
    return 0
