"""A drive made to cycle outside a run: always zero torque, for trying what it does."""

import time

import can

from canwall.drive import objects as od
from canwall.drive.cia402 import DriveState, Enabling, controlword_down, state_of, status_text
from canwall.drive.node import DriveError, DriveNode
from canwall.drive.setup import DriveSetup

_STATE_S = 3.0
_TPDO_S = 0.1


class Trial:
    """SYNC, TPDO, RPDO with zero torque and the watchdog's beat, one cycle at a time."""

    def __init__(self, node: DriveNode, setup: DriveSetup, cycle_s: float) -> None:
        self._node = node
        self._setup = setup
        self._cycle_s = cycle_s
        self._count = 0
        beat = setup.watchdog.error_control
        self._beat = None if beat is None else _message(beat.can_id, beat.data, beat.remote)
        self._beat_due = 0.0
        self.last_sign_of_life = 0.0
        """time.monotonic() of the last frame that shows the drive a living master."""

    def cycle(self, controlword: int) -> int | None:
        """One cycle; the statusword, None where no TPDO came. Raises can.CanError."""
        begun = time.monotonic()
        link = self._node.link
        link.send(_message(self._setup.sync_cob_id, self._next_count()))
        answer = link.wait_for((self._setup.tpdo.cob_id,), _TPDO_S)
        if self._beat is not None and begun >= self._beat_due:
            link.send(self._beat)
            self._beat_due = begun + 0.5 * self._setup.watchdog.period_s
            self.last_sign_of_life = time.monotonic()
        field = self._setup.rpdo.field(od.CONTROLWORD)
        assert field is not None
        # The target torque's field stays zero; what a fixed mapping carries besides goes along.
        data = (self._setup.rpdo.constant | controlword << field.shift) & (1 << 64) - 1
        length = self._setup.rpdo.length
        link.send(_message(self._setup.rpdo.cob_id, data.to_bytes(8, "little")[:length]))
        if self._beat is None:
            self.last_sign_of_life = time.monotonic()
        remaining = self._cycle_s - (time.monotonic() - begun)
        if remaining > 0.0:
            time.sleep(remaining)
        if answer is None or len(answer.data) < self._setup.tpdo.length:
            return None
        return self._statusword(answer)

    def _next_count(self) -> bytes:
        """Data of the next SYNC: its counter, where the drive wants one (0x1019)."""
        overflow = self._setup.sync_counter_overflow
        if not overflow:
            return b""
        self._count = self._count % overflow + 1
        return bytes([self._count])

    def _statusword(self, answer: can.Message) -> int:
        field = self._setup.tpdo.field(od.STATUSWORD)
        assert field is not None
        data = int.from_bytes(answer.data, "little")
        return data >> field.shift & (1 << field.bits) - 1

    def enable(self) -> None:
        """Cycle until OPERATION ENABLED, from any state. Raises DriveError, can.CanError."""
        enabling = Enabling()
        deadline = time.monotonic() + _STATE_S
        controlword, status = 0, "no state: it sends no TPDO"
        while True:
            statusword = self.cycle(controlword)
            if statusword is not None:
                status = status_text(statusword)
                if state_of(statusword) is DriveState.OPERATION_ENABLED:
                    return
                controlword = enabling.next(statusword)
            if enabling.gave_up:
                raise self._stuck(f"the fault comes back after every reset: {status}")
            if time.monotonic() >= deadline:
                raise self._stuck(f"the drive stays in {status}, not OPERATION ENABLED")

    def disable(self) -> None:
        """Cycle the state machine down. Raises DriveError, can.CanError."""
        deadline = time.monotonic() + _STATE_S
        controlword, status = 0, "no state: it sends no TPDO"
        while True:
            statusword = self.cycle(controlword)
            if statusword is not None:
                state, status = state_of(statusword), status_text(statusword)
                if state in (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT):
                    return
                controlword = controlword_down(state)
            if time.monotonic() >= deadline:
                raise self._stuck(f"the drive stays in {status}, not SWITCH ON DISABLED")

    def _stuck(self, what: str) -> DriveError:
        emergencies = self._node.emergencies
        emcy = f"; EMCY {emergencies[-1].code:#06x}" if emergencies else ""
        return DriveError(f"node {self._node.node_id}: {what}{emcy}")


def _message(can_id: int, data: bytes, remote: bool = False) -> can.Message:
    return can.Message(
        arbitration_id=can_id,
        data=data,
        is_extended_id=False,
        is_remote_frame=remote,
        dlc=1 if remote else None,
    )
