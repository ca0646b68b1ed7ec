"""A sweep from plan to file: compute what is missing, keep what comes, write the whole."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import xarray as xr

from canwall.errors import InputError
from canwall.sweep.dataset import described, gathered
from canwall.sweep.journal import Journal
from canwall.sweep.plan import Plan
from canwall.sweep.workers import computed

#: What writes and reads NetCDF.
ENGINE: Literal["h5netcdf"] = "h5netcdf"


def sweep(
    plan: Plan,
    output: Path,
    resume: bool = False,
    workers: int | None = None,
    dask: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> xr.Dataset:
    """Compute the plan and write it to `output` (NetCDF); the numbers depend on the plan alone.

    What is done is kept beside it as it comes; resume goes on from there. progress is told pieces
    done and their total. Raises InputError before anything is computed.
    """
    journal = Journal(output, described(plan), resume)
    try:
        done = set(journal.done())
        missing = [piece for piece in range(plan.pieces) if piece not in done]
        progress(len(done), plan.pieces)
        found = computed(plan, missing, workers, dask)
        for count, (piece, array) in enumerate(found, start=len(done) + 1):
            journal.put(piece, array)
            progress(count, plan.pieces)
        whole = gathered(plan, {p: journal.get(p, plan.dtype) for p in range(plan.pieces)})
        _write(whole, output)
        journal.remove()
    except BaseException:
        # Nothing was computed: nothing is left behind.
        if not journal.done():
            journal.remove()
        raise
    finally:
        journal.close()
    return whole


def _write(dataset: xr.Dataset, output: Path) -> None:
    """Whole or not at all."""
    new = output.with_name(output.name + ".new")
    try:
        dataset.to_netcdf(new, engine=ENGINE)
        new.replace(output)
    except OSError as error:
        new.unlink(missing_ok=True)
        raise InputError(f"{output}: cannot be written: {error.strerror or error}") from None


def read_sweep(path: Path) -> xr.Dataset:
    """The result of a sweep. Raises InputError where the file holds none."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the result of a sweep")
    try:
        with xr.open_dataset(path, engine=ENGINE) as stored:
            dataset = stored.load()
    except (OSError, ValueError, KeyError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: no result of a sweep: {reason}") from None
    if "configuration" not in dataset.attrs or "through" not in dataset.attrs:
        raise InputError(f"{path}: no result of a sweep")
    return dataset
