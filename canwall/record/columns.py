"""Columns of a run's record, each declared once.

The row that the cycle fills (`ROW`), the schema of signals.parquet with units and meanings as
metadata, and the table in the documentation all come from `COLUMNS`. A new column needs one line
there and one line in the cycle that fills it.
"""

import json
from collections.abc import Sequence
from enum import IntEnum
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pyarrow as pa


class Phase(IntEnum):
    """Purpose of a cycle."""

    ENABLING = 0
    RENDERING = 1
    LEAVING = 2
    MEASURING = 3


class Column(NamedTuple):
    """One column.

    Attributes:
        name: Name in a row and in the files.
        dtype: NumPy type in a row.
        unit: Unit, empty if there is none.
        meaning: One line for the metadata and the documentation.
        names_law: Rows hold an index into the laws of the run; the files hold the law's name.
        by_clock: The values depend on the clock; those of other columns are reproducible.
    """

    name: str
    dtype: str
    unit: str
    meaning: str
    names_law: bool = False
    by_clock: bool = False


_PHASES = ", ".join(f"{phase.value} {phase.name.lower()}" for phase in Phase)

#: Columns of one cycle. `position_rad` and torques have the sign of the drive's axis; y, v, d,
#: force and stiffness have that of the wall: y < 0 inside it, force > 0 out of it.
COLUMNS = (
    Column("j", "i8", "", "SYNC count, from 0"),
    Column("t_s", "f8", "s", "nominal time of the SYNC: j times the cycle"),
    Column("phase", "u1", "", f"what the cycle was for: {_PHASES}"),
    Column("received", "?", "", "whether the TPDO of this SYNC came in time"),
    Column("counts", "i8", "count", "position actual value, 0x6064, continued beyond 32 bits"),
    Column("statusword", "u2", "", "statusword, 0x6041"),
    Column("controlword", "u2", "", "controlword as sent, 0x6040"),
    Column("position_rad", "f8", "rad", "position of the drive's axis"),
    Column("y", "f8", "rad", "position relative to the wall as sampled; negative inside"),
    Column("y_est", "f8", "rad", "the same, estimated for the instant at which the force acts"),
    Column("v_est", "f8", "rad/s", "velocity, estimated for that instant"),
    Column("d_est", "f8", "N·m", "bias force, estimated: what else moves the handle"),
    Column("force", "f8", "N·m", "force that the law demands, positive out of the wall"),
    Column("torque_cmd_per_mille", "i2", "‰ of rated torque", "target torque as sent, 0x6071"),
    Column("torque_cmd", "f8", "N·m", "the same as torque, drive's axis"),
    Column("torque_actual", "f8", "N·m", "torque actual value, 0x6077, drive's axis"),
    Column("torque_applied", "f8", "N·m", "torque in force until the next SYNC, drive's axis"),
    Column("force_applied", "f8", "N·m", "the wall's force then, out of it; without a probe"),
    Column("law", "u1", "", "law of the wall", names_law=True),
    Column("stiffness", "f8", "N·m/rad", "stiffness of the wall, as asked"),
    Column("damping", "f8", "N·m·s/rad", "damping of the wall in force; without the guard"),
    Column("cap", "f8", "", "cap as asked: of the stiffness in force, in mass/T²; 0: none"),
    Column(
        "damping_ratio", "f8", "", "damping ratio of the wall, as asked; 0: none, damping as given"
    ),
    Column("stiffness_in_force", "f8", "N·m/rad", "stiffness that is rendered: as far as the cap"),
    Column("mass_est", "f8", "kg·m²", "mass in force in the model: drive, handle and hand"),
    Column("mass_spread", "f8", "", "its standard deviation, relative; 0: nothing learned"),
    Column("delay_est", "f8", "cycles", "delay from a sample to its torque: as told, and as found"),
    Column("wall_position_rad", "f8", "rad", "position of the wall on the drive's axis"),
    Column("guard", "f8", "", "factor of the guard on the force of the law; 1: untouched"),
    Column("sync_interval_s", "f8", "s", "time since the SYNC before, measured", by_clock=True),
    Column("latency_s", "f8", "s", "time from reception of the TPDO to the RPDO", by_clock=True),
)

#: Unit of each column, empty if there is none.
UNITS = {column.name: column.unit for column in COLUMNS}

#: Row of one cycle, in the cycle and in the ring.
ROW = np.dtype([(column.name, column.dtype) for column in COLUMNS], align=True)

#: Columns that depend on the clock; all others are reproducible.
TIMING_COLUMNS = tuple(column.name for column in COLUMNS if column.by_clock)


def column_table() -> str:
    """Return the columns as a Markdown table, for the documentation."""
    lines = ["| column | type | unit | meaning |", "|---|---|---|---|"]
    for column in COLUMNS:
        kind = "string" if column.names_law else np.dtype(column.dtype).name
        lines.append(f"| `{column.name}` | {kind} | {column.unit} | {column.meaning} |")
    return "\n".join(lines) + "\n"


def schema(laws: Sequence[str]) -> "pa.Schema":
    """Return the schema of signals.parquet for a run with these laws.

    The metadata of a field are `unit` and `description`; those of the schema are, as JSON, `laws`,
    `units` by column, and the same for `pandas.read_parquet`, which makes them the attributes
    (`attrs`) of its DataFrame.
    """
    import pyarrow as pa

    fields = [
        pa.field(
            column.name,
            pa.dictionary(pa.uint8(), pa.string())
            if column.names_law
            else pa.from_numpy_dtype(np.dtype(column.dtype)),
            metadata={"unit": column.unit, "description": column.meaning},
        )
        for column in COLUMNS
    ]
    metadata = {"laws": list(laws), "units": UNITS, "PANDAS_ATTRS": {"units": UNITS}}
    return pa.schema(fields, {key: json.dumps(value) for key, value in metadata.items()})


def record_batch(rows: NDArray[np.void], laws: Sequence[str]) -> "pa.RecordBatch":
    """Return rows (dtype ROW, shape (n,)) as an Arrow record batch.

    It is made from their bytes, because `pyarrow.array` imports pandas to inspect its argument.
    """
    import pyarrow as pa

    def array(kind: "pa.DataType", count: int, *buffers: Any) -> "pa.Array":
        return pa.Array.from_buffers(kind, count, [None, *map(pa.py_buffer, buffers)])

    def column(kind: "pa.DataType", values: NDArray[Any]) -> "pa.Array":
        if pa.types.is_dictionary(kind):
            return pa.DictionaryArray.from_arrays(column(kind.index_type, values), names)
        if pa.types.is_boolean(kind):
            values = np.packbits(values, bitorder="little")
        return array(kind, len(rows), np.ascontiguousarray(values))

    encoded = [law.encode() for law in laws]
    ends = np.cumsum([0, *map(len, encoded)], dtype=np.int32)
    names = array(pa.string(), len(laws), ends, b"".join(encoded))
    fields = schema(laws)
    return pa.RecordBatch.from_arrays([column(f.type, rows[f.name]) for f in fields], schema=fields)
