"""Buses and sockets that move CAN frames, for master and slave alike, and their errors.

`unixcan` is a python-can interface between processes and `socket_pair` one with two ends in a
process; `raw_socket` moves frames over a descriptor from compiled code, `cycle_socket` finds that
descriptor for a bus. `can_ids` has the identifiers of CiA 301. Nothing here reads a frame's data.
"""

from canwall.bus.cycle_socket import CycleSocket
from canwall.bus.errors import bus_error, explained, reason
from canwall.bus.message import DataFrame
from canwall.bus.opening import open_bus
from canwall.bus.socket_pair import SocketPairBus, socket_pair

__all__ = [
    "CycleSocket",
    "DataFrame",
    "SocketPairBus",
    "bus_error",
    "explained",
    "open_bus",
    "reason",
    "socket_pair",
]
