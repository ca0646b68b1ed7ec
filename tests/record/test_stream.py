"""Rows of a run on their way to a plotting program, and that nobody waits for it."""

import json
import math
import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import Record, same_signals
from rig import SIM_CONFIG

from canwall import config
from canwall.errors import InputError
from canwall.record import ROW, Ring, parse_target, start_recorders
from canwall.record.append import put_row
from canwall.record.columns import COLUMNS
from canwall.record.ring import ROWS
from canwall.record.stream import datagrams
from canwall.run import run_together


@pytest.fixture
def receiver() -> Any:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        receiver.bind(("127.0.0.1", 0))
        yield receiver


def run(folder: Path, stream: str | None, duration_s: float = 0.12) -> Record:
    settings = config.load(SIM_CONFIG, {"run.duration_s": duration_s})
    with start_recorders(1) as recorders:
        (result,) = run_together([settings], recorders, folder, stream=stream)
    assert result.notes == []
    return Record(folder)


@pytest.mark.slow
def test_streamed_rows_are_the_recorded_ones(receiver: socket.socket, tmp_path: Path) -> None:
    """Few enough for the buffer of the receiver, who takes none while the run goes on."""
    host, port = receiver.getsockname()
    streamed = run(tmp_path / "streamed", f"udp://{host}:{port}")
    rows = streamed.signals.to_pylist()
    assert len(rows) > 100
    receiver.settimeout(1.0)
    for row in rows:
        message = json.loads(receiver.recv(65536))
        assert message["timestamp"] == row["t_s"]
        finite = {k: v if isinstance(v, str) or math.isfinite(v) else None for k, v in row.items()}
        assert message["node5"] == finite
    receiver.settimeout(0.0)
    with pytest.raises(BlockingIOError):
        receiver.recv(65536)


@pytest.mark.slow
def test_receiver_that_is_absent_changes_nothing(receiver: socket.socket, tmp_path: Path) -> None:
    _, port = receiver.getsockname()
    receiver.close()
    absent = run(tmp_path / "absent", f"udp://:{port}", 0.6)
    alone = run(tmp_path / "alone", None, 0.6)
    assert same_signals(absent, alone)
    assert absent.signals.num_rows == alone.signals.num_rows == absent.summary["cycles"]


def test_reader_besides_the_consumer() -> None:
    """The producer overwrites what the reader has not seen; what it gets is whole and in order."""
    ring, row = Ring.create(), np.zeros(1, ROW)

    def put(first: int, count: int) -> None:
        for j in range(first, first + count):
            row["j"], row["t_s"] = j, 0.001 * j
            put_row(ring.header, ring.rows, row)

    put(0, 10)
    stop, rows = ring.rows_since(0)
    assert (stop, rows["j"].tolist()) == (10, list(range(10)))
    assert ring.rows_since(stop)[1].size == 0
    assert ring.take_rows()["j"].tolist() == list(range(10))  # none was taken out
    put(10, ROWS)
    stop, rows = ring.rows_since(4)
    assert stop == ROWS + 10
    # The row ROWS before the next one would be overwritten first.
    assert rows["j"].tolist() == list(range(11, ROWS + 10))
    assert len(ring.take_rows()) == ROWS
    ring.close()


def test_datagram() -> None:
    rows = np.zeros(1, ROW)
    rows["t_s"], rows["law"], rows["y"], rows["received"] = 0.25, 1, np.nan, True
    (datagram,) = datagrams(rows, "node7", ["standard", "µ"])
    message = json.loads(datagram)
    assert message["timestamp"] == 0.25
    assert list(message["node7"]) == [column.name for column in COLUMNS]
    assert message["node7"] | {"law": "µ", "y": None, "received": True} == message["node7"]


@pytest.mark.parametrize(
    ("text", "target"),
    [
        ("udp://127.0.0.1:9870", ("127.0.0.1", 9870)),
        ("udp://:9870", ("127.0.0.1", 9870)),
        ("udp://[::1]:9870", ("::1", 9870)),
    ],
)
def test_target(text: str, target: tuple[str, int]) -> None:
    assert parse_target(text) == target


@pytest.mark.parametrize(
    "text",
    ["9870", "127.0.0.1:9870", "udp://127.0.0.1", "tcp://:1", "udp://:70000", "udp://[:1", ""],
)
def test_no_target(text: str) -> None:
    with pytest.raises(InputError, match="has to be udp://HOST:PORT"):
        parse_target(text)
