"""Frames outside the cycle that end a wall: EMCY, NMT, bus-off, a second master or drive."""

from collections.abc import Sequence

import can
from canopen.emcy import EmcyError

from canwall.bus.can_ids import EMCY, ERROR_CONTROL, NMT
from canwall.cycle.axis import WallAxis
from canwall.drive import Link

_OPERATIONAL, _BOOT_UP = 5, 0
_NMT_STATES = {
    _BOOT_UP: "restarted, or a second one with its node-ID started",
    4: "is in NMT STOPPED",
    127: "is in NMT PRE-OPERATIONAL",
}
#: Commands of NMT after which a drive takes no RPDO (CiA 301, 7.2.8.3.1).
_NMT_COMMANDS = {2: "STOP", 128: "PRE-OPERATIONAL", 129: "RESET NODE", 130: "RESET COMMUNICATION"}
#: Class of an error frame, as Linux's SocketCAN has it in the identifier (linux/can/error.h).
_BUS_OFF = 0x40
#: TPDOs beyond one for each SYNC, late ones aside, that prove a second sender.
_SURPLUS = 10


class BusMonitor:
    """Turns such frames into trips of the axis they concern, in the cycle in which they arrive.

    Nothing trips before a wall is rendered, or while its drive is being disabled. What comes while
    it is being enabled is told if that fails (`WallAxis.suspected`).
    """

    def __init__(self, link: Link, axes: Sequence[WallAxis], sync_cob_id: int | None) -> None:
        """Subscribe to these frames.

        Args:
            link: The bus.
            axes: Drives and their walls.
            sync_cob_id: COB-ID of the SYNC if only this master may send it, else None.
        """
        self._axes = axes
        self.error_frames = 0
        self.notes: list[str] = []
        self._surplus = dict.fromkeys((axis.setup.tpdo.cob_id for axis in axes), 0)
        for axis in axes:
            node_id = axis.node.node_id
            link.network.subscribe(axis.setup.tpdo.cob_id, self._another_tpdo)
            link.network.subscribe(axis.setup.rpdo.cob_id, self._another_rpdo)
            link.network.subscribe(EMCY + node_id, self._emergency)
            link.network.subscribe(ERROR_CONTROL + node_id, self._error_control)
        link.network.subscribe(NMT, self._another_nmt_command)
        if sync_cob_id is not None:
            link.network.subscribe(sync_cob_id, self._another_sync)
        link.on_error_frame = self._error_frame

    def _emergency(self, can_id: int, data: bytearray, timestamp: float) -> None:
        axis = self._axis(can_id - EMCY)
        code = int.from_bytes(data[:2], "little")
        if not axis.active or len(data) < 3 or code == 0:
            return
        error = EmcyError(code, data[2], bytes(data[3:]), timestamp)
        meaning = error.get_desc() or "manufacturer-specific"
        text = f"EMCY {code:#06x} ({meaning}), register {data[2]:#04x}"
        if axis.settings.limits.emergency == "trip":
            axis.give_up(text)
        else:
            self.notes.append(f"{axis.name}: cycle {int(axis.cycle['j'][0])}: {text}")

    def _error_control(self, can_id: int, data: bytearray, timestamp: float) -> None:
        axis = self._axis(can_id - ERROR_CONTROL)
        if len(data) != 1 or data[0] & 0x7F == _OPERATIONAL:
            return
        state = data[0] & 0x7F
        axis.give_up(f"the drive {_NMT_STATES.get(state, f'is in NMT state {state}')}")

    def _another_tpdo(self, can_id: int, data: bytearray, timestamp: float) -> None:
        axis = next(axis for axis in self._axes if axis.setup.tpdo.cob_id == can_id)
        if not axis.active:
            return
        self._surplus[can_id] += 1
        # One that comes late was counted as missing.
        if self._surplus[can_id] - int(axis.cycle["missed_tpdo"][0]) >= _SURPLUS:
            axis.give_up(
                f"more than one TPDO ({can_id:#05x}) for each SYNC: two drives have node-ID "
                f"{axis.node.node_id}, or another node sends under this identifier"
            )

    def _another_rpdo(self, can_id: int, data: bytearray, timestamp: float) -> None:
        axis = next(axis for axis in self._axes if axis.setup.rpdo.cob_id == can_id)
        axis.give_up(f"somebody else sends RPDOs ({can_id:#05x}) to the drive as well: end it")

    def _another_nmt_command(self, can_id: int, data: bytearray, timestamp: float) -> None:
        if len(data) != 2 or (command := _NMT_COMMANDS.get(data[0])) is None:
            return
        for axis in self._axes:
            if data[1] in (0, axis.node.node_id):
                axis.give_up(f"somebody else has sent NMT {command} ({can_id:#05x}): end it")

    def _another_sync(self, can_id: int, data: bytearray, timestamp: float) -> None:
        for axis in self._axes:
            axis.give_up(
                f"somebody else sends SYNC ({can_id:#05x}) as well: end it, or set bus.sync"
            )

    def _error_frame(self, message: can.Message) -> None:
        self.error_frames += 1
        if message.arbitration_id & _BUS_OFF:
            for axis in self._axes:
                axis.give_up("the adapter is bus-off: look at bit rate, cable and termination")

    def _axis(self, node_id: int) -> WallAxis:
        return next(axis for axis in self._axes if axis.node.node_id == node_id)
