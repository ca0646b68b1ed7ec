"""Scan of a bus: its nodes with their identity, their states, and which of them are drives.

Nothing is written to any node, and no NMT command is sent.
"""

import time
from contextlib import suppress
from dataclasses import dataclass

import can
from canopen.objectdictionary import ObjectDictionary

from canwall.bus.can_ids import ERROR_CONTROL
from canwall.drive import DriveError, DriveNode, Link, state_of
from canwall.drive import objects as od

#: Time to wait for the answer to one SDO request [s].
_SDO_TIMEOUT_S = 0.5
#: Time to listen for nodes, and the longest for a heartbeat [s].
_LISTEN_S, _HEARTBEAT_S = 0.5, 2.0
#: NMT states as heartbeats and guarding have them (CiA 301, 7.2.8.3.2).
_NMT_STATES = {0: "boot-up", 4: "STOPPED", 5: "OPERATIONAL", 127: "PRE-OPERATIONAL"}
_TOGGLE = 0x80
#: Device profiles (bits 0 to 15 of 0x1000).
_PROFILES = {
    0: "no profile",
    301: "CiA 301, no device profile",
    401: "CiA 401, I/O",
    402: "CiA 402, drive",
    404: "CiA 404, measuring device",
    405: "CiA 405, PLC",
    406: "CiA 406, encoder",
    410: "CiA 410, inclinometer",
}
_VENDOR, _PRODUCT, _REVISION, _SERIAL = 1, 2, 3, 4


@dataclass(frozen=True)
class BusNode:
    """A node on the bus; None stands for what it does not tell.

    Attributes:
        node_id: Node-ID.
        device_type: 0x1000; None: frames come from it, but it answers no SDO request.
        name: 0x1008, manufacturer device name.
        vendor_id: 0x1018:01.
        product_code: 0x1018:02.
        revision: 0x1018:03.
        serial_number: 0x1018:04.
        nmt_state: NMT state in its heartbeat, or in its answer to node guarding.
        drive_state: State of CiA 402 (0x6041) of a drive.
    """

    node_id: int
    device_type: int | None = None
    name: str | None = None
    vendor_id: int | None = None
    product_code: int | None = None
    revision: int | None = None
    serial_number: int | None = None
    nmt_state: str | None = None
    drive_state: str | None = None

    @property
    def is_drive(self) -> bool:
        """True if it has the profile of a drive, or a statusword without any profile."""
        return self.device_type is not None and (
            self.device_type & 0xFFFF == 402 or self.drive_state is not None
        )

    @property
    def profile(self) -> str:
        """Its device profile in words."""
        if self.device_type is None:
            return "does not answer SDO requests"
        number = self.device_type & 0xFFFF
        return _PROFILES.get(number, f"CiA {number}")


def scan_nodes(link: Link) -> list[BusNode]:
    """Return the nodes on the bus, by node-ID. Raises can.CanError.

    All are asked for their device type; one that does not answer is found by its frames.
    """
    return [_examined(link, node_id) for node_id in link.find_nodes(_LISTEN_S)]


def _examined(link: Link, node_id: int) -> BusNode:
    node = DriveNode(link, node_id, ObjectDictionary(), _SDO_TIMEOUT_S)
    device_type = _number(node, od.DEVICE_TYPE)
    if device_type is None:
        return BusNode(node_id, nmt_state=_heartbeat(link, node_id, _HEARTBEAT_S))
    name = None
    with suppress(DriveError):
        name = node.read_text(od.DEVICE_NAME) or None
    vendor, product, revision, serial = (
        _number(node, od.IDENTITY, part) for part in (_VENDOR, _PRODUCT, _REVISION, _SERIAL)
    )
    status = _number(node, od.STATUSWORD) if device_type & 0xFFFF in (0, 402) else None
    return BusNode(
        node_id,
        device_type,
        name,
        vendor,
        product,
        revision,
        serial,
        _nmt_state(link, node),
        None if status is None else str(state_of(status)),
    )


def _number(node: DriveNode, index: int, subindex: int = 0) -> int | None:
    try:
        return node.read(index, subindex)
    except DriveError:
        return None


def _nmt_state(link: Link, node: DriveNode) -> str | None:
    """Return the NMT state from a heartbeat, or by node guarding where that starts no watchdog."""
    heartbeat_ms = _number(node, od.PRODUCER_HEARTBEAT_TIME)
    if heartbeat_ms:
        return _heartbeat(link, node.node_id, min(2e-3 * heartbeat_ms, _HEARTBEAT_S))
    if _number(node, od.GUARD_TIME) and _number(node, od.LIFE_TIME_FACTOR):
        return None  # its life guarding would begin with the first remote frame
    link.send(
        can.Message(
            arbitration_id=ERROR_CONTROL + node.node_id,
            is_remote_frame=True,
            dlc=1,
            is_extended_id=False,
        )
    )
    return _heartbeat(link, node.node_id, _SDO_TIMEOUT_S)


def _heartbeat(link: Link, node_id: int, patience_s: float) -> str | None:
    """Return the next NMT state that the node sends, None if there is none in time."""
    deadline = time.monotonic() + patience_s
    while (remaining := deadline - time.monotonic()) > 0.0:
        message = link.wait_for((ERROR_CONTROL + node_id,), remaining)
        if message is not None and len(message.data) == 1:
            state = message.data[0] & ~_TOGGLE
            return _NMT_STATES.get(state, f"state {state}")
    return None
