"""Computation of the pieces of a sweep, on this machine's cores or on a cluster."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    BrokenExecutor,
    Executor,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    as_completed,
)
from functools import partial

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from canwall.errors import InputError, RunFailedError
from canwall.sweep.cluster import compute_on_cluster
from canwall.sweep.plan import PieceResult, Plan, compute_piece


def compute_pieces(
    plan: Plan, pieces: Sequence[int], workers: int | None = None, dask: str | None = None
) -> Iterator[PieceResult]:
    """Yield the pieces with their numbers as they are done; closing it stops the work.

    Args:
        plan: Plan of the sweep.
        pieces: Numbers of the pieces to compute.
        workers: Number of cores; None: all.
        dask: Address of a Dask scheduler, instead of this machine's cores.

    Raises:
        InputError: If there is no scheduler at the address, or nobody to work.
        RunFailedError: If the cluster fails, a process dies, or a law does not return.
    """
    if dask is not None:
        return compute_on_cluster(plan, pieces, dask)
    if workers is not None and workers < 1:
        raise InputError(f"workers = {workers}: has to be at least 1")
    count = workers or len(os.sched_getaffinity(0))
    if plan.through == "bus":
        # Frames are handled by the interpreter, so threads would share one lock.
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(count, context, _init_process)
        return _compute_in_pool(plan, pieces, pool, abandon=partial(_end_processes, pool))
    abandoned = threading.Event()
    compute = partial(compute_piece, is_abandoned=abandoned.is_set)
    return _compute_in_pool(plan, pieces, ThreadPoolExecutor(count), compute, abandoned.set)


def _end_processes(pool: ProcessPoolExecutor) -> None:
    """End the processes of a pool, whatever they compute.

    ProcessPoolExecutor.terminate_workers does so from Python 3.14 on.
    """
    for process in list(pool._processes.values()):
        process.terminate()


def _init_process() -> None:
    """Leave Ctrl-C to the parent process, and the cores to the pieces; end with the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _limit_blas_threads()
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Wait for the end of the parent process, also by SIGKILL, and end this one."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _limit_blas_threads() -> threadpool_limits:
    """Limit BLAS to one thread, until the returned context ends.

    For matrices as small as a strike's its threads gain nothing, and spin on a core afterwards.
    """
    return threadpool_limits(1, user_api="blas")


def _compute_in_pool(
    plan: Plan,
    pieces: Sequence[int],
    pool: Executor,
    compute: Callable[[Plan, int], NDArray[np.void]] = compute_piece,
    abandon: Callable[[], object] = lambda: None,
) -> Iterator[PieceResult]:
    with _limit_blas_threads():
        try:
            jobs = {pool.submit(compute, plan, piece): piece for piece in pieces}
            for job in as_completed(jobs):
                yield jobs[job], job.result()
        except (KeyboardInterrupt, GeneratorExit):
            # A piece may take as long as a slow law likes.
            abandon()
            raise
        except BrokenExecutor:
            raise RunFailedError("a process that computes the sweep has died") from None
        finally:
            pool.shutdown(cancel_futures=True)
