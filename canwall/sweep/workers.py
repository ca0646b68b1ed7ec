"""Who computes the pieces of a sweep: this machine's cores, or a cluster."""

import multiprocessing
import os
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed

from threadpoolctl import threadpool_limits

from canwall.sweep.cluster import on_a_cluster
from canwall.sweep.plan import Found, Plan, compute


def computed(
    plan: Plan, pieces: Sequence[int], workers: int | None = None, dask: str | None = None
) -> Iterator[Found]:
    """The pieces with their numbers, as they are done; ended early, it leaves nothing running.

    workers: how many cores (None: all). dask: address of a scheduler instead. Raises InputError
    where no scheduler is.
    """
    if dask is not None:
        return on_a_cluster(plan, pieces, dask)
    count = workers or len(os.sched_getaffinity(0))
    if plan.through == "bus":
        # Frames are the interpreter's work: only other processes have another one.
        context = multiprocessing.get_context("spawn")
        return _in_a_pool(plan, pieces, ProcessPoolExecutor(count, context, _prepare_process))
    return _in_a_pool(plan, pieces, ThreadPoolExecutor(count))


def _prepare_process() -> None:
    """Ctrl-C is for the process that asked for the work; its cores are for the pieces."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _one_core_each()


def _one_core_each() -> threadpool_limits:
    """BLAS without threads of its own until the context ends, which is not at all if none begins.

    For matrices as small as a strike's they bring nothing, but wait awake on a core afterwards.
    """
    return threadpool_limits(1, user_api="blas")


def _in_a_pool(plan: Plan, pieces: Sequence[int], pool: Executor) -> Iterator[Found]:
    with _one_core_each():
        try:
            jobs = {pool.submit(compute, plan, piece): piece for piece in pieces}
            for job in as_completed(jobs):
                yield jobs[job], job.result()
        finally:
            pool.shutdown(cancel_futures=True)
