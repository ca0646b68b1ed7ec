"""The laws of the virtual wall: a file per law, the estimator, the layers, the registry.

A law is a function of the record of one wall (`WALL`) that returns the force pushing the operator
out of it. Nothing here knows of CAN, counts or drives.
"""

from canwall.walls.estimator import (
    ESTIMATOR,
    MAX_DELAY,
    acting_force,
    actuation_state,
    correct,
    end_lag,
    may_lag,
    note_missing_sample,
    predict,
    predict_open_loop,
    reset_estimator,
    set_estimator,
    stand_still,
    start_lagging,
    start_open_loop,
    surprise,
)
from canwall.walls.interface import (
    DEADBEAT,
    HORIZON,
    WALL,
    Law,
    UnknownLawError,
    call_law,
    clear_memory,
    law,
    set_plant,
    set_referent,
)
from canwall.walls.layers import TENSION, set_applied_force, wall_force
from canwall.walls.registry import LAWS, find_law

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
    "clear_memory",
    "correct",
    "end_lag",
    "find_law",
    "law",
    "may_lag",
    "note_missing_sample",
    "predict",
    "predict_open_loop",
    "reset_estimator",
    "set_applied_force",
    "set_estimator",
    "set_plant",
    "set_referent",
    "stand_still",
    "start_lagging",
    "start_open_loop",
    "surprise",
    "wall_force",
]
