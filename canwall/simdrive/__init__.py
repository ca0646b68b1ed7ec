"""A CiA 402 servo drive that exists on the CAN bus alone: frames in, frames out."""

from canwall.simdrive.axis import Motion
from canwall.simdrive.build import make_drive
from canwall.simdrive.dictionary import Dictionary
from canwall.simdrive.drive import SimulatedDrive
from canwall.simdrive.faults import FaultyDrive
from canwall.simdrive.frame import Frame
from canwall.simdrive.hand import hand_force
from canwall.simdrive.motion import ServoMotion, hand_body, hand_plant, handle_plant
from canwall.simdrive.runner import BusRunner, Device

__all__ = [
    "BusRunner",
    "Device",
    "Dictionary",
    "FaultyDrive",
    "Frame",
    "Motion",
    "ServoMotion",
    "SimulatedDrive",
    "hand_body",
    "hand_force",
    "hand_plant",
    "handle_plant",
    "make_drive",
]
