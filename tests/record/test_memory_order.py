"""What a counter announces is there, on processors that reorder accesses as well."""

import re
import threading
import time
from collections.abc import Callable
from typing import Any

import llvmlite.binding as llvm
import numpy as np
import pytest
from numba import njit, typeof

from canwall.record import ROW, Ring, ring
from canwall.record.append import load_acquire, put_frame, put_row, store_release
from canwall.record.ring import ROWS

ARM = "aarch64-unknown-linux-gnu"
PATIENCE_S = 60.0


def assembly_for_arm(function: Any, *examples: Any) -> str:
    """The machine code of a compiled function for ARM, with everything that it calls."""
    code = njit(nogil=True, error_model="numpy")(function.__wrapped__)
    code.compile(tuple(typeof(example) for example in examples))
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    text = code.inspect_llvm(code.signatures[0])
    text = re.sub(r"^target (datalayout|triple) = .*$", "", text, flags=re.MULTILINE)
    # Numba's own reference counts use x86's instructions; they are of no concern here.
    text = re.sub(r'"target-(cpu|features)"="[^"]*"', "", text)
    text = re.sub(r"tail call i8 @llvm\.x86\.\S*\(.*\)", "add i8 0, 0", text)
    machine = llvm.Target.from_triple(ARM).create_target_machine(opt=3)
    module = llvm.parse_assembly(f'target triple = "{ARM}"\n{text}')
    return str(machine.emit_assembly(module))


def test_compiled_code_publishes_with_release_and_reads_with_acquire() -> None:
    both = Ring.create()
    frame = (0.0, 0x181, 0, 8, 0)
    for function, arguments in (
        (put_row, (both.header, both.rows, both.rows[:1])),
        (put_frame, (both.header, both.frames, *frame)),
    ):
        lines = assembly_for_arm(function, *arguments).splitlines()
        operations = [line.split()[0] for line in lines if line.startswith("\t")]
        assert operations.count("stlr") == 1
        assert sum(operation in ("ldar", "ldapr") for operation in operations) == 1
        # The content is written between the two.
        read = next(k for k, name in enumerate(operations) if name in ("ldar", "ldapr"))
        assert any(name.startswith("st") for name in operations[read : operations.index("stlr")])


class Noting:
    """A stand-in for an array that notes what is read from it and written to it."""

    def __init__(self, name: str, content: Any, notes: list[str]) -> None:
        self._name, self._content, self._notes = name, content, notes

    def __len__(self) -> int:
        return len(self._content)

    def __getitem__(self, key: Any) -> Any:
        self._notes.append(f"read {self._name} {key}" if isinstance(key, str) else "read content")
        return self._content[key]

    def __setitem__(self, key: Any, value: Any) -> None:
        what = f"write {self._name} {key}" if isinstance(key, str) else "write content"
        self._notes.append(what)
        self._content[key] = value


def test_python_takes_from_the_ring_between_two_fences(monkeypatch: pytest.MonkeyPatch) -> None:
    both, notes = Ring.create(), list[str]()
    put_row(both.header, both.rows, np.ones(1, ROW))
    monkeypatch.setattr(ring, "fence", lambda: notes.append("fence"))
    both.header = Noting("header", both.header, notes)  # type: ignore[assignment]
    both.rows = Noting("rows", both.rows, notes)  # type: ignore[assignment]
    assert len(both.take_rows()) == 1
    counters = ["read header row_tail", "read header row_head"]
    assert notes == [*counters, "fence", "read content", "fence", "write header row_tail"]


@njit(nogil=True)  # type: ignore[untyped-decorator]
def put_too_early(headers: Any, rows: Any, row: Any) -> None:
    """`put_row` as a processor may execute it without release order, microseconds early."""
    header = headers[0]
    head = header.row_head
    store_release(header, "row_head", head + 1)
    for _ in range(2000):  # Longer than the other side takes from the counter to the rows.
        load_acquire(header, "row_tail")
    rows[head % len(rows)] = row[0]


def stress(put: Callable[..., None], count: int, until_torn: bool) -> int:
    """Put rows while they are taken out; return how many came out otherwise than they went in."""
    both, row, ended = Ring.create(), np.zeros(1, ROW), threading.Event()

    @njit(nogil=True)  # type: ignore[untyped-decorator]
    def produce(headers: Any, rows: Any, row: Any, start: int, stop: int) -> None:
        for j in range(start, stop):
            while headers[0].row_head - load_acquire(headers[0], "row_tail") >= len(rows):
                pass
            row[0].j = j
            row[0].t_s = j
            row[0].wall_position_rad = j
            put(headers, rows, row)

    def keep_producing() -> None:
        for start in range(0, count, ROWS):
            if not ended.is_set():
                produce(both.header, both.rows, row, start, min(start + ROWS, count))

    produce(both.header, both.rows, row, 0, 0)
    producer = threading.Thread(target=keep_producing)
    producer.start()
    deadline = time.monotonic() + PATIENCE_S
    torn = expected = 0
    while expected < count and time.monotonic() < deadline and not (until_torn and torn):
        taken = both.take_rows()
        j = np.arange(expected, expected + len(taken))
        expected += len(taken)
        same = (taken["j"] == j) & (taken["t_s"] == j) & (taken["wall_position_rad"] == j)
        torn += int(np.count_nonzero(~same))
    ended.set()
    while producer.is_alive():
        both.take_rows()
    return torn


@pytest.mark.slow
def test_rows_are_whole_when_they_are_announced() -> None:
    assert stress(put_row, 3_000_000, until_torn=False) == 0


@pytest.mark.slow
def test_stress_finds_rows_that_are_announced_too_early() -> None:
    assert stress(put_too_early, 100_000_000, until_torn=True) > 0
