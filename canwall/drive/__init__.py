"""The master's side of CiA 301 and CiA 402: everything about a drive but the cycle itself.

One python-can bus, one thread: what waits for an answer reads the bus itself.
"""

from canwall.drive.cia402 import (
    Controlword,
    State,
    controlword_down,
    controlword_up,
    state_of,
)
from canwall.drive.link import Link
from canwall.drive.node import DriveError, DriveNode
from canwall.drive.pdo import Field, PdoLayout
from canwall.drive.setup import REQUIRED_OBJECTS, DriveSetup, set_up

__all__ = [
    "REQUIRED_OBJECTS",
    "Controlword",
    "DriveError",
    "DriveNode",
    "DriveSetup",
    "Field",
    "Link",
    "PdoLayout",
    "State",
    "controlword_down",
    "controlword_up",
    "set_up",
    "state_of",
]
