"""Set-up of the PDOs: mapping written in the order of CiA 301, read back, laid out for the cycle.

A drive whose mapping cannot be written is used as it is, if one of its PDOs carries what the cycle
needs.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from canwall.compiled import data_to_number
from canwall.drive import objects as od
from canwall.drive.node import DriveError, DriveNode

_INVALID = 1 << 31
_EXTENDED = 1 << 29
_CAN_ID = 0x7FF
_MAPPING_OFFSET = 0x200
_MAX_BITS = 64
#: Indices below are data types; a mapping entry with one is a gap.
_FIRST_OBJECT = 0x1000

#: Transmission types: every SYNC; on reception (first profile, then manufacturer specific).
EVERY_SYNC = 1
ON_RECEPTION = (255, 254)
_SYNCHRONOUS = range(0, 241)

_INHIBIT_TIME = 3
_EVENT_TIMER = 5


class MappingError(DriveError):
    """A drive that accepts a mapping and then has another one."""


@dataclass(frozen=True)
class Field:
    """Position of an object in the data of a PDO, read as one little-endian number."""

    index: int
    subindex: int
    shift: int
    bits: int

    def __str__(self) -> str:
        return f"0x{self.index:04X}:{self.subindex:02X} ({self.bits} bits)"


@dataclass(frozen=True)
class PdoLayout:
    """One PDO as the drive confirmed it.

    Attributes:
        cob_id: CAN-ID.
        fields: Mapped objects, in order.
        communication: Index of its communication parameter.
        constant: Values of the other objects in an RPDO with a fixed mapping, as a number that is
            or-ed with controlword and torque.
    """

    cob_id: int
    fields: tuple[Field, ...]
    communication: int = 0
    constant: int = 0

    @property
    def length(self) -> int:
        """Length of the frame's data in bytes."""
        return (sum(field.bits for field in self.fields) + 7) // 8

    def field(self, index: int) -> Field | None:
        """Return the field of this object (sub-index 0), None if the PDO does not carry it."""
        return next((f for f in self.fields if (f.index, f.subindex) == (index, 0)), None)

    def carries(self, objects: Sequence[int]) -> bool:
        """Return whether the PDO carries all of these objects."""
        return all(self.field(index) is not None for index in objects)


def configure_tpdo(
    node: DriveNode, needed: Sequence[int], wanted: Sequence[int], notes: list[str]
) -> PdoLayout:
    """Set up a TPDO with these objects, sent with every SYNC.

    Args:
        node: The drive.
        needed: Indices of the objects that it has to carry.
        wanted: Indices of objects to add if there is room for them.
        notes: Extended by what the drive refuses and the cycle does not need.

    Raises:
        DriveError: If no TPDO can carry the needed objects.
    """
    choices = _mapping_choices(node, needed, wanted)
    layout = _map_pdo(node, od.TPDO_COMMUNICATION, choices, notes)
    _set_times(node, layout.communication, notes)
    node.change(layout.communication, 2, EVERY_SYNC)
    node.confirm(layout.communication, 2, EVERY_SYNC)
    return _switch_on(node, layout)


def configure_rpdo(
    node: DriveNode, needed: Sequence[int], immediate: bool, notes: list[str]
) -> PdoLayout:
    """Set up an RPDO with these objects, effective at the SYNC or on reception.

    Args:
        node: The drive.
        needed: Indices of the objects that it has to carry.
        immediate: Effective on reception.
        notes: Extended by what the drive refuses and the cycle does not need.

    Raises:
        DriveError: If no RPDO can carry the objects, or none in the way it is to be effective.
    """
    layout = _map_pdo(node, od.RPDO_COMMUNICATION, [list(needed)], notes)
    _set_times(node, layout.communication, notes)
    _set_effect(node, layout.communication, immediate)
    return _switch_on(node, layout)


@contextmanager
def while_off(node: DriveNode, communication: int) -> Iterator[None]:
    """Switch a PDO off for the duration of the context, so that its parameters can change."""
    cob_id = node.read(communication, 1)
    switched_off = not cob_id & _INVALID and _switch_off(node, communication, cob_id)
    try:
        yield
    finally:
        if switched_off:
            node.change(communication, 1, cob_id)


def _switch_off(node: DriveNode, communication: int, cob_id: int) -> bool:
    """Set bit 31 of a COB-ID; return False if the drive refuses.

    Drives with fixed COB-IDs (Elmo SimplIQ) take other changes while the PDO is valid.
    """
    try:
        # The other bits stay as they are: some drives refuse to clear bit 30.
        node.change(communication, 1, cob_id | _INVALID)
    except DriveError:
        return False
    return True


def _mapping_choices(
    node: DriveNode, needed: Sequence[int], wanted: Sequence[int]
) -> list[list[int]]:
    """Return the possible mappings, the fullest first."""
    chosen = list(needed)
    choices = [chosen]
    for index in wanted:
        variable = node.dictionary.get_variable(index, 0)
        if variable is None or not variable.pdo_mappable:
            continue
        extended = [*choices[0], index]
        if sum(_entry(node, i) & 0xFF for i in extended) <= _MAX_BITS:
            choices.insert(0, extended)
    return choices


def _map_pdo(node: DriveNode, first: int, choices: list[list[int]], notes: list[str]) -> PdoLayout:
    """Map the first PDO with the fullest mapping that the drive accepts, else find a fixed one.

    A PDO whose mapping was written is left switched off.
    """
    refusals: list[DriveError] = []
    for objects in choices:
        try:
            layout = _write_mapping(node, first, objects)
        except MappingError:
            raise
        except DriveError as error:
            refusals.append(error)
            continue
        if refusals:
            notes.append(f"mapped less than there is room for: {refusals[-1]}")
        return layout
    needed = choices[-1]
    present = list(_read_pdos(node, first))
    for layout in present:
        if layout.carries(needed):
            notes.append(f"0x{layout.communication:04X} is used as the drive has it: {refusals[0]}")
            return layout
    # The last refusal is that of the smallest mapping.
    raise DriveError(f"{refusals[-1]}; {_missing_objects(first, needed, present)}")


def _missing_objects(first: int, needed: Sequence[int], present: Sequence[PdoLayout]) -> str:
    kind = "TPDO" if first == od.TPDO_COMMUNICATION else "RPDO"
    wanted = " and ".join(f"0x{index:04X}" for index in needed)
    best = max(present, key=lambda pdo: sum(pdo.field(i) is not None for i in needed), default=None)
    if best is None:
        return f"no {kind} has a mapping"
    lacking = ", ".join(f"0x{i:04X}" for i in needed if best.field(i) is None)
    return (
        f"no {kind} as the drive has them carries {wanted}: "
        f"0x{best.communication + _MAPPING_OFFSET:04X} lacks {lacking}"
    )


def _write_mapping(node: DriveNode, communication: int, objects: list[int]) -> PdoLayout:
    # CiA 301, 7.5.2.36: switch the PDO off, empty the mapping, write it, set its length.
    mapping = communication + _MAPPING_OFFSET
    entries = [_entry(node, index) for index in objects]
    cob_id = node.read(communication, 1)
    _switch_off(node, communication, cob_id)
    node.change(mapping, 0, 0)
    for position, entry in enumerate(entries, start=1):
        node.change(mapping, position, entry, size=4)
    node.change(mapping, 0, len(entries))
    found = _read_mapping(node, mapping)
    if found != entries:
        shown = ", ".join(f"{entry:#010x}" for entry in found)
        raise MappingError(f"node {node.node_id}, 0x{mapping:04X}: the drive maps {shown} instead")
    return _layout(communication, cob_id, found)


def _entry(node: DriveNode, index: int) -> int:
    variable = node.dictionary.get_variable(index, 0)
    if variable is None:
        raise DriveError(f"0x{index:04X}: not in the object dictionary, so no PDO can carry it")
    return index << 16 | len(variable)


def _read_mapping(node: DriveNode, mapping: int) -> list[int]:
    return [node.read(mapping, i) for i in range(1, node.read(mapping, 0) + 1)]


def _layout(communication: int, cob_id: int, entries: Sequence[int]) -> PdoLayout:
    fields = []
    shift = 0
    for entry in entries:
        bits = entry & 0xFF
        fields.append(Field(entry >> 16, entry >> 8 & 0xFF, shift, bits))
        shift += bits
    return PdoLayout(cob_id & _CAN_ID, tuple(fields), communication)


def _read_pdos(node: DriveNode, first: int) -> Iterator[PdoLayout]:
    """Read the PDOs of one direction as the drive has them."""
    for communication in range(first, first + _MAPPING_OFFSET):
        mapping = communication + _MAPPING_OFFSET
        if node.has(communication, 1) and node.has(mapping):
            cob_id = node.read(communication, 1)
            yield _layout(communication, cob_id, _read_mapping(node, mapping))


def tpdos_on_sync(node: DriveNode) -> list[PdoLayout]:
    """Return all TPDOs that the drive sends with every or some SYNCs. Raises DriveError."""
    return [
        layout
        for layout in _read_pdos(node, od.TPDO_COMMUNICATION)
        if not node.read(layout.communication, 1) & _INVALID
        and 1 <= node.read(layout.communication, 2) < _SYNCHRONOUS.stop
    ]


def _set_times(node: DriveNode, communication: int, notes: list[str]) -> None:
    """Clear inhibit time and event timer, so that SYNC alone sets the pace."""
    for subindex, name in ((_INHIBIT_TIME, "inhibit time"), (_EVENT_TIMER, "event timer")):
        if not node.has(communication, subindex):
            continue
        found = node.read(communication, subindex)
        if found == 0:
            continue
        try:
            node.set(communication, subindex, 0)
        except DriveError as error:
            unit = 0.1 if subindex == _INHIBIT_TIME else 1.0
            notes.append(
                f"0x{communication:04X}:{subindex:02X}: the {name} stays at {found * unit:g} ms; a "
                f"drive that applies it to synchronous TPDOs will skip some of them ({error})"
            )


def _set_effect(node: DriveNode, communication: int, immediate: bool) -> None:
    """Make an RPDO effective at the SYNC or on reception, as `[drive] torque_pdo` says."""
    found = node.read(communication, 2)
    if immediate:
        types: tuple[int, ...] = ON_RECEPTION
        suitable = found in ON_RECEPTION
    else:
        types = (EVERY_SYNC, 0)
        suitable = found in _SYNCHRONOUS
    refusals = []
    for wanted in types:
        try:
            node.set(communication, 2, wanted)
        except DriveError as error:
            refusals.append(error)
        else:
            return
    if not suitable:
        other = "sync" if immediate else "immediate"
        raise DriveError(f'{refusals[0]}; try drive.torque_pdo = "{other}"')


def _switch_on(node: DriveNode, layout: PdoLayout) -> PdoLayout:
    """Switch a PDO on and return its layout as the drive confirms it."""
    communication = layout.communication
    cob_id = node.read(communication, 1)
    if cob_id & _EXTENDED:
        raise DriveError(
            f"node {node.node_id}, 0x{communication:04X}:01 = {cob_id:#x}: a 29-bit identifier; "
            f"give the PDO an 11-bit one"
        )
    if not cob_id & _CAN_ID:
        raise DriveError(
            f"node {node.node_id}, 0x{communication:04X}:01 = {cob_id:#x}: the PDO has no "
            f"identifier; give it one"
        )
    if cob_id & _INVALID:
        node.change(communication, 1, cob_id & ~_INVALID)
        if node.read(communication, 1) & _INVALID:
            raise DriveError(f"node {node.node_id}, 0x{communication:04X}:01: the PDO stays off")
    mapping = communication + _MAPPING_OFFSET
    confirmed = _layout(communication, cob_id, _read_mapping(node, mapping))
    if confirmed.fields != layout.fields:
        raise DriveError(f"node {node.node_id}, 0x{mapping:04X}: the mapping changed meanwhile")
    return confirmed


def with_constant(node: DriveNode, rpdo: PdoLayout, commanded: Sequence[int]) -> PdoLayout:
    """Return an RPDO whose other fields, e.g. a mode or a limit, repeat the drive's own values.

    commanded: indices of the objects that the cycle writes. Raises DriveError.
    """
    constant = 0
    for field in rpdo.fields:
        if field.index < _FIRST_OBJECT or (field.index in commanded and field.subindex == 0):
            continue
        value = node.read(field.index, field.subindex)
        constant |= (value & (1 << field.bits) - 1) << field.shift
    data = constant.to_bytes(rpdo.length, "little")
    return PdoLayout(rpdo.cob_id, rpdo.fields, rpdo.communication, data_to_number(data))
