"""The producer's side of the rings, in compiled code."""

from typing import Any

import numpy as np
from numba import types
from numba.core.cgutils import get_record_member
from numba.extending import intrinsic
from numpy.typing import NDArray

from canwall.compiled import Record, compiled

#: Size and alignment of a counter [bytes].
_COUNTER_BYTES = 8


def _member(context: Any, builder: Any, record: Any, value: Any, field: str) -> Any:
    """Return the address of a 64-bit field of a record."""
    kind = context.get_data_type(record.typeof(field))
    return get_record_member(builder, value, record.offset(field), kind)


@intrinsic(prefer_literal=True)
def load_acquire(typingctx: Any, record: Any, field: Any) -> Any:
    """Return a 64-bit field of a record, read before all that follows; in compiled code only."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = _member(context, builder, record, args[0], field.literal_value)
        return builder.load_atomic(address, "acquire", _COUNTER_BYTES)

    return types.int64(record, field), codegen


@intrinsic(prefer_literal=True)
def store_release(typingctx: Any, record: Any, field: Any, number: Any) -> Any:
    """Write a 64-bit field of a record after all that precedes; in compiled code only."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = _member(context, builder, record, args[0], field.literal_value)
        builder.store_atomic(args[2], address, "release", _COUNTER_BYTES)
        return context.get_dummy_value()

    return types.void(record, field, types.int64), codegen


@compiled
def put_frame(
    headers: NDArray[np.void],
    frames: NDArray[np.void],
    time_s: float,
    can_id: int,
    flags: int,
    length: int,
    data: int,
) -> None:
    """Append a frame, or count it as lost if the consumer is too far behind."""
    header: Record = headers[0]
    head = header.frame_head
    if head - load_acquire(header, "frame_tail") >= len(frames):
        header.frames_lost += 1
        return
    frame: Record = frames[head % len(frames)]
    frame.time_s = time_s
    frame.can_id = can_id
    frame.flags = flags
    frame.length = length
    frame.data = data
    store_release(header, "frame_head", head + 1)


@compiled
def put_row(headers: NDArray[np.void], ring: NDArray[np.void], rows: NDArray[np.void]) -> None:
    """Append a row (array of shape (1,)), or count it as lost."""
    header: Record = headers[0]
    head = header.row_head
    if head - load_acquire(header, "row_tail") >= len(ring):
        header.rows_lost += 1
        return
    ring[head % len(ring)] = rows[0]
    store_release(header, "row_head", head + 1)
