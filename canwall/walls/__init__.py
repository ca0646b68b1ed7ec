"""The laws of the virtual wall: a file per law, the estimator, the layers, the registry.

A law is one function from the record of one wall (`WALL`) to the force that pushes the operator
out of it. Nothing here knows of CAN, counts or drives.
"""

from canwall.walls.estimator import (
    ESTIMATOR,
    MAX_DELAY,
    acting_force,
    actuation_state,
    carry_on,
    commit,
    look_away,
    observe,
    pick_up,
    reset_estimator,
    set_estimator,
)
from canwall.walls.interface import (
    HORIZON,
    WALL,
    call_law,
    forget,
    law,
    set_plant,
    set_referent,
)
from canwall.walls.layers import TENSION, note_force, wall_force
from canwall.walls.registry import DEADBEAT, LAWS, Law, UnknownLawError, find_law

__all__ = [
    "DEADBEAT",
    "ESTIMATOR",
    "HORIZON",
    "LAWS",
    "MAX_DELAY",
    "TENSION",
    "WALL",
    "Law",
    "UnknownLawError",
    "acting_force",
    "actuation_state",
    "call_law",
    "carry_on",
    "commit",
    "find_law",
    "forget",
    "law",
    "look_away",
    "note_force",
    "observe",
    "pick_up",
    "reset_estimator",
    "set_estimator",
    "set_plant",
    "set_referent",
    "wall_force",
]
