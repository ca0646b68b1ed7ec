"""A simulated drive from `[drive]` (its dictionary) and `[simulation]` (its mechanics)."""

import math
from collections.abc import Callable
from typing import NamedTuple

from canwall.config import Drive as DriveSettings
from canwall.config import Simulation
from canwall.config.drive import MILLI_NM
from canwall.simdrive.communication.dictionary import Dictionary
from canwall.simdrive.communication.memory import UNCONFIGURED, Memory
from canwall.simdrive.drive import DEFAULT_BITRATE, ServoDrive
from canwall.simdrive.faults import FaultyDrive, FaultyEncoder, planned
from canwall.simdrive.mechanics.motion import ServoMotion
from canwall.simdrive.profile.hardware import Hardware
from canwall.simdrive.profile.position_unit import quotient

_SERVO_DRIVE = 0x20192
"""Device type: profile 402, servo drive."""

TORQUE_LIMITS = (0x6072, 0x6073, 0x60E0, 0x60E1)
"""Objects that hold the torque, in per mille of the rated one."""

_SCALES = {
    0x6076: "simulation.rated_torque_nm",
    0x608F: "simulation.counts_per_rev",
    0x6091: "drive.gear_ratio",
}
"""Objects in which 0 stands for a value that the file leaves out, and the keys that give it."""


def make_drive(
    drive: DriveSettings,
    simulation: Simulation,
    sync_period_s: float,
    bitrate: int = DEFAULT_BITRATE,
    report: Callable[[str], None] = lambda line: None,
) -> FaultyDrive:
    """Make the drive that the configuration describes, not yet switched on.

    Rated torque and encoder are those of its dictionary (0x6076, 0x608F, 0x6091), and those of
    the simulation where the dictionary has none, or an encoder of 1/1; a gear of 1/1 is that of
    `[drive]`. A node-ID that LSS has stored takes precedence.

    Args:
        drive: `[drive]`, for dictionary, node-ID, gear and the unit of 0x6076.
        simulation: `[simulation]`.
        sync_period_s: time from one SYNC to the next.
        bitrate: of the bus, in bit/s.
        report: called with a line when a fault begins or ends.

    Raises:
        DictionaryError: the dictionary cannot be read, or no drive can be built from it.
    """
    memory = Memory(simulation.store)
    node_id = memory.node_id or drive.node_id
    dictionary = _dictionary(
        drive, simulation, drive.node_id if node_id == UNCONFIGURED else node_id
    )
    counts, gear_ratio = _encoder(dictionary, drive, simulation)
    encoder = FaultyEncoder(ServoMotion(simulation, sync_period_s, counts))
    hardware = _hardware(simulation, counts / (2.0 * math.pi), gear_ratio, _rated_unit_nm(drive))
    simulated = ServoDrive(
        dictionary,
        node_id,
        encoder,
        sync_period_s,
        memory,
        bitrate,
        simulation.torque_delay_cycles,
        simulation.real_time,
        hardware,
    )
    faults = [planned(fault, sync_period_s, simulation.real_time) for fault in simulation.fault]
    return FaultyDrive(simulated, encoder, faults, simulation.seed, report)


class ServoScales(NamedTuple):
    """Scales of a drive's numbers.

    Attributes:
        counts_per_rev: encoder increments per turn of the shaft.
        gear_ratio: turns of the motor per turn of the shaft.
        rated_torque_mnm: at the motor.
        torque_limit_per_mille: the lowest limit in the dictionary.
    """

    counts_per_rev: float
    gear_ratio: float
    rated_torque_mnm: float
    torque_limit_per_mille: float


def servo_scales(drive: DriveSettings, simulation: Simulation) -> ServoScales:
    """Return the scales of the drive that `make_drive` makes.

    Raises:
        DictionaryError: as `make_drive`.
    """
    dictionary = _dictionary(drive, simulation, drive.node_id)
    counts, gear_ratio = _encoder(dictionary, drive, simulation)
    limits = [
        dictionary.number(index, absent=0).value
        for index in TORQUE_LIMITS
        if (index, 0) in dictionary
    ]
    rated = dictionary.number(0x6076, absent=0).value * (_rated_unit_nm(drive) / MILLI_NM)
    return ServoScales(counts, gear_ratio, rated, float(min(limits, default=math.inf)))


def _dictionary(drive: DriveSettings, simulation: Simulation, node_id: int) -> Dictionary:
    """Read the drive's dictionary, completed from the simulation."""
    dictionary = Dictionary.load(drive.eds, node_id)
    for (index, subindex), value in simulation.objects_by_index.items():
        if value == 0 and index in _SCALES:
            do = f"leave it out of simulation.objects, and {_SCALES[index]} sets it"
            raise dictionary.error(index, subindex, f"cannot be 0; {do}")
        dictionary.power_on_with(index, subindex, value)
    dictionary.supply(0x1000, 0, _SERVO_DRIVE)
    dictionary.supply(0x6076, 0, round(simulation.rated_torque_nm / _rated_unit_nm(drive)))
    dictionary.supply(0x608F, 1, simulation.counts_per_rev)
    for unit in ((0x608F, 2), (0x6091, 1), (0x6091, 2)):
        dictionary.supply(*unit, 1)
    return dictionary


def _rated_unit_nm(drive: DriveSettings) -> float:
    """Return the unit of 0x6076 [N·m]."""
    return drive.rated_torque_unit_nm or MILLI_NM


def _encoder(
    dictionary: Dictionary, drive: DriveSettings, simulation: Simulation
) -> tuple[float, float]:
    """Return increments per turn of the shaft, and turns of the motor per turn of the shaft."""
    gear_ratio = quotient(dictionary, 0x6091)
    if gear_ratio == 1.0:  # a drive that was not told of its gear
        gear_ratio = drive.gear_ratio or 1.0
    # Increments of the encoder, whatever unit the drive shows; 1/1 is no resolution.
    resolution = quotient(dictionary, 0x608F)
    return (simulation.counts_per_rev if resolution == 1.0 else resolution) * gear_ratio, gear_ratio


def _hardware(
    simulation: Simulation, counts_per_rad: float, gear_ratio: float, rated_torque_unit_nm: float
) -> Hardware:
    switches, home = simulation.limit_switches_rad, simulation.home_switch_rad
    return Hardware(
        counts_per_rad=counts_per_rad,
        gear_ratio=gear_ratio,
        rated_torque_unit_nm=rated_torque_unit_nm,
        inertia_kg_m2=simulation.inertia_kg_m2,
        peak_torque_nm=simulation.peak_torque_nm,
        overload_s=simulation.overload_s,
        dc_link_v=simulation.dc_link_v,
        negative_limit=switches and switches[0] * counts_per_rad,
        positive_limit=switches and switches[1] * counts_per_rad,
        home=home and (home[0] * counts_per_rad, home[1] * counts_per_rad),
    )
