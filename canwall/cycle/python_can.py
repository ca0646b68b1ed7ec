"""Transport over python-can, for any adapter that it supports."""

import time

import can
import numpy as np
from numpy.typing import NDArray

from canwall.bus import DataFrame
from canwall.bus.raw_socket import CAN_EFF, CAN_ERR, CAN_RTR
from canwall.compiled import data_to_number, number_to_data
from canwall.cycle.core import Handling, Want, proceed, proceed_without, take
from canwall.cycle.transport import CycleFrames
from canwall.drive import Link

_SEND, _FRAME, _DRAIN, _SLEEP, _SPIN = map(
    int, (Want.SEND, Want.FRAME, Want.DRAIN, Want.SLEEP, Want.SPIN)
)


class PythonCanTransport:
    """Moves the frames of a cycle over a python-can bus, in the thread of the loop."""

    name = "python-can"

    def __init__(self, link: Link, core: NDArray[np.void], frames: CycleFrames) -> None:
        """Prepare a message for each of the frames to be sent."""
        self._link = link
        self._core = core
        self._out = core["out"][0]
        self._until_ns = core["until_ns"]
        self._messages = {can_id: _message(can_id) for can_id in frames.sent}
        #: True if messages carry the kernel's time stamp (CLOCK_REALTIME).
        self._stamped = type(link.bus).__module__.startswith("can.interfaces.socketcan")
        # Compiled code is loaded at its first call, which may take longer than a cycle.
        scratch = core.copy()
        scratch["handling"] = Handling.LOG_ONLY
        take(scratch, 0, 0, 0, 0, 0)

    def run(self) -> Want:
        """Move frames until the core wants Python. Raises can.CanError if the bus fails."""
        core, link = self._core, self._link
        now_ns = time.perf_counter_ns
        # In simulated time, drives of this process have answered all once they are served; another
        # producer's SYNC comes when it likes.
        measured = core["real_time"][0] or core["external_sync"][0]
        serve, served = (None if measured else link.idle), False
        want = proceed(core, now_ns())
        while True:
            if want == _SEND:
                served = False
                self._send()
                want = proceed(core, now_ns())
            elif want in (_FRAME, _DRAIN):
                timeout_s = 0.0
                if want == _FRAME and serve is None:
                    timeout_s = max(0.0, (int(self._until_ns[0]) - now_ns()) * 1e-9)
                message = link.receive_unlogged(timeout_s)
                if message is not None:
                    want = self._take(message)
                elif want == _DRAIN or serve is None:
                    want = proceed(core, now_ns())
                elif served:
                    want = proceed_without(core, now_ns())
                else:
                    serve()
                    served = True
            elif want == _SLEEP:
                time.sleep(max(0.0, (int(self._until_ns[0]) - now_ns()) * 1e-9))
                want = proceed(core, now_ns())
            elif want == _SPIN:
                want = proceed(core, now_ns())
            else:
                return Want(want)

    def _send(self) -> None:
        can_id, length, number = self._out.tolist()
        message = self._messages[can_id]
        if not message.is_remote_frame:
            message.data[:] = number_to_data(number, length)
            message.dlc = length
        self._link.send_unlogged(message)

    def _take(self, message: can.Message) -> int:
        can_id = message.arbitration_id
        if message.is_extended_id or message.is_remote_frame or message.is_error_frame:
            can_id |= (
                CAN_EFF * message.is_extended_id
                | CAN_RTR * message.is_remote_frame
                | CAN_ERR * message.is_error_frame
            )
        data = message.data[:8]
        stamp_ns = round(message.timestamp * 1e9) if self._stamped else 0
        length = message.dlc if message.is_remote_frame else len(data)
        number = data_to_number(data)
        return take(self._core, can_id, length, number, time.perf_counter_ns(), stamp_ns)

    def finish_cycle(self) -> None:
        """Do nothing, since all frames arrive on the bus of the link."""

    def close(self) -> None:
        """Do nothing, since the link stays open."""


def _message(can_id: int) -> can.Message:
    if can_id & CAN_RTR:
        can_id &= ~CAN_RTR
        return can.Message(arbitration_id=can_id, is_remote_frame=True, is_extended_id=False)
    return DataFrame(can_id, b"")
