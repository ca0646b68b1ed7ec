"""Store and restore parameters (CiA 301, 7.5.2.13 and 7.5.2.14), in a file."""

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from canwall.eds import DictionaryError
from canwall.simdrive.abort import AbortCode, AccessError
from canwall.simdrive.dictionary import Dictionary, Entry, Key

_STORE = 0x1010
_RESTORE = 0x1011
_SAVE = int.from_bytes(b"save", "little")
_LOAD = int.from_bytes(b"load", "little")
_ON_COMMAND = 1
"""What the sub-indices read: parameters are stored, and restored, on command."""

_GROUPS = {
    1: range(0x1000, 0x10000),
    2: range(0x1000, 0x2000),
    3: range(0x6000, 0xA000),
}
_MANUFACTURER = range(0x2000, 0x6000)
"""What every further sub-index is for."""

_NOT_PARAMETERS = frozenset((0x1003, _STORE, _RESTORE, 0x6040, 0x6071))
"""History, commands and targets: whatever was stored, nothing moves by itself after power-on."""

_IDENTITY = 0x1018


def stored_node_id(path: Path) -> int | None:
    """Return the node-ID that LSS has left in a file, None if there is none.

    Raises:
        DictionaryError: the file is none that a drive has written.
    """
    if not path.exists():
        return None
    try:
        node_id = json.loads(path.read_text(encoding="ascii"))["node_id"]
    except (OSError, ValueError, TypeError, LookupError) as error:
        raise _unreadable(path, error) from None
    return node_id if isinstance(node_id, int) and 1 <= node_id <= 127 else None


def _unreadable(path: Path, error: Exception) -> DictionaryError:
    return DictionaryError(f"{path}: no stored parameters; remove it: {error!r}")


class ParameterStore:
    """Values that go before those of the EDS at every reset, until they are restored."""

    def __init__(self, dictionary: Dictionary, path: Path | None) -> None:
        """Serve 0x1010 and 0x1011 of the dictionary.

        Args:
            dictionary: has the entries.
            path: where the values outlive the process; None: nowhere. It need not exist yet.

        Raises:
            DictionaryError: the file is none that a drive with this dictionary has written.
        """
        self._dictionary = dictionary
        self._path = path
        self._node_id: int | None = stored_node_id(path) if path else None
        self._stored: dict[Key, bytes] = self._read(path) if path and path.exists() else {}
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

    def keep_node_id(self, node_id: int) -> None:
        """Keep what LSS has configured for the next power-on.

        Raises:
            OSError: the file cannot be written.
        """
        self._write(self._stored, node_id)
        self._node_id = node_id

    def _serve(self, entry: Entry, signature: int) -> None:
        self._dictionary.supply(*entry.key, _ON_COMMAND)
        group = _GROUPS.get(entry.subindex, _MANUFACTURER)
        entry.check = partial(self._check, signature, group)
        entry.react = lambda _: setattr(entry, "value", entry.default)

    def _check(self, signature: int, group: range, value: int) -> None:
        """Obey a signature: what cannot be stored is refused like a wrong one."""
        if value != signature:
            raise AccessError(AbortCode.NOT_STORED)
        kept = {key: data for key, data in self._stored.items() if key[0] not in group}
        if signature == _SAVE:
            kept |= {entry.key: entry.upload() for entry in self._parameters(group)}
        try:
            self._write(kept, self._node_id)
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

    def _identity(self) -> list[int]:
        numbers = (self._dictionary.number(_IDENTITY, n, absent=0) for n in (1, 2, 3))
        return [number.default for number in numbers]

    def _write(self, stored: dict[Key, bytes], node_id: int | None) -> None:
        if self._path is None:
            return
        objects = {f"{index:04X}:{sub:02X}": data.hex() for (index, sub), data in stored.items()}
        content = {"identity": self._identity(), "node_id": node_id, "objects": objects}
        text = json.dumps(content, indent=1)
        # A drive that dies while it writes keeps what it had.
        draft = self._path.with_name(f"{self._path.name}.new")
        draft.write_text(text, encoding="ascii")
        draft.replace(self._path)

    def _read(self, path: Path) -> dict[Key, bytes]:
        try:
            content = json.loads(path.read_text(encoding="ascii"))
            if content["identity"] != self._identity():
                raise DictionaryError(f"{path}: stored by another device; remove it")
            stored: dict[Key, bytes] = {}
            for name, data in content["objects"].items():
                index, subindex = (int(part, 16) for part in name.split(":"))
                stored[index, subindex] = bytes.fromhex(data)
                self._dictionary[index, subindex].check_download(len(stored[index, subindex]))
        except (OSError, ValueError, TypeError, AttributeError, LookupError, AccessError) as error:
            raise _unreadable(path, error) from None
        return stored
