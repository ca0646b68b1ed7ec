"""Exact motion of handle and hand: oscillator flow, ZOH equivalents, friction, contact.

Everything is compiled and does not allocate on the hot path. Nothing here depends on control laws,
drives or CAN.
"""

from canwall.physics.contact import Grasp, HandBody, advance_grasp
from canwall.physics.motion import MAX_EVENTS, PLANT, advance, contact_end, make_plant, time_to_wall
from canwall.physics.oscillator import acceleration, basis, flow, zoh, zoh_coefficients
from canwall.physics.shaft import SHAFT, TwoMasses, advance_shaft, make_shaft, shaft_spring
from canwall.physics.smooth import Force
from canwall.physics.wall import capped_stiffness, damping_of_ratio

__all__ = [
    "MAX_EVENTS",
    "PLANT",
    "SHAFT",
    "Force",
    "Grasp",
    "HandBody",
    "TwoMasses",
    "acceleration",
    "advance",
    "advance_grasp",
    "advance_shaft",
    "basis",
    "capped_stiffness",
    "contact_end",
    "damping_of_ratio",
    "flow",
    "make_plant",
    "make_shaft",
    "shaft_spring",
    "time_to_wall",
    "zoh",
    "zoh_coefficients",
]
