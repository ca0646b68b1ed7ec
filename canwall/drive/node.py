"""A drive as seen by its master outside the cycle: objects over SDO, NMT and EMCY."""

import contextlib
import time
from collections.abc import Iterator

import can
from can.interfaces.virtual import VirtualBus
from canopen.emcy import EmcyError
from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from canwall.bus import DataFrame
from canwall.bus.can_ids import ERROR_CONTROL, NMT
from canwall.drive.link import Link
from canwall.drive.objects import DEVICE_TYPE
from canwall.errors import RunFailedError

#: NMT commands (CiA 301, 7.2.8.3.1.1).
_NMT_COMMANDS = {"OPERATIONAL": 1, "PRE-OPERATIONAL": 128, "RESET": 129}
#: SDO abort codes of an object, or a sub-index, that a drive does not have.
_NO_OBJECT = (0x0602_0000, 0x0609_0011)
#: Time to wait for an answer that is late [s].
_LATE_S = 0.5
#: Second answers that prove a second drive.
_DOUBLED = 3


class DriveError(RunFailedError):
    """A drive that does not answer, refuses a value, or stays in a state.

    Attributes:
        troubles: What is wrong, a line each; the text of the error is all of them.
    """

    def __init__(self, *troubles: str) -> None:
        super().__init__("; ".join(troubles))
        self.troubles = troubles


class DriveNode:
    """A node on the bus, with its objects by index and sub-index.

    Attributes:
        boot_ups: Number of its boot-up messages so far.
    """

    def __init__(
        self, link: Link, node_id: int, dictionary: ObjectDictionary, sdo_timeout_s: float = 0.5
    ) -> None:
        self.link = link
        self.node_id = node_id
        self.dictionary = dictionary
        self._node = link.add_node(node_id, dictionary)
        self._node.sdo.RESPONSE_TIMEOUT = sdo_timeout_s
        self.boot_ups = 0
        link.network.subscribe(ERROR_CONTROL + node_id, self._error_control)
        self._asked: dict[tuple[int, int], bool] = {}
        self._changes: list[tuple[int, int, bytes | None]] = []

    def over(self, link: Link) -> "DriveNode":
        """Return this node on another link, which remembers the same changes."""
        timeout_s = self._node.sdo.RESPONSE_TIMEOUT
        node = DriveNode(link, self.node_id, self.dictionary, timeout_s)
        node._changes = self._changes
        return node

    def _error_control(self, can_id: int, data: bytearray, timestamp: float) -> None:
        self.boot_ups += data == b"\0"

    @property
    def emergencies(self) -> list[EmcyError]:
        """EMCY messages so far, in order of arrival."""
        log: list[EmcyError] = self._node.emcy.log
        return log

    @property
    def absent(self) -> list[str]:
        """Names of the objects of the dictionary that the drive, when asked, did not have."""
        return [_name(*key) for key, present in self._asked.items() if not present]

    def has(self, index: int, subindex: int = 0) -> bool:
        """Return whether the object dictionary lists this object and the drive has it.

        The drive is asked once. An object that it does not answer for counts as present.
        """
        key = index, subindex
        if not self._lists(index, subindex):
            return False
        if key not in self._asked:
            try:
                self._node.sdo.upload(index, subindex)
            except SdoAbortedError as abort:
                self._asked[key] = abort.code not in _NO_OBJECT
            except (SdoCommunicationError, can.CanError):
                return True
            else:
                self._asked[key] = True
        return self._asked[key]

    def _lists(self, index: int, subindex: int) -> bool:
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
        return int.from_bytes(raw, "little", signed=self.is_signed(index, subindex))

    def is_signed(self, index: int, subindex: int = 0) -> bool:
        """Return True if the dictionary has the object as an integer with a sign."""
        variable = self.dictionary.get_variable(index, subindex)
        return variable is not None and variable.data_type in datatypes.SIGNED_TYPES

    def read_text(self, index: int) -> str:
        """Read a VISIBLE_STRING, "?" for what is not visible. Raises DriveError."""
        text = self._upload(index, 0).decode("latin-1").rstrip("\0 ")
        return "".join(c if c.isprintable() else "?" for c in text)

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
        try:
            self.write(index, subindex, value, size)
        except DriveError:
            # The answer may be lost, and the value written nevertheless.
            with contextlib.suppress(DriveError):
                if before is not None and self._upload(index, subindex) != before:
                    self._changes.append((index, subindex, before))
            raise
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
        """Undo all changes in PRE-OPERATIONAL; return what `undo` does."""
        try:
            self.command("PRE-OPERATIONAL")
        except can.CanError as error:
            return [f"node {self.node_id}: nothing was restored, the bus failed: {error}"]
        return self.undo()

    @property
    def changes(self) -> int:
        """Number of changes that `undo` would undo."""
        return len(self._changes)

    def undo(self, kept: int = 0) -> list[str]:
        """Undo all changes but the first ones; return a line for each that could not be undone.

        The last change is undone first, so that a PDO is switched off before its mapping changes.
        """
        failures = []
        while len(self._changes) > kept:
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
        """Read the device type until the drive answers.

        Raises:
            DriveError: If it does not answer; names the nodes that do.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                self.read(DEVICE_TYPE)
                return
            except DriveError:
                if time.monotonic() >= deadline:
                    raise DriveError(self._why_silent()) from None
                # A node in STOPPED does not answer SDO requests.
                with contextlib.suppress(can.CanError):
                    self.command("PRE-OPERATIONAL")

    def _why_silent(self) -> str:
        timeout_s = float(self._node.sdo.RESPONSE_TIMEOUT)
        silent = f"node {self.node_id} does not answer within {timeout_s:g} s"
        others = self.link.find_nodes(max(_LATE_S, 2.0 * timeout_s))
        if self.node_id in others:
            return f"{silent}, but is on the bus: raise drive.sdo_timeout_s"
        if not others:
            hint = "`canwall drive CONFIG` simulates one"
            if isinstance(self.link.bus, VirtualBus):
                hint = 'bus.interface = "virtual" ends at this process'
            return (
                f"{silent}, nor does any other; is the drive on, on this bus, at this bit rate, "
                f"and is drive.node_id right? {hint}"
            )
        listed = ", ".join(str(node_id) for node_id in others)
        do = f"node {listed} does" if len(others) == 1 else f"nodes {listed} do"
        return f"{silent}, but {do}: is drive.node_id right, and is the drive on?"

    def refuse_twin(self) -> None:
        """Raise DriveError if every request is answered twice."""
        if self._node.sdo.doubled >= _DOUBLED:
            raise DriveError(
                f"two drives have node-ID {self.node_id}: requests to it are answered twice; "
                f"give one of them another node-ID"
            )

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
        text = f"node {self.node_id}: {doing} {_name(index, subindex)} failed: {error}"
        lacking = isinstance(error, SdoAbortedError) and error.code in _NO_OBJECT
        if lacking and self._lists(index, subindex):
            text += "; drive.eds has it: is it this drive's file?"
        return DriveError(text)


def _name(index: int, subindex: int) -> str:
    return f"0x{index:04X}:{subindex:02X}"
