"""One drive as its master talks to it outside the cycle: SDO values, NMT, EMCY, heartbeat."""

import time

import can
from canopen.emcy import EmcyError
from canopen.objectdictionary import ObjectDictionary, datatypes
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

    @property
    def emergencies(self) -> list[EmcyError]:
        """EMCY messages so far, the latest last."""
        log: list[EmcyError] = self._node.emcy.log
        return log

    def has(self, index: int, subindex: int = 0) -> bool:
        """Whether the object dictionary lists this object."""
        return self.dictionary.get_variable(index, subindex) is not None

    def read(self, index: int, subindex: int = 0) -> int:
        """Upload an integer. Raises DriveError."""
        try:
            raw = self._node.sdo.upload(index, subindex)
        except (SdoAbortedError, SdoCommunicationError, can.CanError) as error:
            raise self._failed("reading", index, subindex, error) from None
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
            self._node.sdo.download(
                index, subindex, value.to_bytes(size, "little", signed=value < 0)
            )
        except (SdoAbortedError, SdoCommunicationError, can.CanError) as error:
            raise self._failed(f"writing {value:#x} to", index, subindex, error) from None

    def write_confirmed(self, index: int, subindex: int, value: int) -> None:
        """Write, read back, compare. Raises DriveError."""
        self.write(index, subindex, value)
        found = self.read(index, subindex)
        if found != value:
            raise DriveError(
                f"node {self.node_id}, {_name(index, subindex)}: wrote {value:#x}, "
                f"the drive keeps {found:#x}"
            )

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

    def _failed(self, doing: str, index: int, subindex: int, error: Exception) -> DriveError:
        return DriveError(f"node {self.node_id}: {doing} {_name(index, subindex)} failed: {error}")


def _name(index: int, subindex: int) -> str:
    return f"0x{index:04X}:{subindex:02X}"
