"""The laws of the virtual wall: a file per law, the estimator, the registry.

A law is one function from the record of one wall (`WALL`) to the force that pushes the operator
out of it. Nothing here knows of CAN, counts or drives.
"""

from canwall.walls.estimator import (
    ESTIMATOR,
    MAX_DELAY,
    actuation_state,
    commit,
    observe,
    reset_estimator,
    set_estimator,
)
from canwall.walls.interface import WALL, call_law, law, set_plant
from canwall.walls.registry import LAWS, Law, UnknownLawError, find_law

__all__ = [
    "ESTIMATOR",
    "LAWS",
    "MAX_DELAY",
    "WALL",
    "Law",
    "UnknownLawError",
    "actuation_state",
    "call_law",
    "commit",
    "find_law",
    "law",
    "observe",
    "reset_estimator",
    "set_estimator",
    "set_plant",
]
