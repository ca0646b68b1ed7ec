"""Computation of the pieces of a sweep on a Dask cluster, with its failures as one line each."""

import asyncio
import functools
import logging
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canwall.errors import InputError, RunFailedError
from canwall.extras import need
from canwall.sweep.dataset import digest, digests, versions
from canwall.sweep.plan import PieceResult, Plan, compute_piece

#: Timeouts for reaching a scheduler, and for connecting a client to it [s].
_GREETING_S, _CONNECTING_S = 3.0, 10.0
_NO_SCHEDULER = "it answers, but not as a Dask scheduler"


def compute_on_cluster(plan: Plan, pieces: Sequence[int], address: str) -> Iterator[PieceResult]:
    """Yield the pieces with their numbers as the workers of the scheduler finish them.

    Raises:
        InputError: If there is no scheduler at the address, or no Dask here.
        RunFailedError: If the scheduler is lost, or if scheduler or workers have other software
            than this machine, or other laws.
    """
    need("dask")
    import distributed

    # What they log is also raised, or was recovered from (a worker lost with its result). Some of
    # the loggers have a level of their own.
    for name in list(logging.root.manager.loggerDict):
        if name.partition(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL)
    client = _connect(address)
    read = digests(plan)
    try:
        # The scheduler drops what is unfinished when the client leaves.
        with client:
            jobs = {
                client.submit(
                    _compute_checked, versions(), read, plan, piece, pure=False, retries=2
                ): piece
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
        # A scheduler that cannot import the modules of a piece raises RuntimeError.
        raise RunFailedError(
            f"--dask {address}: scheduler and workers need the canwall of this machine: "
            f"{error.__cause__ or error}"
        ) from None


def _compute_checked(
    needed: dict[str, str], read: dict[str, str], plan: Plan, piece: int
) -> NDArray[np.void]:
    """Compute a piece on a worker. Raises RunFailedError unless versions and files are the same."""
    if (found := versions()) != needed:
        wrong = [name for name in needed if found[name] != needed[name]]
        theirs, ours = (", ".join(f"{n} {v[n]}" for n in wrong) for v in (found, needed))
        raise RunFailedError(f"a worker has {theirs}; needed: {ours}")
    for path, expected in read.items():
        if _first_digest(path) != expected:
            raise RunFailedError(
                f"a worker has another {path}, or has read it before it changed; see that it is "
                "the same there, and start the workers again"
            )
    return compute_piece(plan, piece)


@functools.cache
def _first_digest(path: str) -> str | None:
    """Return the digest with which a file was found first, as a process reads a law once."""
    try:
        return digest(path)
    except OSError:
        return None


def _connect(address: str) -> Any:
    """Return a distributed.Client of the scheduler. Raises InputError if there is none."""
    import distributed

    try:
        # A client with a malformed address, or of something that is no scheduler, hangs.
        distributed.comm.get_address_host_port(address, strict=True)
        asyncio.run(asyncio.wait_for(_greet(address), _GREETING_S))
        return distributed.Client(address, timeout=_CONNECTING_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError, MemoryError) as error:
        # Bytes of another protocol, read as a length, ask for more memory than there is.
        if isinstance(error, MemoryError):
            error = ValueError(_NO_SCHEDULER)
        reason = str(error).splitlines()[0] if str(error) else "no answer"
        raise InputError(f"--dask {address}: no scheduler there: {reason}") from None


async def _greet(address: str) -> None:
    """Raise OSError or ValueError unless a scheduler answers."""
    import distributed

    arguments = distributed.Security().get_connection_args("client")
    comm = await distributed.core.connect(address, timeout=_GREETING_S, **arguments)
    try:
        await comm.write({"op": "identity", "reply": True})
        answer = await comm.read()
    finally:
        comm.abort()
    if not isinstance(answer, dict) or answer.get("type") != "Scheduler":
        raise ValueError(_NO_SCHEDULER)
