"""The one declaration of each column, and what comes from it."""

import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from commands import Record

from canwall.config import ConfigError
from canwall.record import ROW, TIMING_COLUMNS, RunFolder, column_table, numbers, read_signals
from canwall.record.columns import COLUMNS, record_batch, schema
from canwall.record.pictures import plot_run

LAWS = ["standard", "plus_half_π"]


def test_rows_and_timing_follow_from_the_declaration() -> None:
    assert ROW.names == tuple(column.name for column in COLUMNS)
    assert [ROW[column.name] for column in COLUMNS] == [np.dtype(c.dtype) for c in COLUMNS]
    assert ROW.isalignedstruct
    assert TIMING_COLUMNS == ("sync_interval_s", "latency_s")


def test_fields_of_the_file_say_unit_and_meaning() -> None:
    fields = schema(LAWS)
    assert fields.names == list(ROW.names or ())
    for column, field in zip(COLUMNS, fields, strict=True):
        assert field.metadata[b"unit"].decode() == column.unit
        assert field.metadata[b"description"].decode() == column.meaning
    assert fields.field("law").type == pa.dictionary(pa.uint8(), pa.string())
    assert fields.field("received").type == pa.bool_()
    assert fields.field("v_est").metadata[b"unit"] == b"rad/s"


def test_recorded_file_says_them_too(four_strikes: Record) -> None:
    written = pq.read_schema(four_strikes.folder / "signals.parquet")
    assert written.field("y").metadata[b"unit"] == b"rad"
    assert written.metadata[b"laws"] == b'["mean_force", "standard"]'


def test_table_of_the_documentation() -> None:
    head, rule, *lines = column_table().splitlines()
    assert head.count("|") == rule.count("|") == 5
    assert len(lines) == len(COLUMNS)
    for column, line in zip(COLUMNS, lines, strict=True):
        _, name, kind, unit, meaning, _ = (cell.strip() for cell in line.split("|"))
        assert (name, unit, meaning) == (f"`{column.name}`", column.unit, column.meaning)
        assert kind == ("string" if column.name == "law" else ROW[column.name].name)


def test_batch_is_what_pyarrow_makes_of_the_values() -> None:
    random = np.random.default_rng(7)
    rows = np.frombuffer(random.bytes(ROW.itemsize * 1001), ROW).copy()
    rows["received"] = random.integers(0, 2, 1001)
    rows["law"] %= len(LAWS)
    batch = record_batch(rows, LAWS)
    batch.validate(full=True)
    for name in ROW.names or ():
        values = np.ascontiguousarray(rows[name])
        if name == "law":
            assert batch[name].to_pylist() == [LAWS[law] for law in values]
        else:
            assert batch[name].to_numpy(zero_copy_only=False).tobytes() == values.tobytes()


def test_numbers_of_several_chunks() -> None:
    rows = np.zeros(5, ROW)
    rows["y"], rows["phase"] = np.arange(5.0), range(5)
    table = pa.Table.from_batches([record_batch(part, LAWS) for part in (rows[:2], rows[2:])])
    assert numbers(table, "y").tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert numbers(table, "phase").dtype == np.uint8
    assert len(numbers(table.slice(0, 0), "y")) == 0


# Records of other versions


def copied(run: Path, to: Path, table: pa.Table) -> RunFolder:
    """A run's folder with other signals."""
    shutil.copy(run / "summary.json", to / "summary.json")
    pq.write_table(table, to / "signals.parquet")
    return RunFolder(to)


def test_older_record_is_read_and_drawn(four_strikes: Record, tmp_path: Path) -> None:
    older = four_strikes.signals.drop_columns(["latency_s", "d_est", "law"])
    folder = copied(four_strikes.folder, tmp_path, older.replace_schema_metadata(None))
    assert read_signals(folder.signals).column_names == older.column_names
    assert plot_run(folder).read_bytes() == (four_strikes.folder / "run.png").read_bytes()


def test_newer_record_is_read_and_drawn(four_strikes: Record, tmp_path: Path) -> None:
    signals = four_strikes.signals
    newer = signals.append_column("temperature_k", pa.array(np.full(signals.num_rows, 300.0)))
    folder = copied(four_strikes.folder, tmp_path, newer)
    assert read_signals(folder.signals).column_names == newer.column_names
    assert plot_run(folder).exists()


def test_what_needs_a_column_says_which(four_strikes: Record, tmp_path: Path) -> None:
    older = four_strikes.signals.drop_columns(["torque_applied", "force_applied", "d_est"])
    folder = copied(four_strikes.folder, tmp_path, older)
    with pytest.raises(ConfigError, match="lacks column torque_applied, force_applied: not a"):
        plot_run(folder)
