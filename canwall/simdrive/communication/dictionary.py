"""The object dictionary (CiA 301, 7.4): a flat table of typed entries, from an EDS or DCF."""

from collections.abc import Callable, Container, Iterator
from pathlib import Path
from struct import Struct
from typing import Any, TypeAlias

import canopen
from canopen.objectdictionary import ODVariable, datatypes

from canwall.eds import DictionaryError, load_eds
from canwall.simdrive.communication.abort import AbortCode, AccessError
from canwall.simdrive.state import OBJECTS, DriveRecord

MANDATORY = {
    0x1000: ("device type", datatypes.UNSIGNED32),
    0x1001: ("error register", datatypes.UNSIGNED8),
    0x1018: ("identity object", datatypes.UNSIGNED8),
    0x6040: ("controlword", datatypes.UNSIGNED16),
    0x6041: ("statusword", datatypes.UNSIGNED16),
    0x6060: ("modes of operation", datatypes.INTEGER8),
    0x6061: ("modes of operation display", datatypes.INTEGER8),
    0x6064: ("position actual value", datatypes.INTEGER32),
    0x6071: ("target torque", datatypes.INTEGER16),
    0x6077: ("torque actual value", datatypes.INTEGER16),
}
"""Objects without which there is no torque drive: name and CiA 301 data type of sub-index 0."""

Key: TypeAlias = tuple[int, int]
"""(index, sub-index)."""

_FIRST_OBJECT = 0x1000
_COMMUNICATION_PROFILE = range(0x1000, 0x2000)


class Entry:
    """One sub-index: its description in the EDS, its present value, and its service.

    ``value`` is an int, a float or (strings and domains) bytes; None: there is none yet.
    ``check`` sees a value before it is stored and raises AccessError to refuse it; ``react`` sees
    it afterwards. Both act on writes from the bus only; the device itself assigns ``value``.
    """

    __slots__ = (
        "access",
        "check",
        "codec",
        "default",
        "high",
        "index",
        "low",
        "pdo_mapping",
        "react",
        "subindex",
        "value",
    )

    def __init__(
        self,
        index: int,
        subindex: int,
        codec: Struct | None,
        default: Any,
        access: str = "rw",
        pdo_mapping: bool = False,
        low: int | None = None,
        high: int | None = None,
    ) -> None:
        """Describe an entry; ``codec`` is None for strings and domains."""
        self.index = index
        self.subindex = subindex
        self.codec = codec
        self.default = default
        self.access = access
        self.pdo_mapping = pdo_mapping
        self.low = low
        self.high = high
        self.value: Any = default
        self.check: Callable[[Any], None] | None = None
        self.react: Callable[[Any], None] | None = None

    @property
    def key(self) -> Key:
        """(index, sub-index)."""
        return self.index, self.subindex

    @property
    def size(self) -> int | None:
        """Bytes of the value, None if it may have any length."""
        return self.codec.size if self.codec else None

    @property
    def pdo_format(self) -> str | None:
        """Format character for struct, None if no PDO can hold the type on byte boundaries."""
        # canopen's codecs for 24 to 56 bits are subclasses whose format is the next wider one.
        if type(self.codec) is not Struct or self.codec.format == "?":
            return None
        return self.codec.format.removeprefix("<")

    @property
    def receivable(self) -> bool:
        """True if an RPDO may carry it; rww is for process output only (CiA 306)."""
        return self.pdo_mapping and self.access in ("rw", "rww", "wo")

    @property
    def transmittable(self) -> bool:
        """True if a TPDO may carry it; rwr is for process input only (CiA 306)."""
        return self.pdo_mapping and self.access in ("ro", "rw", "rwr", "const")

    def allow(self, values: Container[int]) -> "Entry":
        """Let the bus write these values only; others get INVALID_VALUE. Returns the entry."""

        def check(value: int) -> None:
            if value not in values:
                raise AccessError(AbortCode.INVALID_VALUE)

        self.check = check
        return self

    def upload(self) -> bytes:
        """Return the value as it goes over the bus.

        Raises:
            AccessError: WRITE_ONLY, NO_DATA.
        """
        if self.access == "wo":
            raise AccessError(AbortCode.WRITE_ONLY)
        if self.value is None:
            raise AccessError(AbortCode.NO_DATA)
        return self.codec.pack(self.value) if self.codec else bytes(self.value)

    def check_download(self, size: int | None) -> None:
        """Refuse a download that cannot succeed, before its data have come.

        Args:
            size: bytes announced, None if unknown.

        Raises:
            AccessError: READ_ONLY, TOO_LONG, TOO_SHORT.
        """
        if "w" not in self.access:
            raise AccessError(AbortCode.READ_ONLY)
        if self.codec and size is not None and size != self.codec.size:
            raise AccessError(AbortCode.TOO_LONG if size > self.codec.size else AbortCode.TOO_SHORT)

    def download(self, data: bytes) -> None:
        """Write the value as it came over the bus.

        Raises:
            AccessError: as check_download() and write().
        """
        self.check_download(len(data))
        self.write(self.decode(data))

    def decode(self, data: bytes) -> Any:
        """Return the value that goes over the bus like this."""
        return self.codec.unpack(data)[0] if self.codec else data

    def write(self, value: Any) -> None:
        """Write a decoded value on behalf of the bus (SDO or RPDO).

        Raises:
            AccessError: TOO_LOW, TOO_HIGH, or what the service that checks the entry raises.
        """
        if self.low is not None and value < self.low:
            raise AccessError(AbortCode.TOO_LOW)
        if self.high is not None and value > self.high:
            raise AccessError(AbortCode.TOO_HIGH)
        if self.check is not None:
            self.check(value)
        self.value = value
        if self.react is not None:
            self.react(value)


class StateEntry(Entry):
    """An entry whose value stands in the drive's record, at `place` of its values."""

    __slots__ = ("_values", "place")

    def __init__(self, values: memoryview, place: int, entry: Entry) -> None:
        """Replace an entry that has no ``check`` or ``react`` yet."""
        self._values = values
        self.place = place
        super().__init__(
            entry.index,
            entry.subindex,
            entry.codec,
            entry.default,
            entry.access,
            entry.pdo_mapping,
            entry.low,
            entry.high,
        )
        self.value = entry.value

    @property
    def value(self) -> int:
        """Present value."""
        return self._values[self.place]

    @value.setter
    def value(self, value: int) -> None:
        self._values[self.place] = value


class Dictionary:
    """All entries by (index, sub-index), for one node-ID."""

    def __init__(self, source: str, node_id: int, variables: Iterator[ODVariable]) -> None:
        """Take the variables over; ``load`` is the usual way to get here.

        Raises:
            DictionaryError: a mandatory object is missing, or of the wrong type.
        """
        self.source = source
        self.node_id = node_id
        self._entries: dict[Key, Entry] = {}
        self._supplied: dict[Key, int] = {}
        self._power_on: dict[Key, int] = {}
        self._state: DriveRecord | None = None
        self.dummies: dict[int, int] = {}
        """Sizes in bytes of the data types that an RPDO may map to skip bytes ([DummyUsage])."""
        for variable in variables:
            if variable.index >= _FIRST_OBJECT:
                entry = self._entry(variable)
                self._entries[entry.key] = entry
            elif variable.data_type != datatypes.BOOLEAN:  # a single bit: PDOs here have bytes
                self.dummies[variable.index] = len(variable) // 8
        self._indices = {index for index, _ in self._entries}
        for index, (name, data_type) in MANDATORY.items():
            if (index, 0) not in self:
                raise self.error(index, 0, f"{name}: missing")
            if self[index, 0].codec is not ODVariable.STRUCT_TYPES[data_type]:
                raise self.error(index, 0, f"{name}: data type is not 0x{data_type:04X}")

    @classmethod
    def load(cls, path: str | Path, node_id: int) -> "Dictionary":
        """Read an EDS or DCF (CiA 306); a DCF's ParameterValue is the power-on value.

        Raises:
            DictionaryError: the file cannot be read or parsed, or lacks what a drive needs.
            ValueError: the node-ID is not in 1 to 127.
        """
        if not 1 <= node_id <= 127:
            raise ValueError(f"node-ID {node_id} is not in 1 to 127")
        od = load_eds(Path(path), node_id)
        return cls(str(path), node_id, _variables(od))

    def renumbered(self, node_id: int) -> "Dictionary":
        """Return the dictionary of the same device for another node-ID, with power-on values.

        Raises:
            DictionaryError: the file cannot be read any more.
        """
        other = Dictionary.load(self.source, node_id)
        for key, value in self._power_on.items():
            other.power_on_with(*key, value)
        for key, value in self._supplied.items():
            other.supply(*key, value)
        return other

    def __contains__(self, key: Key) -> bool:
        """Return True if the EDS has the sub-index."""
        return key in self._entries

    def __getitem__(self, key: Key) -> Entry:
        """Return the entry of (index, sub-index).

        Raises:
            KeyError: the EDS does not have it.
        """
        return self._entries[key]

    def __iter__(self) -> Iterator[Entry]:
        """Iterate over all entries."""
        return iter(self._entries.values())

    def find(self, index: int, subindex: int) -> Entry:
        """Return the entry that an SDO or a PDO mapping asks for.

        Raises:
            AccessError: NO_OBJECT, NO_SUBINDEX.
        """
        entry = self._entries.get((index, subindex))
        if entry is None:
            known = index in self._indices
            raise AccessError(AbortCode.NO_SUBINDEX if known else AbortCode.NO_OBJECT)
        return entry

    def supply(self, index: int, subindex: int, value: int) -> None:
        """Supply a property of the device that the EDS leaves out.

        It is the power-on value of an entry that has none or zero. Where there is no entry, it is
        what ``number`` returns to the services; the object stays absent from the bus.

        Raises:
            DictionaryError: the EDS lists it with a type that does not hold the value.
        """
        entry = self.number(index, subindex, absent=value)
        self._supplied[index, subindex] = value
        if (index, subindex) in self and not entry.default:
            try:
                entry.default = entry.value = _power_on_value(entry.codec, value)
            except OverflowError as error:
                raise self.error(index, subindex, f"cannot hold {value}") from error

    def power_on_with(self, index: int, subindex: int, value: int) -> None:
        """Give an entry another power-on value than the EDS does.

        Raises:
            DictionaryError: the EDS does not list it, or with a type that does not hold the value.
        """
        if (index, subindex) not in self:
            raise self.error(index, subindex, "is not there; simulation.objects cannot set it")
        entry = self.number(index, subindex, absent=value)
        if entry.codec is None or entry.codec.unpack(
            (value & (1 << 8 * entry.codec.size) - 1).to_bytes(entry.codec.size, "little")
        ) != (value,):
            raise self.error(index, subindex, f"cannot hold {value}")
        entry.default = entry.value = value
        self._power_on[index, subindex] = value

    def number(self, index: int, subindex: int = 0, *, absent: int) -> Entry:
        """Return an integer entry that a service works with.

        Args:
            index: object index.
            subindex: sub-index.
            absent: value where the EDS does not list it; such an entry is not on the bus.

        Raises:
            DictionaryError: the EDS lists it with another data type.
        """
        entry = self._entries.get((index, subindex))
        if entry is None:
            known = self._supplied.get((index, subindex), absent)
            return self._kept(Entry(index, subindex, None, known))
        if not isinstance(entry.default, int):
            raise self.error(index, subindex, "not an integer")
        return entry

    def keep_in(self, state: DriveRecord) -> None:
        """Let the values of `state.OBJECTS` stand in a drive's record from now on.

        Raises:
            DictionaryError: one of them is not an integer of up to 32 bits.
        """
        self._state = state
        for index in OBJECTS:
            if (index, 0) in self:
                entry = self.number(index, absent=0)
                if entry.size is None or entry.size > 4:
                    raise self.error(index, 0, "not an integer of up to 32 bits")
                self._entries[index, 0] = self._kept(entry)

    def _kept(self, entry: Entry) -> Entry:
        """Return the entry, or the one that stands for it in the record."""
        if self._state is None or entry.subindex or entry.index not in OBJECTS:
            return entry
        return StateEntry(self._state.values, OBJECTS.index(entry.index), entry)

    def indices(self, within: range) -> list[int]:
        """Return the objects that the EDS has in a range of indices, in order."""
        return sorted(self._indices.intersection(within))

    def reset(self, *, communication_only: bool) -> None:
        """Load the power-on values: of all objects, or of 0x1000 to 0x1FFF (CiA 301, 7.3.2.2)."""
        for entry in self._entries.values():
            if not communication_only or entry.index in _COMMUNICATION_PROFILE:
                entry.value = entry.default

    def error(self, index: int, subindex: int, what: str) -> DictionaryError:
        """Return the error to raise for an object of this file."""
        return DictionaryError(f"{self.source}: object 0x{index:04X}:{subindex:02X} {what}")

    def _entry(self, variable: ODVariable) -> Entry:
        codec = ODVariable.STRUCT_TYPES.get(variable.data_type)
        value = variable.default if variable.value is None else variable.value
        try:
            default = _power_on_value(codec, value)
        except (TypeError, ValueError, OverflowError) as error:
            what = f"{value!r} is no value of data type 0x{variable.data_type:04X}"
            raise self.error(variable.index, variable.subindex, what) from error
        return Entry(
            variable.index,
            variable.subindex,
            codec,
            default,
            variable.access_type,
            variable.pdo_mappable,
            variable.min if codec else None,
            variable.max if codec else None,
        )


def _variables(od: canopen.ObjectDictionary) -> Iterator[ODVariable]:
    for item in od.values():
        if isinstance(item, ODVariable):
            yield item
        else:
            yield from item.subindices.values()


def _power_on_value(codec: Struct | None, value: Any) -> Any:
    """Convert a value of the EDS to the entry's type; none means zero or empty."""
    if codec is None:
        text = value or b""
        return text.encode() if isinstance(text, str) else bytes(memoryview(text))
    if isinstance(value, float):
        return value
    # EDS write negative numbers as -1 or, for 8 bits, 0xFF.
    raw = (value or 0) & (1 << 8 * codec.size) - 1
    return codec.unpack(raw.to_bytes(codec.size, "little"))[0]
