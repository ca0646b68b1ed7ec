"""Simulated CiA 402 servo drive: frames in, frames out."""

from canwall.simdrive.build import TORQUE_LIMITS, ServoScales, make_drive, servo_scales
from canwall.simdrive.communication.dictionary import Dictionary
from canwall.simdrive.communication.frame import Frame
from canwall.simdrive.drive import ServoDrive
from canwall.simdrive.faults import FaultyDrive, planned
from canwall.simdrive.mechanics.hand import hand_force
from canwall.simdrive.mechanics.motion import ServoMotion
from canwall.simdrive.mechanics.servo import (
    SERVO,
    hand_body,
    hand_plant,
    handle_plant,
    make_servo,
    move_servo,
    shows_its_torque,
)
from canwall.simdrive.profile.power_drive_system import Motion
from canwall.simdrive.rehearsal import load_compiled_code
from canwall.simdrive.runner import BusRunner, Device
from canwall.simdrive.socket_runner import SocketRunner

__all__ = [
    "SERVO",
    "TORQUE_LIMITS",
    "BusRunner",
    "Device",
    "Dictionary",
    "FaultyDrive",
    "Frame",
    "Motion",
    "ServoDrive",
    "ServoMotion",
    "ServoScales",
    "SocketRunner",
    "hand_body",
    "hand_force",
    "hand_plant",
    "handle_plant",
    "load_compiled_code",
    "make_drive",
    "make_servo",
    "move_servo",
    "planned",
    "servo_scales",
    "shows_its_torque",
]
