"""Detection of a second master, which would set up and command the same drive."""

from collections.abc import Iterable

from canwall.bus.can_ids import ERROR_CONTROL, RPDO1, SYNC
from canwall.config import Bus as BusSettings
from canwall.drive.link import Link
from canwall.drive.node import DriveError

#: Time to listen, and its minimum in periods of the SYNC.
_LISTEN_S = 0.25
_LISTEN_CYCLES = 3.0


def refuse_second_master(link: Link, bus: BusSettings, node_ids: Iterable[int]) -> None:
    """Listen, without sending, for frames that only a master of these nodes sends.

    These are SYNC, if this master is to produce it, an RPDO of a node, and the heartbeat of
    `[bus] master_id`; not SDO, with which others may read a drive.

    Raises:
        DriveError: If there is another master.
        can.CanError: If the bus fails.
    """
    signs = {ERROR_CONTROL + bus.master_id: f"the heartbeat of node {bus.master_id}"}
    signs |= {RPDO1 + node_id: f"RPDO1 of node {node_id}" for node_id in node_ids}
    if bus.sync == "produce":
        signs[SYNC] = "SYNC"
    heard = link.wait_for(signs, max(_LISTEN_S, _LISTEN_CYCLES * bus.cycle_s))
    if heard is not None:
        sign = heard.arbitration_id
        raise DriveError(
            f"another master is on {bus.channel}: it sends {signs[sign]} ({sign:#05x}); "
            "end it first"
        )
