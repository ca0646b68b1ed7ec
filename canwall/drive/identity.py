"""Who answers: device type and identity (0x1000, 0x1018), against what the dictionary expects."""

from dataclasses import dataclass

from canwall.drive import objects as od
from canwall.drive.node import DriveError, DriveNode

_DRIVE_PROFILE = 402
_PARTS = {1: "vendor-ID", 2: "product code", 3: "revision number", 4: "serial number"}
#: What has to be the dictionary's for it to be this drive's at all.
_VENDOR, _PRODUCT = 1, 2


@dataclass(frozen=True)
class Identity:
    """Device type, and sub-indices of 0x1018 that the drive has; doubts about the dictionary."""

    device_type: int
    numbers: dict[int, int]
    doubts: tuple[str, ...] = ()

    def __str__(self) -> str:
        parts = [f"{_PARTS[i]} {value:#x}" for i, value in self.numbers.items()]
        return ", ".join([f"device type {self.device_type:#x}", *parts])


def identify(node: DriveNode) -> Identity:
    """Read who it is. Raises DriveError for a device that says it is no drive."""
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
        doubts.append("0x1000 names no device profile: taken for a drive")
    for part in (_VENDOR, _PRODUCT):
        variable = node.dictionary.get_variable(od.IDENTITY, part)
        expected = variable.default if variable is not None else None
        if expected and part in numbers and numbers[part] != expected:
            doubts.append(
                f"{_PARTS[part]} {numbers[part]:#x}, but {expected:#x} in drive.eds: is it this "
                f"drive's file?"
            )
    return Identity(device_type, numbers, tuple(doubts))
