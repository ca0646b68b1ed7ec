"""Export of a recorded run to formats that other programs read."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv

from canwall.record import numbers
from canwall.record.columns import COLUMNS, UNITS
from canwall.record.folder import whole_file
from canwall.record.summary import STRIKE_KEYS

if TYPE_CHECKING:
    from canwall.library.recorded import RecordedRun


def write_csv(run: "RecordedRun") -> list[Path]:
    """Write signals.csv and strikes.csv, see `RecordedRun.to_csv`."""
    units = [UNITS.get(name, "") for name in run.table.column_names]
    heads = [
        f"{name} [{unit}]" if unit else name
        for name, unit in zip(run.table.column_names, units, strict=True)
    ]
    strikes = run.summary["strikes"]
    tables = {
        "signals.csv": run.table.rename_columns(heads),
        "strikes.csv": pa.Table.from_pylist(strikes)
        if strikes
        else pa.table({name: pa.array([], pa.string()) for name in STRIKE_KEYS}),
    }
    for name, table in tables.items():
        with whole_file(run.folder / name) as file:
            pa_csv.write_csv(table, file)
    return [run.folder / name for name in tables]


def write_mat(run: "RecordedRun") -> Path:
    """Write run.mat, see `RecordedRun.to_mat`."""
    from scipy.io import savemat

    law = run.table["law"].combine_chunks()
    signals = {name: _column(run.table, name) for name in run.table.column_names}
    signals["law"] = np.asarray(law.indices.to_numpy(zero_copy_only=False), np.uint8) + np.uint8(1)
    content = {
        "signals": signals,
        "units": UNITS,
        "descriptions": {column.name: column.meaning for column in COLUMNS},
        "laws": np.array(law.dictionary.to_pylist(), dtype=object),
        "summary": _for_matlab(run.summary),
        "config": run.settings.to_toml(),
    }
    path = run.folder / "run.mat"
    with whole_file(path) as file:
        options = {"long_field_names": True, "do_compression": True, "oned_as": "column"}
        savemat(file, content, **options)  # type: ignore[arg-type]  # a file will do
    return path


def _column(table: pa.Table, name: str) -> Any:
    if pa.types.is_boolean(table.schema.field(name).type):
        return np.array(table[name].to_pylist(), dtype=bool)
    return None if name == "law" else numbers(table, name)


def _for_matlab(value: Any) -> Any:
    """Return what JSON holds as structs and arrays: NaN for null, names that are identifiers."""
    if value is None:
        return np.nan
    if isinstance(value, dict):
        return {re.sub(r"\W", "_", key): _for_matlab(inner) for key, inner in value.items()}
    if not isinstance(value, list):
        return value
    if value and all(isinstance(entry, dict) for entry in value):
        return _struct_array([_for_matlab(entry) for entry in value])
    if all(isinstance(entry, int | float) for entry in value):
        return np.array(value, dtype=float)
    return np.array([_for_matlab(entry) for entry in value], dtype=object)


def _struct_array(entries: list[dict[str, Any]]) -> np.ndarray[Any, np.dtype[np.void]]:
    """Return entries with the same keys as an array of structs, shape (n,)."""
    array = np.zeros(len(entries), [(name, object) for name in entries[0]])
    for position, entry in enumerate(entries):
        array[position] = tuple(entry.values())
    return array
