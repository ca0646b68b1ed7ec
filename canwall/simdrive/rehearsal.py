"""A drive's life in memory, before one is on a bus: its compiled code is loaded by then."""

import functools
import struct

from canwall.bus.can_ids import NMT, RPDO1, SDO_REQUEST, SYNC
from canwall.config import Drive, Simulation, shipped
from canwall.simdrive.build import make_drive
from canwall.simdrive.faults import FaultyDrive

_NODE_ID, _PERIOD_S = 1, 0.001
_TORQUE_BY_SYNC = {
    "0x1400:02": 1,
    "0x1600:00": 2,
    "0x1600:01": 0x60400010,
    "0x1600:02": 0x60710010,
    "0x1800:02": 1,
    "0x6060": 10,
}
"""Controlword and target torque with every SYNC, in cyclic synchronous torque mode."""

_SYNCS = 3
"""One by one service, one to become steady, one in steady operation."""


@functools.cache
def load_compiled_code(real_time: bool) -> None:
    """Load the code that a drive runs, or compile it at a first start.

    Otherwise it would be loaded at the first SYNC and the first torque, and a master would wait
    for the answer.

    Args:
        real_time: True for a drive whose time `tick` moves on, False if SYNC does.
    """
    simulation = Simulation(objects=_TORQUE_BY_SYNC, real_time=real_time)
    eds = shipped("eds/canwall-drive.eds")
    _rehearse(make_drive(Drive(node_id=_NODE_ID, eds=eds), simulation, _PERIOD_S))


def _rehearse(drive: FaultyDrive) -> None:
    """Enable a drive, give it a torque, disable it."""
    drive.boot()
    drive.process(NMT, bytes([1, _NODE_ID]))
    drive.tick(_PERIOD_S)
    for controlword in (0x06, 0x07, 0x0F):
        request = struct.pack("<BHBHxx", 0x2B, 0x6040, 0, controlword)
        drive.process(SDO_REQUEST + _NODE_ID, request)
        drive.tick(_PERIOD_S)
    for torque in range(_SYNCS):
        drive.process(RPDO1 + _NODE_ID, struct.pack("<Hh", 0x0F, torque))
        drive.process(SYNC, b"")
        drive.tick(_PERIOD_S)
    drive.process(RPDO1 + _NODE_ID, struct.pack("<Hh", 0x00, 0))
    drive.process(SYNC, b"")
