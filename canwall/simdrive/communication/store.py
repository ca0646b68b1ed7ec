"""Store and restore parameters (CiA 301, 7.5.2.13 and 7.5.2.14)."""

from collections.abc import Iterator
from functools import partial

from canwall.simdrive.communication.abort import AbortCode, AccessError
from canwall.simdrive.communication.dictionary import Dictionary, Entry
from canwall.simdrive.communication.memory import Memory

_STORE = 0x1010
_RESTORE = 0x1011
_SAVE = int.from_bytes(b"save", "little")
_LOAD = int.from_bytes(b"load", "little")
_ON_COMMAND = 1
"""Value of the sub-indices: parameters are stored, and restored, on command."""

_GROUPS = {
    1: range(0x1000, 0x10000),
    2: range(0x1000, 0x2000),
    3: range(0x6000, 0xA000),
}
_MANUFACTURER = range(0x2000, 0x6000)
"""Parameters of every further sub-index."""

_NOT_PARAMETERS = frozenset((0x1003, _STORE, _RESTORE, 0x5F00, 0x6040, 0x6071))
"""History, commands, requested faults and targets: nothing moves by itself after power-on."""


class ParameterStore:
    """Values that replace those of the EDS at every reset, until they are restored."""

    def __init__(self, dictionary: Dictionary, memory: Memory) -> None:
        """Serve 0x1010 and 0x1011 of the dictionary.

        Args:
            dictionary: has the entries.
            memory: keeps the values.

        Raises:
            DictionaryError: the memory holds the values of another device.
        """
        self._dictionary = dictionary
        self._memory = memory
        self._stored = memory.parameters(dictionary)
        for index, signature in ((_STORE, _SAVE), (_RESTORE, _LOAD)):
            for subindex in range(1, 128):
                if (index, subindex) in dictionary:
                    self._serve(dictionary[index, subindex], signature)

    def load(self, *, communication_only: bool) -> None:
        """Put the stored values into the dictionary: all, or those of 0x1000 to 0x1FFF."""
        for key, data in self._stored.items():
            if not communication_only or key[0] in _GROUPS[2]:
                entry = self._dictionary[key]
                entry.value = entry.decode(data)

    def _serve(self, entry: Entry, signature: int) -> None:
        self._dictionary.supply(*entry.key, _ON_COMMAND)
        group = _GROUPS.get(entry.subindex, _MANUFACTURER)
        entry.check = partial(self._check, signature, group)
        entry.react = lambda _: setattr(entry, "value", entry.default)

    def _check(self, signature: int, group: range, value: int) -> None:
        """Obey a signature; a wrong one, and values that cannot be stored, are refused."""
        if value != signature:
            raise AccessError(AbortCode.NOT_STORED)
        kept = {key: data for key, data in self._stored.items() if key[0] not in group}
        if signature == _SAVE:
            kept |= {entry.key: entry.upload() for entry in self._parameters(group)}
        try:
            self._memory.store(self._dictionary, kept)
        except OSError as error:
            raise AccessError(AbortCode.HARDWARE) from error
        self._stored = kept

    def _parameters(self, group: range) -> Iterator[Entry]:
        for entry in self._dictionary:
            if (
                entry.index in group
                and entry.index not in _NOT_PARAMETERS
                and entry.access in ("rw", "rww", "rwr")
                and entry.value is not None
            ):
                yield entry
