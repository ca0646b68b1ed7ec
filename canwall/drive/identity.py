"""Identity of a drive: device type and 0x1018, compared with its object dictionary."""

from dataclasses import dataclass

from canwall.drive import objects as od
from canwall.drive.node import DriveError, DriveNode

_DRIVE_PROFILE = 402
_PARTS = {1: "vendor-ID", 2: "product code", 3: "revision number", 4: "serial number"}
#: Parts that differ if the dictionary is another drive's, or another firmware's.
_OF_FILE = {1: "drive", 2: "drive", 3: "firmware"}


@dataclass(frozen=True)
class Identity:
    """Identity of a drive.

    Attributes:
        device_type: 0x1000.
        numbers: Values in 0x1018, by sub-index.
        doubts: Lines about disagreements with the object dictionary.
    """

    device_type: int
    numbers: dict[int, int]
    doubts: tuple[str, ...] = ()

    def __str__(self) -> str:
        parts = [f"{_PARTS[i]} {value:#x}" for i, value in self.numbers.items()]
        return ", ".join([f"device type {self.device_type:#x}", *parts])


def identify(node: DriveNode) -> Identity:
    """Read the identity. Raises DriveError if the device has another profile than CiA 402."""
    device_type = node.read(od.DEVICE_TYPE)
    profile = device_type & 0xFFFF
    if profile not in (_DRIVE_PROFILE, 0):
        raise DriveError(
            f"node {node.node_id}, 0x1000 = {device_type:#x}: device profile {profile}, not the "
            f"402 of a drive; is drive.node_id right?"
        )
    numbers = {i: node.read(od.IDENTITY, i) for i in _PARTS if node.has(od.IDENTITY, i)}
    doubts = []
    if not profile:
        doubts.append("0x1000 names no device profile: assumed to be a drive")
    found = {(od.DEVICE_TYPE, 0): ("device type", device_type, "drive")} | {
        (od.IDENTITY, i): (_PARTS[i], numbers[i], whose)
        for i, whose in _OF_FILE.items()
        if i in numbers
    }
    for key, (name, value, whose) in found.items():
        variable = node.dictionary.get_variable(*key)
        expected = variable.default if variable is not None else None
        if value and expected and value != expected:
            doubts.append(
                f"{name} {value:#x}, but {expected:#x} in drive.eds: is it this {whose}'s file?"
            )
    return Identity(device_type, numbers, tuple(doubts))
