"""The pieces of a sweep on a Dask cluster, and what can be wrong with one."""

import asyncio
import logging
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canwall.errors import InputError, RunFailedError
from canwall.sweep.dataset import versions
from canwall.sweep.plan import Found, Plan, compute

#: How long to wait for a scheduler to be there, and to answer [s].
_THERE_S, _PATIENCE_S = 3.0, 10.0


def on_a_cluster(plan: Plan, pieces: Sequence[int], address: str) -> Iterator[Found]:
    """The pieces with their numbers, as they are done by the workers of the scheduler there.

    Raises InputError where there is none; RunFailedError where it goes, or where scheduler or
    workers have not the software that is here.
    """
    try:
        import distributed
    except ImportError:
        raise InputError("--dask needs dask.distributed: install canwall[dask]") from None
    # What they have to say comes as an exception too, or has been put right, as where a worker died
    # with a result. Some have levels of their own.
    for name in list(logging.root.manager.loggerDict):
        if name.partition(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL)
    client = _connected(address)
    try:
        # What is still to be done when the client leaves, nobody wants any more: it is dropped.
        with client:
            jobs = {
                client.submit(_compute_there, versions(), plan, piece, pure=False, retries=2): piece
                for piece in pieces
            }
            for job in distributed.as_completed(list(jobs), loop=client.loop):
                yield jobs[job], job.result()
                job.release()
    except (CancelledError, distributed.comm.CommClosedError):
        raise RunFailedError(f"--dask {address}: the scheduler is gone") from None
    except distributed.KilledWorker as error:
        raise RunFailedError(f"--dask {address}: {error}") from None
    except (ImportError, RuntimeError) as error:
        # The scheduler that cannot import what the pieces are made of says RuntimeError.
        raise RunFailedError(
            f"--dask {address}: scheduler and workers need the canwall that is here: "
            f"{error.__cause__ or error}"
        ) from None


def _compute_there(here: dict[str, str], plan: Plan, piece: int) -> NDArray[np.void]:
    """Compute a piece on a worker. Raises RunFailedError where it would make other numbers."""
    if (there := versions()) != here:
        wrong = [name for name in here if there[name] != here[name]]
        other, needed = (", ".join(f"{n} {found[n]}" for n in wrong) for found in (there, here))
        raise RunFailedError(f"a worker has {other}; needed: {needed}")
    return compute(plan, piece)


def _connected(address: str) -> Any:
    """A distributed.Client of the scheduler there. Raises InputError where there is none."""
    import distributed

    try:
        # A client that cannot read its address, or meets somebody else there, hangs.
        distributed.comm.get_address_host_port(address, strict=True)
        asyncio.run(asyncio.wait_for(_greet(address), _THERE_S))
        return distributed.Client(address, timeout=_PATIENCE_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError, MemoryError) as error:
        # Who speaks another protocol is taken to announce more than there is memory.
        if isinstance(error, MemoryError):
            error = ValueError("what is there is none")
        reason = str(error).splitlines()[0] if str(error) else "no answer"
        raise InputError(f"--dask {address}: no scheduler there: {reason}") from None


async def _greet(address: str) -> None:
    """Raise OSError, ValueError where no scheduler answers."""
    import distributed

    arguments = distributed.Security().get_connection_args("client")
    comm = await distributed.core.connect(address, timeout=_THERE_S, **arguments)
    try:
        await comm.write({"op": "identity", "reply": True})
        answer = await comm.read()
    finally:
        comm.abort()
    if not isinstance(answer, dict) or answer.get("type") != "Scheduler":
        raise ValueError("what is there is none")
