"""Execution of a plan: compute the missing pieces, journal each one, write the result."""

from collections.abc import Callable
from pathlib import Path

import xarray as xr

from canwall.sweep.dataset import assemble_dataset, check_name, plan_json, write_sweep
from canwall.sweep.journal import Journal
from canwall.sweep.plan import Plan
from canwall.sweep.workers import compute_pieces


def sweep(
    plan: Plan,
    output: Path,
    resume: bool = False,
    workers: int | None = None,
    dask: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> xr.Dataset:
    """Compute the plan and write the result as NetCDF; the numbers depend on the plan alone.

    Args:
        plan: What to compute.
        output: Path of the result. Pieces that are done are kept next to it until it is written.
        resume: Continue an interrupted sweep of the same plan.
        workers: Number of cores; None: all.
        dask: Address of a Dask scheduler, instead of this machine's cores.
        progress: Called with the pieces of work done and their total.

    Returns:
        The result, as written.

    Raises:
        InputError: If the files or the scheduler cannot be used; nothing is computed then.
        RunFailedError: If the cluster fails, or a law does not return.
    """
    check_name(output)
    journal = Journal(output, plan_json(plan), resume)
    try:
        done = set(journal.done())
        missing = [piece for piece in range(plan.pieces) if piece not in done]
        progress(len(done), plan.pieces)
        found = compute_pieces(plan, missing, workers, dask)
        for count, (piece, array) in enumerate(found, start=len(done) + 1):
            journal.put(piece, array)
            progress(count, plan.pieces)
        pieces = {piece: journal.get(piece, plan.dtype) for piece in range(plan.pieces)}
        dataset = assemble_dataset(plan, pieces)
        write_sweep(dataset, output)
        journal.remove()
    except BaseException:
        # A journal without a piece would only stand in the way of the next attempt.
        if not journal.done():
            journal.remove()
        raise
    finally:
        journal.close()
    return dataset
