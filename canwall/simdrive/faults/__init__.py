"""Faults of the simulated drive, between it and its bus and inside it (docs/faults.md)."""

from canwall.simdrive.faults.encoder import FaultyEncoder
from canwall.simdrive.faults.faulty_drive import FaultyDrive
from canwall.simdrive.faults.plan import planned

__all__ = ["FaultyDrive", "FaultyEncoder", "planned"]
