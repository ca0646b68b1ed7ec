"""Process that streams the rows of a run: `python -m canwall.record.stream`.

Each cycle is a UDP datagram with a JSON object, as PlotJuggler's UDP server takes it: `timestamp`,
the time of the SYNC [s], and the columns of the row in a group, so that signals are named
`node5/y`. Not a number is null.

It looks into the ring now and then and sends what is new, until standard input ends. Datagrams that
nobody receives, or not in time, are lost; the record has every row.
"""

import contextlib
import json
import math
import os
import select
import socket
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canwall.record.columns import COLUMNS
from canwall.record.ring import Ring

_POLL_S = 0.02


def datagrams(rows: NDArray[np.void], name: str, laws: Sequence[str]) -> Iterator[bytes]:
    """Yield rows (dtype ROW) as JSON; `name` is that of their group."""
    for row in rows.tolist():
        values: dict[str, Any] = {
            column.name: laws[value] if column.names_law else _number(value)
            for column, value in zip(COLUMNS, row, strict=True)
        }
        yield json.dumps({"timestamp": values["t_s"], name: values}, ensure_ascii=False).encode()


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def send(ring: Ring, to: socket.socket, name: str, laws: Sequence[str], end: int) -> None:
    """Send the rows of a ring as they come, until the descriptor `end` is readable."""
    sent, ended = 0, False
    while not ended:
        ended = bool(select.select([end], [], [], _POLL_S)[0])  # asked first: then comes the rest
        sent, rows = ring.rows_since(sent)
        for datagram in datagrams(rows, name, laws):
            with contextlib.suppress(OSError):
                to.send(datagram)


def main() -> None:
    """Stream the ring of the descriptor in the first argument, as the second says in JSON."""
    ring, what = Ring(int(sys.argv[1])), json.loads(sys.argv[2])
    os.nice(10)  # the cycle and its record come first
    host, port = what["target"]
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as sender:
        sender.setblocking(False)
        sender.connect((host, port))
        send(ring, sender, what["name"], what["laws"], sys.stdin.fileno())


if __name__ == "__main__":
    main()
