"""One drive as its master talks to it outside the cycle: SDO values, NMT, EMCY, heartbeat."""

import time
from collections.abc import Iterator

import can
from canopen.emcy import EmcyError
from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from canwall.drive.link import Link
from canwall.drive.objects import DEVICE_TYPE
from canwall.errors import RunFailedError


class DriveError(RunFailedError):
    """A drive that does not do what it was asked."""


class DriveNode:
    """A node on the bus, its objects by index."""

    def __init__(self, link: Link, node_id: int, dictionary: ObjectDictionary) -> None:
        self.link = link
        self.node_id = node_id
        self.dictionary = dictionary
        self._node = link.add_node(node_id, dictionary)
        self._changes: list[tuple[int, int, bytes | None]] = []

    @property
    def emergencies(self) -> list[EmcyError]:
        """EMCY messages so far, the latest last."""
        log: list[EmcyError] = self._node.emcy.log
        return log

    def has(self, index: int, subindex: int = 0) -> bool:
        """Whether the object dictionary lists this object."""
        item = self.dictionary.get(index)
        if item is None or isinstance(item, ODVariable):
            return item is not None and subindex == 0
        # Asked by [], an array of canopen's makes up the sub-indices that it does not have.
        return subindex in item.subindices

    def configured(self) -> Iterator[ODVariable]:
        """The objects to which a DCF gives a value of its own (ParameterValue)."""
        for item in self.dictionary.values():
            variables = [item] if isinstance(item, ODVariable) else item.subindices.values()
            for variable in variables:
                if isinstance(variable.value, int):
                    yield variable

    def read(self, index: int, subindex: int = 0) -> int:
        """Upload an integer. Raises DriveError."""
        raw = self._upload(index, subindex)
        variable = self.dictionary.get_variable(index, subindex)
        signed = variable is not None and variable.data_type in datatypes.SIGNED_TYPES
        return int.from_bytes(raw, "little", signed=signed)

    def write(self, index: int, subindex: int, value: int, size: int | None = None) -> None:
        """Download an integer; its size in bytes is the dictionary's unless given.

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
            raise DriveError(f"{_name(index, subindex)}: {value:#x} has no room in it") from None
        self._download(index, subindex, raw)

    def change(self, index: int, subindex: int, value: int, size: int | None = None) -> None:
        """Write a parameter, and remember what `restore` has to undo. Raises DriveError.

        What cannot be read cannot be undone, but can be written.
        """
        try:
            before = self._upload(index, subindex)
        except DriveError:
            before = None
        self.write(index, subindex, value, size)
        self._changes.append((index, subindex, before))

    def set(self, index: int, subindex: int, value: int) -> None:
        """Change a parameter, read back, compare. Raises DriveError."""
        self.change(index, subindex, value)
        self.confirm(index, subindex, value)

    def confirm(self, index: int, subindex: int, value: int) -> None:
        """Read back what was written. Raises DriveError where the drive has something else."""
        found = self.read(index, subindex)
        if found != value:
            raise DriveError(
                f"node {self.node_id}, {_name(index, subindex)}: wrote {value:#x}, "
                f"the drive keeps {found:#x}"
            )

    def restore(self) -> list[str]:
        """Undo every change, the last one first, in PRE-OPERATIONAL; what could not be undone.

        In this order a PDO is switched off before its mapping is touched, as it was on the way in.
        """
        try:
            self.command("PRE-OPERATIONAL")
        except can.CanError as error:
            return [f"node {self.node_id}: nothing was put back, the bus failed: {error}"]
        failed = []
        while self._changes:
            index, subindex, before = self._changes.pop()
            if before is None:
                failed.append(f"{_name(index, subindex)} cannot be read, so not be put back")
                continue
            try:
                self._download(index, subindex, before)
            except DriveError as error:
                failed.append(str(error))
        return failed

    def command(self, nmt: str) -> None:
        """Send an NMT command to this node: START, PRE-OPERATIONAL … (canopen's names)."""
        self._node.nmt.state = nmt

    def wait_until_present(self, timeout_s: float) -> None:
        """Ask for the device type until the drive answers. Raises DriveError."""
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
