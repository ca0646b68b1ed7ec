"""Non-volatile memory: the node-ID of LSS, and stored parameters."""

import json
from pathlib import Path
from typing import Any, cast

from canwall.eds import DictionaryError
from canwall.simdrive.communication.abort import AccessError
from canwall.simdrive.communication.cob_id import CAN_ID
from canwall.simdrive.communication.dictionary import Dictionary, Entry, Key

UNCONFIGURED = 255
"""The node-ID of a device that has none (CiA 305): it answers LSS alone."""

_NODE_IDS = range(1, 128)
_IDENTITY = 0x1018


class Memory:
    """Values that outlive a reset and, in a file, the process."""

    def __init__(self, path: Path | None) -> None:
        """Read the file, which need not exist yet.

        Raises:
            DictionaryError: no drive has written the file.
        """
        self._path = path
        self._identity: list[int] | None = None
        self._owner: int | None = None
        self._objects: dict[Key, bytes] = {}
        self.node_id: int | None = None
        """1 to 127 or UNCONFIGURED, as LSS has stored it; None: it has not."""
        if path and path.exists():
            self._read(path)

    def parameters(self, dictionary: Dictionary) -> dict[Key, bytes]:
        """Return the stored values of a device, for the node-ID of its dictionary.

        A COB-ID whose entry has the node-ID in its default belongs to the predefined connection
        set for as long as it has the default identifier. Then it follows the node-ID, with the
        bits 29 to 31 that were stored; one that was chosen freely stays as it is. (CiA 301,
        7.3.5: the set is a function of the node-ID; CiA 306: $NODEID.)

        Raises:
            DictionaryError: another device has stored them.
        """
        if self._identity not in (None, _identity(dictionary)):
            raise DictionaryError(f"{self._path}: stored by another device; remove it")
        try:
            for key, data in self._objects.items():
                dictionary[key].check_download(len(data))
        except (LookupError, AccessError) as error:
            raise self._unreadable(error) from None
        if self._owner in (None, dictionary.node_id):
            return self._objects
        former = dictionary.renumbered(self._owner)
        return {
            key: _renumbered(former[key], dictionary[key], data)
            for key, data in self._objects.items()
        }

    def store(self, dictionary: Dictionary, objects: dict[Key, bytes]) -> None:
        """Keep parameters of a device.

        Raises:
            OSError: the file cannot be written; everything is kept as it was.
        """
        identity = _identity(dictionary)
        self._write(identity, self.node_id, dictionary.node_id, objects)
        self._identity, self._owner, self._objects = identity, dictionary.node_id, objects

    def store_node_id(self, dictionary: Dictionary, node_id: int) -> None:
        """Keep a node-ID of a device for the next power-on.

        Raises:
            OSError: the file cannot be written; everything is kept as it was.
        """
        identity = _identity(dictionary)
        self._write(identity, node_id, self._owner, self._objects)
        self._identity, self.node_id = identity, node_id

    def _write(
        self,
        identity: list[int],
        node_id: int | None,
        owner: int | None,
        objects: dict[Key, bytes],
    ) -> None:
        if self._path is None:
            return
        content = {
            "identity": identity,
            "node_id": node_id,
            "stored_by_node": owner,
            "objects": {f"{i:04X}:{sub:02X}": data.hex() for (i, sub), data in objects.items()},
        }
        # A drive that dies while it writes keeps what it had.
        draft = self._path.with_name(f"{self._path.name}.new")
        draft.write_text(json.dumps(content, indent=1), encoding="ascii")
        draft.replace(self._path)

    def _read(self, path: Path) -> None:
        try:
            content = json.loads(path.read_text(encoding="ascii"))
            self._identity = content["identity"]
            self.node_id = _checked(content["node_id"], (*_NODE_IDS, UNCONFIGURED, None))
            self._owner = _checked(content["stored_by_node"], (*_NODE_IDS, None))
            for name, data in content["objects"].items():
                index, subindex = (int(part, 16) for part in name.split(":"))
                self._objects[index, subindex] = bytes.fromhex(data)
        except (OSError, ValueError, TypeError, AttributeError, LookupError) as error:
            raise self._unreadable(error) from None

    def _unreadable(self, error: Exception) -> DictionaryError:
        return DictionaryError(f"{self._path}: no stored parameters; remove it: {error!r}")


def _checked(node_id: Any, possible: tuple[int | None, ...]) -> int | None:
    if node_id not in possible:
        raise ValueError(f"no node-ID: {node_id}")
    return cast(int | None, node_id)


def _identity(dictionary: Dictionary) -> list[int]:
    """Return vendor, product and revision: two devices with them have the same objects."""
    numbers = (dictionary.number(_IDENTITY, n, absent=0) for n in (1, 2, 3))
    return [number.default for number in numbers]


def _renumbered(former: Entry, present: Entry, data: bytes) -> bytes:
    """Return a stored value for another node-ID, which the defaults of the entries differ by."""
    if former.default == present.default or former.codec is None:
        return data
    value: int = former.decode(data)
    if (value ^ former.default) & CAN_ID:
        return data
    return former.codec.pack(value - former.default + present.default)
