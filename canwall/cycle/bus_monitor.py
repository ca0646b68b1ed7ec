"""Frames outside the cycle that end a wall: EMCY, another NMT state, bus-off, a second SYNC."""

from collections.abc import Sequence

import can
from canopen.emcy import EmcyError

from canwall.bus.can_ids import EMCY, ERROR_CONTROL
from canwall.cycle.axis import WallAxis
from canwall.drive import Link

_OPERATIONAL, _BOOT_UP = 5, 0
_NMT_STATES = {_BOOT_UP: "restarted", 4: "is in NMT STOPPED", 127: "is in NMT PRE-OPERATIONAL"}
#: Class of an error frame, as Linux's SocketCAN has it in the identifier (linux/can/error.h).
_BUS_OFF = 0x40


class BusMonitor:
    """Turns such frames into trips of the axis they concern, in the cycle in which they arrive.

    Nothing trips before a wall is rendered, or while its drive is being disabled.
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
        for axis in axes:
            node_id = axis.node.node_id
            link.network.subscribe(EMCY + node_id, self._emergency)
            link.network.subscribe(ERROR_CONTROL + node_id, self._error_control)
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
        if not axis.active or len(data) != 1 or data[0] & 0x7F == _OPERATIONAL:
            return
        state = data[0] & 0x7F
        axis.give_up(f"the drive {_NMT_STATES.get(state, f'is in NMT state {state}')}")

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
