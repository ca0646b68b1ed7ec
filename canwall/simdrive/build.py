"""A simulated drive from `[drive]` (its dictionary) and `[simulation]` (its mechanics)."""

from canwall.config import Drive as DriveSettings
from canwall.config import Simulation
from canwall.simdrive.dictionary import Dictionary
from canwall.simdrive.drive import SimulatedDrive
from canwall.simdrive.motion import ServoMotion


def make_drive(
    drive: DriveSettings, simulation: Simulation, sync_period_s: float
) -> SimulatedDrive:
    """The drive that the configuration describes, not yet switched on.

    Its encoder is that of its dictionary (0x608F, 0x6091). Raises DictionaryError.
    """
    dictionary = Dictionary.load(drive.eds, drive.node_id)
    counts = _quotient(dictionary, 0x608F) * _quotient(dictionary, 0x6091)
    motion = ServoMotion(simulation, sync_period_s, counts)
    return SimulatedDrive(dictionary, drive.node_id, motion, sync_period_s)


def _quotient(dictionary: Dictionary, index: int) -> float:
    numerator = dictionary.number(index, 1, absent=1).value
    denominator = dictionary.number(index, 2, absent=1).value
    if numerator <= 0 or denominator <= 0:
        raise dictionary.error(index, 1, f"{numerator}/{denominator} is no scale")
    return float(numerator / denominator)
