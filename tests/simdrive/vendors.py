"""Drives with the dictionaries of drives that can be bought, and with our own."""

from dataclasses import dataclass
from pathlib import Path

import pytest
from simdrive_bench import EDS, NODE_ID, Bench

from canwall.config import Drive as DriveSettings
from canwall.config import Simulation
from canwall.simdrive import make_drive

FOLDER = Path(__file__).parents[3] / "shared" / "vendor-eds"


@dataclass(frozen=True)
class Vendor:
    """A file, and what its drive is to be like: torque modes (each has homing beside them)."""

    file: str
    modes: tuple[int, ...]
    lacks: tuple[int, ...]
    rated_torque_mnm: float
    counts_per_rev: float


VENDORS = [
    Vendor("maxon_epos4_0x1018.eds", (10,), (0x6072, 0x608F, 0x6091), 1250, 4000),
    Vendor("elmo_gold.dcf", (10, 4), (0x1005, 0x1007), 1250, 4000),
    Vendor("nanotec_C5-E-2-09.eds", (10, 4), (0x6076, 0x60E0), 1250, 3600),
    Vendor("technosoft_iPOS.D.v1.04.eds", (10,), (0x1016, 0x6072, 0x6076), 1250, 4000),
    Vendor("ingenia_eve-net-c_1.8.1.eds", (10,), (0x1016, 0x6087), 1000, 4000),
]
OWN = EDS.name
DICTIONARIES = [OWN, *(vendor.file for vendor in VENDORS)]
"""Names of the files: our own, and the vendors'."""

SIMULATION = Simulation(rated_torque_nm=1.25, counts_per_rev=4000)


def path_of(file: str) -> Path:
    """Return where a dictionary is; a vendor's that is not there skips the test."""
    if file == OWN:
        return EDS
    if not (FOLDER / file).is_file():
        pytest.skip(f"{FOLDER} has no {file}")
    return FOLDER / file


class ConfiguredBench(Bench):
    """A drive as the configuration describes it, with one of the dictionaries.

    Ingenia's begins with a current limit (0x6073) of 4 %, which its user has to raise.
    """

    def __init__(self, path: Path, simulation: Simulation = SIMULATION) -> None:
        self.path = path
        settings = DriveSettings(node_id=NODE_ID, eds=path)
        self.drive = make_drive(settings, simulation, 0.001)
        self.sent = self.drive.boot()
        if path.name.startswith("ingenia"):
            self.write(0x6073, 0, 1000, 2)
