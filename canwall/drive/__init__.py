"""Master's side of CiA 301 and CiA 402: everything about a drive except the cycle.

One python-can bus, one thread: code that waits for an answer reads the bus itself.
"""

from canwall.drive.cia402 import (
    Controlword,
    DriveState,
    Enabling,
    controlword_up,
    state_of,
    status_text,
)
from canwall.drive.link import Link
from canwall.drive.node import DriveError, DriveNode
from canwall.drive.other_masters import refuse_second_master
from canwall.drive.pdo import Field, PdoLayout
from canwall.drive.setup import REQUIRED_OBJECTS, DriveSetup, disable, set_up
from canwall.drive.watchdog import NO_WATCHDOG, ErrorControlFrame, Watchdog, disarm

__all__ = [
    "NO_WATCHDOG",
    "REQUIRED_OBJECTS",
    "Controlword",
    "DriveError",
    "DriveNode",
    "DriveSetup",
    "DriveState",
    "Enabling",
    "ErrorControlFrame",
    "Field",
    "Link",
    "PdoLayout",
    "Watchdog",
    "controlword_up",
    "disable",
    "disarm",
    "refuse_second_master",
    "set_up",
    "state_of",
    "status_text",
]
