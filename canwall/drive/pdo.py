"""PDO set-up: mapping written in the order of CiA 301, read back, and laid out for the cycle."""

from collections.abc import Sequence
from dataclasses import dataclass

from canwall.drive.node import DriveError, DriveNode
from canwall.drive.objects import (
    RPDO_COMMUNICATION,
    RPDO_MAPPING,
    TPDO_COMMUNICATION,
    TPDO_MAPPING,
)

_INVALID = 1 << 31
_COB_ID = 0x7FF

#: Transmission type of a PDO that follows every SYNC.
EVERY_SYNC = 1

_INHIBIT_TIME = 3
_EVENT_TIMER = 5


@dataclass(frozen=True)
class Field:
    """Where an object lies in the data of a PDO, taken as one little-endian number."""

    index: int
    subindex: int
    shift: int
    bits: int


@dataclass(frozen=True)
class PdoLayout:
    """One PDO as the drive confirmed it: identifier, fields, length in bytes."""

    cob_id: int
    fields: tuple[Field, ...]

    @property
    def length(self) -> int:
        """Length of the frame's data in bytes."""
        return (sum(field.bits for field in self.fields) + 7) // 8

    def field(self, index: int) -> Field | None:
        """The field that carries this object, if the PDO has it."""
        return next((field for field in self.fields if field.index == index), None)


def configure_tpdo(node: DriveNode, number: int, objects: Sequence[int]) -> PdoLayout:
    """Have TPDO `number` (1 …) send these objects on every SYNC. Raises DriveError."""
    offset = number - 1
    return _configure(node, TPDO_COMMUNICATION + offset, TPDO_MAPPING + offset, objects)


def configure_rpdo(node: DriveNode, number: int, objects: Sequence[int]) -> PdoLayout:
    """Have RPDO `number` (1 …) carry these objects, effective at the SYNC. Raises DriveError."""
    offset = number - 1
    return _configure(node, RPDO_COMMUNICATION + offset, RPDO_MAPPING + offset, objects)


def _configure(
    node: DriveNode, communication: int, mapping: int, objects: Sequence[int]
) -> PdoLayout:
    # CiA 301, 7.5.2.36: switch the PDO off, empty the mapping, write it, set its length, switch
    # on. All other bits of the COB-ID stay as the drive has them: some refuse to lose bit 30.
    cob_id = node.read(communication, 1)
    node.write(communication, 1, cob_id | _INVALID)
    node.write(mapping, 0, 0)
    entries = [_entry(node, index) for index in objects]
    for position, entry in enumerate(entries, start=1):
        node.write(mapping, position, entry, size=4)
    node.write(mapping, 0, len(entries))
    node.write_confirmed(communication, 2, EVERY_SYNC)
    for subindex in (_INHIBIT_TIME, _EVENT_TIMER):
        if node.has(communication, subindex) and node.read(communication, subindex) != 0:
            node.write_confirmed(communication, subindex, 0)
    node.write(communication, 1, cob_id & ~_INVALID)
    return _read_back(node, communication, mapping, entries)


def _entry(node: DriveNode, index: int) -> int:
    variable = node.dictionary.get_variable(index, 0)
    if variable is None:
        raise DriveError(f"0x{index:04X}: not in the object dictionary, so no PDO can carry it")
    return index << 16 | len(variable)


def _read_back(node: DriveNode, communication: int, mapping: int, wanted: list[int]) -> PdoLayout:
    found = [node.read(mapping, i) for i in range(1, node.read(mapping, 0) + 1)]
    if found != wanted:
        shown = ", ".join(f"{entry:#010x}" for entry in found)
        raise DriveError(f"node {node.node_id}, 0x{mapping:04X}: the drive maps {shown} instead")
    cob_id = node.read(communication, 1)
    if cob_id & _INVALID:
        raise DriveError(f"node {node.node_id}, 0x{communication:04X}:01: the PDO stays off")
    fields = []
    shift = 0
    for entry in found:
        bits = entry & 0xFF
        fields.append(Field(entry >> 16, entry >> 8 & 0xFF, shift, bits))
        shift += bits
    return PdoLayout(cob_id & _COB_ID, tuple(fields))
