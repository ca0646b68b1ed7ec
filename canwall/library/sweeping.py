"""Sweeps and tables of walls from a script or a notebook."""

import os
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from canwall.errors import InputError
from canwall.library.arguments import as_count, as_dict, as_list, as_path, as_text, wrong
from canwall.library.configuration import Config, load
from canwall.library.laws import LawLike, law_name
from canwall.library.progress import Progress
from canwall.sweep import OPERATORS, compute_law_table, make_plan
from canwall.sweep import sweep as run_sweep
from canwall.walls import is_declared

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def sweep(
    config: Config = None,
    axes: Mapping[str, object] | None = None,
    *,
    law: LawLike | Sequence[LawLike] | None = None,
    stiffness: object = None,
    damping: object = None,
    rate: object = None,
    operator: str | Sequence[str] | None = None,
    output: str | os.PathLike[str] | None = None,
    resume: bool = False,
    through: str = "sim",
    workers: int | None = None,
    dask: str | None = None,
    overrides: Mapping[str, Any] | None = None,
    progress: bool = True,
) -> xr.Dataset:
    """Sweep strikes over any axes and judge each wall, or search K-limits (`canwall sweep`).

    Args:
        config: As for `canwall.load`; axes of its `[sweep]` are those that are not given here.
        axes: Values of further axes by name: keys of the configuration, or `delay`, `counts`,
            `speed`, `stiffness_normalised` …, as for `canwall sweep --axis`. Values are an array, a
            single value, or text, "A,B,C" or "LO:HI:N".
        law: Laws.
        stiffness: Stiffnesses [N·m/rad]; without any, the K-limits are searched.
        damping: Dampings [N·m·s/rad].
        rate: Rates of the SYNC [Hz].
        operator: Operators: none, fingertip, finger, grip, hand, arm.
        output: A .nc file to keep the result in, and the finished pieces on the way; None: neither.
        resume: Continue a sweep into `output` that was interrupted.
        through: "sim": strikes in memory; "bus": by frames, in processes of their own (a script
            has to guard its main part by `if __name__ == "__main__"`).
        workers: Number of cores; None: all.
        dask: Address of a Dask scheduler, instead of this machine's cores.
        overrides: Keys of the configuration, as for `canwall.load`.
        progress: Show the progress, in a terminal or a notebook.

    Returns:
        A Dataset with a dimension per axis; every variable has `units` and `long_name`.

    Raises:
        canwall.errors.InputError: For an axis or a value that does not exist, or a file that cannot
            be used.
        canwall.errors.RunFailedError: If a law does not return, or the cluster fails.
    """
    if resume and output is None:
        raise InputError("resume: give the output of the sweep that is to be continued")
    settings = load(config, overrides)
    given = {
        "law": None if law is None else [law_name(one) for one in as_list(law)],
        "stiffness": stiffness,
        "damping": damping,
        "rate": rate,
        "operator": operator,
    }
    further = as_dict("axes", axes)
    for name in further:
        if given.get(name) is not None:
            raise InputError(f"sweep axis {name}: is given twice; keep one")
    given |= further
    workers, dask = _workforce(workers, dask)
    plan = make_plan(
        settings, {name: _plain(v) for name, v in given.items() if v is not None}, through
    )
    if through != "sim" or dask is not None:
        _refuse_declared(value for axis in plan.conditions for value in axis.values)
    with Progress(progress) as display, TemporaryDirectory(prefix="canwall-") as folder:
        return run_sweep(
            plan,
            Path(folder, "sweep.nc") if output is None else as_path("output", output),
            resume,
            workers,
            dask,
            partial(display.count, "sweeping"),
        )


def law_table(
    name: str,
    config: Config = None,
    *,
    law: LawLike | Sequence[LawLike] = (),
    operator: str | Sequence[str] = tuple(OPERATORS),
    through: str = "sim",
    workers: int | None = None,
    dask: str | None = None,
    overrides: Mapping[str, Any] | None = None,
    progress: bool = True,
) -> xr.Dataset:
    """Compute a table of laws and operators (`canwall sweep --table`).

    Args:
        name: laws (K-limits), cap, bench, first-strike, or shaft.
        config: As for `canwall.load`; its `[sweep]` is ignored.
        law: Laws; without any, those of the table.
        operator: Operators.
        through: As for `sweep`.
        workers: As for `sweep`.
        dask: As for `sweep`.
        overrides: As for `sweep`.
        progress: As for `sweep`.

    Returns:
        A Dataset with a dimension per axis; every variable has `units` and `long_name`.

    Raises:
        canwall.errors.InputError: For a table, a law or an operator that does not exist.
    """
    settings = load(config, overrides)
    laws = [law_name(one) for one in as_list(law)]
    workers, dask = _workforce(workers, dask)
    if through != "sim" or dask is not None:
        _refuse_declared(laws)
    with Progress(progress) as display:
        count = partial(display.count, "striking walls")
        return compute_law_table(
            name, settings, laws, as_list(operator), through, workers, dask, count
        )


def sweep_figures(dataset: xr.Dataset) -> "dict[str, Figure]":
    """Draw every figure that the axes of a sweep allow (`canwall plot FILE.nc`).

    Returns:
        The figures by name, "z-width", "energy" …, which notebooks display.

    Raises:
        canwall.errors.InputError: If the sweep has a single stiffness, or for anything else than a
            Dataset.
    """
    if not isinstance(dataset, xr.Dataset):
        raise wrong("dataset", "the Dataset of a sweep (canwall.read has it from a file)", dataset)
    from canwall.library.figures import shown_in_notebooks
    from canwall.sweep.figures import draw_sweep

    return {name: shown_in_notebooks(figure) for name, figure in draw_sweep(dataset)}


def _workforce(workers: object, dask: object) -> tuple[int | None, str | None]:
    """Return the number of cores and the address of a scheduler. Raises ConfigError."""
    return as_count("workers", workers, "a number of cores"), as_text("dask", dask, "an address")


def _plain(values: object) -> object:
    """Return arrays of NumPy, pandas and xarray as lists of Python's numbers."""
    if isinstance(values, list | tuple):
        return [_plain(value) for value in values]
    if isinstance(values, str) or not hasattr(values, "__array__"):
        return values
    return np.asarray(values).tolist()


def _refuse_declared(names: Any) -> None:
    for name in names:
        if isinstance(name, str) and is_declared(name):
            raise InputError(
                f"law {name}: is declared in this process, and others compute; write it into a "
                "file, FILE.py:FUNCTION"
            )
