"""Receive and transmit PDOs: communication and mapping parameter (CiA 301, 7.5.2.35 to 7.5.2.38).

The order that CiA 301 prescribes is kept: COB-ID invalid (bit 31), number of mapped objects 0,
mapping entries, number of mapped objects, COB-ID valid. Anything else gets DEVICE_STATE, except
that power-on values may be written back, and that the mapping of a PDO whose COB-ID cannot be
written changes while it is valid.

The file of a drive may map objects by default that are not served here. They are gaps: zeros in a
TPDO, ignored in an RPDO.
"""

from collections.abc import Callable
from struct import Struct

from canwall.bus.can_ids import EMCY, SYNC, TIME
from canwall.simdrive.communication.abort import AbortCode, AccessError
from canwall.simdrive.communication.cob_id import (
    CAN_ID,
    NOT_VALID,
    check_can_id,
    check_unchanged_while_valid,
)
from canwall.simdrive.communication.dictionary import Dictionary, Entry, StateEntry
from canwall.simdrive.state import DriveRecord

CYCLIC = range(1, 241)
ACYCLIC = 0
SYNCHRONOUS_REMOTE, EVENT_DRIVEN_REMOTE = 252, 253
"""Sent when a remote frame asks for it, and then alone."""
EVENT_DRIVEN = (254, 255)
_TRANSMISSION_TYPES = frozenset((ACYCLIC, *CYCLIC, *EVENT_DRIVEN))
"""241 to 251 are reserved."""

MAX_BYTES = 8
MAPPING_OFFSET = 0x200


class Pdo:
    """One PDO. While active, its mapping is compiled: a struct, and the entries that it holds."""

    transmit: bool
    """Direction, as the subclass has it."""
    communication: range
    """Indices of the communication parameters in this direction."""

    def __init__(
        self,
        dictionary: Dictionary,
        index: int,
        state: DriveRecord,
        changed: Callable[[], None],
    ) -> None:
        """Serve one pair of objects.

        Args:
            dictionary: has the entries.
            index: of the communication parameter.
            state: of the drive.
            changed: called when the PDO became active or inactive, or moved.

        Raises:
            DictionaryError: the EDS lacks a part of the PDO, or maps what cannot be mapped.
        """
        mapping = index + MAPPING_OFFSET
        for key in ((index, 1), (index, 2), (mapping, 0)):
            if key not in dictionary:
                raise dictionary.error(*key, "missing")
        self._dictionary = dictionary
        self._changed = changed
        self.number = index - self.communication.start
        """Place among the PDOs of its direction, from 0."""
        self._record, self._state = state.record, state.fields
        self._pdo = (self._state.tpdos if self.transmit else self._state.rpdos)[self.number]
        self._cob_id = dictionary.number(index, 1, absent=NOT_VALID)
        self._type = dictionary.number(index, 2, absent=255)
        remote = (SYNCHRONOUS_REMOTE, EVENT_DRIVEN_REMOTE) if self.transmit else ()
        self._type.allow(_TRANSMISSION_TYPES.union(remote))
        self._event_time = dictionary.number(index, 5, absent=0)
        self._others = (
            dictionary.number(0x1005, absent=SYNC),
            dictionary.number(0x1012, absent=TIME),
            dictionary.number(0x1014, absent=EMCY + dictionary.node_id),
        )
        self._count = dictionary.number(mapping, 0, absent=0)
        self._mapping = [
            dictionary.number(mapping, subindex, absent=0)
            for subindex in range(1, 65)
            if (mapping, subindex) in dictionary
        ]
        self._unserved = {entry.default for entry in self._mapping if self._is_unserved(entry)}
        self._cob_id.check = self._check_cob_id
        self._count.check = self._check_count
        for entry in self._mapping:
            entry.check = self._check_mapping
        for entry in (self._cob_id, self._type, self._event_time, self._count):
            entry.react = self._react
        try:
            self.configure()
        except AccessError as abort:
            raise dictionary.error(mapping, 0, f"maps what cannot be mapped: {abort}") from abort

    @property
    def can_id(self) -> int:
        """CAN-ID of the PDO."""
        can_id: int = self._cob_id.value & CAN_ID
        return can_id

    @property
    def valid(self) -> bool:
        """True if bit 31 of the COB-ID is clear."""
        return not self._cob_id.value & NOT_VALID

    @property
    def active(self) -> bool:
        """True if the PDO is valid and carries something."""
        return self.valid and self._count.value > 0

    @property
    def synchronous(self) -> bool:
        """True if SYNC triggers the PDO."""
        return self._type.value not in (EVENT_DRIVEN_REMOTE, *EVENT_DRIVEN)

    @property
    def in_state(self) -> bool:
        """True if the drive's record has all that it carries."""
        return bool(self._pdo.field_count == len(self._entries))

    def configure(self) -> None:
        """Compile the mapping of an active PDO; called whenever a parameter has changed.

        Raises:
            AccessError: the mapping is not possible. What is written was checked before, so only
                the power-on values can be wrong.
        """
        objects = self._compile(self._count.value if self.active else 0)
        self._struct = Struct("<" + "".join(form for form, _ in objects))
        self._entries = [entry for _, entry in objects if entry is not None]
        self._lay_out(objects)

    def _lay_out(self, objects: list[tuple[str, Entry | None]]) -> None:
        """Write to the record where the objects are in the data, as far as it has them."""
        pdo = self._pdo
        pdo.can_id, pdo.length = self.can_id, self._struct.size
        shift = count = 0
        for form, entry in objects:
            bits = 8 * Struct("<" + form).size
            if isinstance(entry, StateEntry):
                field = pdo.fields[count]
                field.place, field.shift, field.bits = entry.place, shift, bits
                count += 1
            shift += bits
        pdo.field_count = count

    def _compile(self, count: int) -> list[tuple[str, Entry | None]]:
        """Return struct format and entry (None: dummy) of the first ``count`` mapped objects."""
        if count > len(self._mapping):
            raise AccessError(AbortCode.TOO_HIGH)
        objects = [self._resolve(mapped.value) for mapped in self._mapping[:count]]
        if Struct("<" + "".join(form for form, _ in objects)).size > MAX_BYTES:
            raise AccessError(AbortCode.PDO_LENGTH)
        return objects

    def _resolve(self, mapped: int) -> tuple[str, Entry | None]:
        """Return format and entry of a mapping value (index, sub-index, bits); None: a gap."""
        index, subindex, bits = mapped >> 16, mapped >> 8 & 0xFF, mapped & 0xFF
        if mapped in self._unserved:
            return f"{bits // 8}x", None
        dummy_size = self._dictionary.dummies.get(index)
        if dummy_size is not None and subindex == 0 and not self.transmit:
            if bits != 8 * dummy_size:
                raise AccessError(AbortCode.NOT_MAPPABLE)
            return f"{dummy_size}x", None
        entry = self._dictionary.find(index, subindex)
        allowed = entry.transmittable if self.transmit else entry.receivable
        form = entry.pdo_format
        if not allowed or form is None or entry.size is None or bits != 8 * entry.size:
            raise AccessError(AbortCode.NOT_MAPPABLE)
        return form, entry

    def _is_unserved(self, entry: Entry) -> bool:
        """Return True for a mapping of the file, in whole bytes, that cannot be served."""
        self._unserved = set()
        try:
            self._resolve(entry.default)
        except AccessError:
            return bool(entry.default and not entry.default & 7)
        return False

    def _check_cob_id(self, value: int) -> None:
        check_can_id(value, {SYNC, *(other.value & CAN_ID for other in self._others)})
        check_unchanged_while_valid(self._cob_id.value, value)
        if not value & NOT_VALID:
            begins_empty = not (self._cob_id.default & NOT_VALID or self._count.default)
            if not self._count.value and not begins_empty:
                raise AccessError(AbortCode.DEVICE_STATE)
            self._compile(self._count.value)

    def _check_count(self, value: int) -> None:
        self._check_not_valid()
        self._compile(value)

    def _check_mapping(self, value: int) -> None:
        self._check_not_valid()
        if self._count.value:
            raise AccessError(AbortCode.DEVICE_STATE)
        if value:  # 0 empties a place
            self._resolve(value)

    def _check_not_valid(self) -> None:
        if self.valid and "w" in self._cob_id.access:
            raise AccessError(AbortCode.DEVICE_STATE)

    def _react(self, _: int) -> None:
        self.configure()
        self._changed()
