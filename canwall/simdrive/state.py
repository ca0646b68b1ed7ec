"""State of a drive from cycle to cycle: one record that Python and compiled code share.

Services in Python read and write its fields as attributes (`DriveRecord.fields`); compiled
functions take the record itself. Nothing in it is stored anywhere else.
"""

import numpy as np

from canwall.compiled import Record, compiled, fields

#: Objects (sub-index 0) whose values are in the record, and the place of each in `values`.
OBJECTS = (
    0x6041,
    0x6064,
    0x606C,
    0x6074,
    0x6077,
    0x6078,
    0x6071,
    0x6040,
    0x6061,
    0x6072,
    0x6073,
    0x60E0,
    0x60E1,
    0x6076,
)
(
    STATUSWORD,
    POSITION,
    VELOCITY,
    TORQUE_DEMAND,
    TORQUE,
    CURRENT,
    TARGET_TORQUE,
    CONTROLWORD,
    MODE_DISPLAY,
    MAX_TORQUE,
    MAX_CURRENT,
    POSITIVE_LIMIT,
    NEGATIVE_LIMIT,
    RATED_TORQUE,
) = range(len(OBJECTS))

#: Those that change from SYNC to SYNC in steady operation.
CYCLIC_OBJECTS = tuple(
    OBJECTS[place] for place in (POSITION, VELOCITY, TORQUE_DEMAND, TORQUE, CURRENT, TARGET_TORQUE)
)

#: A deadline that never comes, in nanoseconds of protocol time.
NEVER = (1 << 63) - 1

#: PDOs of a device in each direction (CiA 301, 7.5.2.35 and 7.5.2.37), and mapped bytes of one.
MAX_PDOS, MAX_FIELDS = 512, 8

#: One object in a PDO: its place in `values`, and where its bits are in the data.
FIELD = np.dtype([("place", "i8"), ("shift", "i8"), ("bits", "i8")])
PDO = np.dtype(
    [
        ("can_id", "i8"),
        ("length", "i8"),
        ("fields", FIELD, (MAX_FIELDS,)),
        ("field_count", "i8"),
        # Received and not yet taken by a SYNC, or sent with the last one.
        ("data", "i8"),
        ("pending", "?"),
        # Event timer of an RPDO (0x1400:05), and when it runs out.
        ("event_ns", "i8"),
        ("deadline_ns", "i8"),
    ],
    align=True,
)

#: State that a cycle reads and writes. Times are in s unless their name says ns; torques in per
#: mille of the rated torque, as on the bus.
DRIVE = np.dtype(
    [
        # True if SYNCs and RPDOs are for `steady.take`.
        ("steady", "?"),
        # Protocol time, and what it was at the last tick.
        ("now_ns", "i8"),
        ("ticked_ns", "i8"),
        # SYNC: its CAN-ID, count and cycle; when it is missed, and how long PDOs are in time.
        ("sync_id", "i8"),
        ("syncs", "i8"),
        ("sync_period_ns", "i8"),
        ("sync_window_ns", "i8"),
        ("sync_deadline_ns", "i8"),
        ("sync_window_end_ns", "i8"),
        # PDOs by their number; which of them SYNC moves in steady operation.
        ("rpdos", PDO, (MAX_PDOS,)),
        ("tpdos", PDO, (MAX_PDOS,)),
        ("sync_rpdo", "i8"),
        ("sync_tpdos", "i8", (MAX_PDOS,)),
        ("sync_tpdo_count", "i8"),
        # Objects
        ("values", "i8", (len(OBJECTS),)),
        # Time of the drive: nominal SYNC period, time since the torque was last applied, time since
        # the last SYNC.
        ("period", "f8"),
        ("passed", "f8"),
        ("without_sync", "f8"),
        # Torque: to N·m at the shaft, limit switches that are closed (bits of 0x60FD), torque that
        # has held, whether it is less than wanted; I²t.
        ("gear_ratio", "f8"),
        ("nm_per_rated", "f8"),  # of one per mille, for each unit in 0x6076
        ("torque_sign", "i8"),
        ("inputs", "i8"),
        ("held", "i8"),
        ("limited", "?"),
        ("peak", "f8"),
        ("budget", "f8"),
        ("used", "f8"),
        # Feedback: encoder at the last sample [increments], and from increments to the bus.
        ("counts", "i8"),
        ("position_sign", "i8"),
        ("position_shift", "i8"),
        ("position_scale", "f8"),
        ("velocity_scale", "f8"),
        # Address of the record of the motion (mechanics.motion.MOTION), 0: it has none.
        ("motion", "u8"),
    ],
    align=True,
)


class DriveRecord:
    """The record of one drive, shape (1,), dtype DRIVE, and its fields as attributes."""

    def __init__(self) -> None:
        self.record = np.zeros(1, DRIVE)
        self.fields: Record = fields(self.record)
        self.values = memoryview(self.record["values"][0])


@compiled
def signed(value: int, bits: int) -> int:
    """Return the lowest bits of a number as a two's complement number."""
    value &= (1 << bits) - 1
    return value - (1 << bits) if value >> (bits - 1) else value
