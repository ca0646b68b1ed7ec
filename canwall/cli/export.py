"""Command that writes records in formats of other programs: `export`."""

from pathlib import Path
from typing import Annotated

import typer

from canwall.cli.output import console, say
from canwall.errors import InputError


def export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run.")],
    csv: Annotated[
        bool, typer.Option("--csv", help="signals.csv and strikes.csv, for a spreadsheet.")
    ] = False,
    mat: Annotated[bool, typer.Option("--mat", help="run.mat, for MATLAB and Octave.")] = False,
) -> int:
    """Write a recorded run, with units, into its folder for other programs.

    Sweeps are NetCDF files, which they read as they are.
    """
    if not (csv or mat):
        raise InputError("export: give --csv, --mat, or both")
    from canwall.library.recorded import RecordedRun

    run = RecordedRun.read(folder)
    for remark in run.remarks:
        say(remark)
    for path in [*(run.to_csv() if csv else []), *([run.to_mat()] if mat else [])]:
        console.print(str(path), soft_wrap=True, highlight=False)
    return 0
