"""PDO set-up: mapping written in the order of CiA 301, read back, and laid out for the cycle.

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
#: Indices below are data types: a mapping of one skips its bits.
_FIRST_OBJECT = 0x1000

#: Transmission types: with every SYNC; on reception (device and profile specific, then
#: manufacturer specific).
EVERY_SYNC = 1
ON_RECEPTION = (255, 254)
_SYNCHRONOUS = range(0, 241)

_INHIBIT_TIME = 3
_EVENT_TIMER = 5


class MappingError(DriveError):
    """A drive that maps something else than it was told, and says nothing of it."""


@dataclass(frozen=True)
class Field:
    """Where an object lies in the data of a PDO, taken as one little-endian number."""

    index: int
    subindex: int
    shift: int
    bits: int

    def __str__(self) -> str:
        return f"0x{self.index:04X}:{self.subindex:02X} ({self.bits} bits)"


@dataclass(frozen=True)
class PdoLayout:
    """One PDO as the drive confirmed it: identifier, fields, length in bytes.

    communication: index of its communication parameter.
    constant: what an RPDO that the drive has fixed carries besides controlword and torque, as a
    number that the cycle's own is or-ed with.
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
        """The field that carries this object (its sub-index 0), if the PDO has it."""
        return next((f for f in self.fields if (f.index, f.subindex) == (index, 0)), None)

    def carries(self, objects: Sequence[int]) -> bool:
        """Whether all of these objects are in it."""
        return all(self.field(index) is not None for index in objects)


def configure_tpdo(
    node: DriveNode, needed: Sequence[int], wanted: Sequence[int], notes: list[str]
) -> PdoLayout:
    """Have a TPDO send these objects on every SYNC, of those wanted as many as it has room for.

    notes takes what the drive would not do and the cycle can live without. Raises DriveError.
    """
    choices = _choices(node, needed, wanted)
    layout = _mapped(node, od.TPDO_COMMUNICATION, choices, notes)
    _set_times(node, layout.communication, notes)
    node.change(layout.communication, 2, EVERY_SYNC)
    node.confirm(layout.communication, 2, EVERY_SYNC)
    return _switched_on(node, layout)


def configure_rpdo(
    node: DriveNode, needed: Sequence[int], immediate: bool, notes: list[str]
) -> PdoLayout:
    """Have an RPDO carry these objects, effective at the SYNC or on reception.

    notes as for configure_tpdo. Raises DriveError.
    """
    layout = _mapped(node, od.RPDO_COMMUNICATION, [list(needed)], notes)
    _set_times(node, layout.communication, notes)
    _set_effect(node, layout.communication, immediate)
    return _switched_on(node, layout)


@contextmanager
def while_off(node: DriveNode, communication: int) -> Iterator[None]:
    """A PDO switched off meanwhile, where it is on: only then may its parameters change."""
    cob_id = node.read(communication, 1)
    if cob_id & _INVALID:
        yield
        return
    node.change(communication, 1, cob_id | _INVALID)
    try:
        yield
    finally:
        node.change(communication, 1, cob_id)


def _choices(node: DriveNode, needed: Sequence[int], wanted: Sequence[int]) -> list[list[int]]:
    """What to map, the fullest first."""
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


def _mapped(node: DriveNode, first: int, choices: list[list[int]], notes: list[str]) -> PdoLayout:
    """The first PDO with the fullest mapping that the drive takes; else a fixed one that will do.

    It is left switched off where its mapping was written.
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
    present = list(_present(node, first))
    for layout in present:
        if layout.carries(needed):
            notes.append(f"0x{layout.communication:04X} is used as the drive has it: {refusals[0]}")
            return layout
    # Of those that could be tried, the last one asked for the least.
    raise DriveError(f"{refusals[-1]}; {_missing(first, needed, present)}")


def _missing(first: int, needed: Sequence[int], present: Sequence[PdoLayout]) -> str:
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
    # CiA 301, 7.5.2.36: switch the PDO off, empty the mapping, write it, set its length. All other
    # bits of the COB-ID stay as the drive has them: some refuse to lose bit 30.
    mapping = communication + _MAPPING_OFFSET
    entries = [_entry(node, index) for index in objects]
    cob_id = node.read(communication, 1)
    node.change(communication, 1, cob_id | _INVALID)
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


def _present(node: DriveNode, first: int) -> Iterator[PdoLayout]:
    """The PDOs of one direction as the drive has them."""
    for communication in range(first, first + _MAPPING_OFFSET):
        mapping = communication + _MAPPING_OFFSET
        if node.has(communication, 1) and node.has(mapping):
            cob_id = node.read(communication, 1)
            yield _layout(communication, cob_id, _read_mapping(node, mapping))


def tpdos_on_sync(node: DriveNode) -> list[PdoLayout]:
    """All TPDOs that the drive sends with SYNCs, every one or some. Raises DriveError."""
    return [
        layout
        for layout in _present(node, od.TPDO_COMMUNICATION)
        if not node.read(layout.communication, 1) & _INVALID
        and 1 <= node.read(layout.communication, 2) < _SYNCHRONOUS.stop
    ]


def _set_times(node: DriveNode, communication: int, notes: list[str]) -> None:
    """Neither inhibit time nor event timer: SYNC alone sets the pace."""
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
                f"drive that heeds it with every SYNC too will leave TPDOs out ({error})"
            )


def _set_effect(node: DriveNode, communication: int, immediate: bool) -> None:
    """RPDO at the SYNC, or on reception, as `[drive] torque_pdo` wants it."""
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
        raise DriveError(f'{refusals[0]}; drive.torque_pdo = "{other}" may be what it has')


def _switched_on(node: DriveNode, layout: PdoLayout) -> PdoLayout:
    communication = layout.communication
    cob_id = node.read(communication, 1)
    if cob_id & _EXTENDED:
        raise DriveError(
            f"node {node.node_id}, 0x{communication:04X}:01 = {cob_id:#x}: a 29-bit identifier; "
            f"give the PDO one of 11 bits"
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
    """An RPDO whose other fields (a mode, a limit) repeat what the drive has in these objects."""
    constant = 0
    for field in rpdo.fields:
        if field.index < _FIRST_OBJECT or (field.index in commanded and field.subindex == 0):
            continue
        value = node.read(field.index, field.subindex)
        constant |= (value & (1 << field.bits) - 1) << field.shift
    data = constant.to_bytes(rpdo.length, "little")
    return PdoLayout(rpdo.cob_id, rpdo.fields, rpdo.communication, data_to_number(data))
