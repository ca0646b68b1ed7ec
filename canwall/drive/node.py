"""A drive as seen by its master outside the cycle: objects over SDO, NMT and EMCY."""

import time
from collections.abc import Iterator

import can
from canopen.emcy import EmcyError
from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from canwall.bus import DataFrame
from canwall.bus.can_ids import NMT
from canwall.drive.link import Link
from canwall.drive.objects import DEVICE_TYPE
from canwall.errors import RunFailedError

#: NMT commands (CiA 301, 7.2.8.3.1.1).
_NMT_COMMANDS = {"OPERATIONAL": 1, "PRE-OPERATIONAL": 128, "RESET": 129}


class DriveError(RunFailedError):
    """A drive that does not answer, refuses a value, or stays in a state."""


class DriveNode:
    """A node on the bus, with its objects by index and sub-index."""

    def __init__(self, link: Link, node_id: int, dictionary: ObjectDictionary) -> None:
        self.link = link
        self.node_id = node_id
        self.dictionary = dictionary
        self._node = link.add_node(node_id, dictionary)
        self._changes: list[tuple[int, int, bytes | None]] = []

    def over(self, link: Link) -> "DriveNode":
        """Return this node on another link, which remembers the same changes."""
        node = DriveNode(link, self.node_id, self.dictionary)
        node._changes = self._changes
        return node

    @property
    def emergencies(self) -> list[EmcyError]:
        """EMCY messages so far, in order of arrival."""
        log: list[EmcyError] = self._node.emcy.log
        return log

    def has(self, index: int, subindex: int = 0) -> bool:
        """Return whether the object dictionary lists this object."""
        item = self.dictionary.get(index)
        if item is None or isinstance(item, ODVariable):
            return item is not None and subindex == 0
        # With [], canopen's arrays would invent sub-indices that they do not have.
        return subindex in item.subindices

    def dcf_objects(self) -> Iterator[ODVariable]:
        """Yield the objects to which a DCF gives a value (ParameterValue)."""
        for item in self.dictionary.values():
            variables = [item] if isinstance(item, ODVariable) else item.subindices.values()
            for variable in variables:
                if isinstance(variable.value, int):
                    yield variable

    def read(self, index: int, subindex: int = 0) -> int:
        """Read an integer. Raises DriveError."""
        raw = self._upload(index, subindex)
        variable = self.dictionary.get_variable(index, subindex)
        signed = variable is not None and variable.data_type in datatypes.SIGNED_TYPES
        return int.from_bytes(raw, "little", signed=signed)

    def write(self, index: int, subindex: int, value: int, size: int | None = None) -> None:
        """Write an integer; its size in bytes is the dictionary's unless given.

        Raises DriveError.
        """
        if size is None:
            variable = self.dictionary.get_variable(index, subindex)
            if variable is None:
                raise DriveError(f"{_name(index, subindex)}: not in the object dictionary")
            size = len(variable) // 8
        try:
            raw = value.to_bytes(size, "little", signed=value < 0)
        except OverflowError:
            raise DriveError(f"{_name(index, subindex)}: {value:#x} does not fit into it") from None
        self._download(index, subindex, raw)

    def change(self, index: int, subindex: int, value: int, size: int | None = None) -> None:
        """Write a parameter, and remember its old value for `restore`. Raises DriveError.

        A parameter that cannot be read is written as well, but cannot be restored.
        """
        try:
            before = self._upload(index, subindex)
        except DriveError:
            before = None
        self.write(index, subindex, value, size)
        self._changes.append((index, subindex, before))

    def set(self, index: int, subindex: int, value: int) -> None:
        """Change a parameter and confirm its value. Raises DriveError."""
        self.change(index, subindex, value)
        self.confirm(index, subindex, value)

    def confirm(self, index: int, subindex: int, value: int) -> None:
        """Read a value back. Raises DriveError if the drive has another one."""
        found = self.read(index, subindex)
        if found != value:
            raise DriveError(
                f"node {self.node_id}, {_name(index, subindex)}: wrote {value:#x}, "
                f"the drive keeps {found:#x}"
            )

    def restore(self) -> list[str]:
        """Undo all changes in PRE-OPERATIONAL and return a line for each that could not be undone.

        The last change is undone first, so that a PDO is switched off before its mapping changes.
        """
        try:
            self.command("PRE-OPERATIONAL")
        except can.CanError as error:
            return [f"node {self.node_id}: nothing was restored, the bus failed: {error}"]
        failures = []
        while self._changes:
            index, subindex, before = self._changes.pop()
            if before is None:
                failures.append(f"{_name(index, subindex)} cannot be read, so it is not restored")
                continue
            try:
                self._download(index, subindex, before)
            except DriveError as error:
                failures.append(str(error))
        return failures

    def command(self, nmt: str) -> None:
        """Send an NMT command to this node: OPERATIONAL, PRE-OPERATIONAL or RESET (of the node).

        It depends on nothing that was heard from the node before. Raises can.CanError.
        """
        self.link.send(DataFrame(NMT, bytes([_NMT_COMMANDS[nmt], self.node_id])))

    def wait_until_present(self, timeout_s: float) -> None:
        """Read the device type until the drive answers. Raises DriveError."""
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                self.read(DEVICE_TYPE)
                return
            except DriveError:
                if time.monotonic() >= deadline:
                    raise DriveError(
                        f"node {self.node_id} does not answer; is the drive on, on this bus, at "
                        f"this bit rate, and is drive.node_id right?"
                    ) from None

    def _upload(self, index: int, subindex: int) -> bytes:
        try:
            raw: bytes = self._node.sdo.upload(index, subindex)
        except (SdoAbortedError, SdoCommunicationError, can.CanError) as error:
            raise self._failed("reading", index, subindex, error) from None
        return raw

    def _download(self, index: int, subindex: int, raw: bytes) -> None:
        try:
            self._node.sdo.download(index, subindex, raw)
        except (SdoAbortedError, SdoCommunicationError, can.CanError) as error:
            variable = self.dictionary.get_variable(index, subindex)
            signed = variable is not None and variable.data_type in datatypes.SIGNED_TYPES
            value = int.from_bytes(raw, "little", signed=signed)
            raise self._failed(f"writing {value:#x} to", index, subindex, error) from None

    def _failed(self, doing: str, index: int, subindex: int, error: Exception) -> DriveError:
        return DriveError(f"node {self.node_id}: {doing} {_name(index, subindex)} failed: {error}")


def _name(index: int, subindex: int) -> str:
    return f"0x{index:04X}:{subindex:02X}"
