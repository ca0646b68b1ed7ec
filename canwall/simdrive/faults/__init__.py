"""Faults on demand: between the drive and its bus, and inside the drive (docs/faults.md)."""

from canwall.simdrive.faults.encoder import FaultyEncoder
from canwall.simdrive.faults.faulty_drive import FaultyDrive
from canwall.simdrive.faults.plan import PlannedFault, planned

__all__ = ["FaultyDrive", "FaultyEncoder", "PlannedFault", "planned"]
