"""SYNC consumer (CiA 301, 7.2.5): identifier, counter, communication cycle and window."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from canwall.bus.can_ids import SYNC
from canwall.compiled import Record, compiled
from canwall.simdrive.communication.abort import AbortCode, AccessError
from canwall.simdrive.communication.cob_id import BIT_30, CAN_ID, NOT_VALID, check_can_id
from canwall.simdrive.communication.dictionary import Dictionary, Key
from canwall.simdrive.communication.emcy import SYNC_LENGTH, SYNC_LOST, EmergencyProducer
from canwall.simdrive.communication.frame import NS_PER_US
from canwall.simdrive.state import NEVER, DriveRecord

_COUNTER_OVERFLOW: Key = (0x1019, 0)
_CYCLE_PERIOD: Key = (0x1006, 0)
_OVERFLOW_VALUES = frozenset((0, *range(2, 241)))


@compiled
def begin_cycle(drives: NDArray[np.void]) -> None:
    """Begin the communication cycle and the window of a SYNC that comes now (0x1006, 0x1007)."""
    drive: Record = drives[0]
    if drive.sync_period_ns:
        drive.sync_deadline_ns = drive.now_ns + drive.sync_period_ns * 3 // 2
    if drive.sync_window_ns:
        drive.sync_window_end_ns = drive.now_ns + drive.sync_window_ns


class SyncConsumer:
    """Serves 0x1005, 0x1006, 0x1007 and 0x1019. The drive never produces SYNC.

    With a cycle period (0x1006), SYNC is missed when none has come for one and a half periods
    since the last. With a window (0x1007), what comes later than that after a SYNC is no longer
    for this cycle. With a counter overflow value (0x1019), SYNC has to carry its counter.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        state: DriveRecord,
        emcy: EmergencyProducer,
        changed: Callable[[], None],
        lost: Callable[[int, Key], None],
    ) -> None:
        """Serve the objects of the dictionary.

        Args:
            dictionary: has the entries.
            state: of the drive.
            emcy: reports SYNCs of the wrong length, and SYNCs that are back.
            changed: called when the CAN-ID was written.
            lost: called with error code and (index, sub-index) when SYNC is missed.
        """
        self._record, self._state = state.record, state.fields
        self._emcy = emcy
        self._lost = lost
        self._cob_id = dictionary.number(0x1005, absent=SYNC)
        self._period_us = dictionary.number(*_CYCLE_PERIOD, absent=0)
        self._window_us = dictionary.number(0x1007, absent=0)
        self._overflow = dictionary.number(*_COUNTER_OVERFLOW, absent=0)
        self._cob_id.check = self._check_cob_id
        self._cob_id.react = lambda _: changed()
        self._overflow.check = self._check_overflow
        for entry in (self._period_us, self._window_us, self._overflow):
            entry.react = lambda _: self.reset()
        self.reset()

    @property
    def can_id(self) -> int:
        """CAN-ID of the SYNC."""
        can_id: int = self._cob_id.value & CAN_ID
        return can_id

    @property
    def counted(self) -> bool:
        """True if SYNC has to carry its counter."""
        return bool(self._length)

    def reset(self) -> None:
        """Take the parameters as they stand, and wait for the first SYNC."""
        self._state.sync_period_ns = self._period_us.value * NS_PER_US
        self._state.sync_window_ns = self._window_us.value * NS_PER_US
        self._length = 1 if self._overflow.value else 0
        self._emcy.gone(SYNC_LOST, _CYCLE_PERIOD)
        self._emcy.gone(SYNC_LENGTH, _COUNTER_OVERFLOW)
        self.stop()

    def stop(self) -> None:
        """Wait for the first SYNC again."""
        self.counter = 0
        """Counter of the last SYNC; 0: it carries none."""
        self._state.sync_deadline_ns = self._state.sync_window_end_ns = NEVER

    def receive(self, data: bytes) -> bool:
        """Take a SYNC; return False if it is not of the length that 0x1019 demands."""
        if len(data) != self._length:
            self._emcy.occurred(SYNC_LENGTH, _COUNTER_OVERFLOW)
            return False
        if data:
            self.counter = data[0]
        if self._emcy.present:
            self._emcy.gone(SYNC_LENGTH, _COUNTER_OVERFLOW)
            self._emcy.gone(SYNC_LOST, _CYCLE_PERIOD)
        begin_cycle(self._record)
        return True

    def tick(self) -> None:
        """Report a SYNC that is missed, once."""
        if self._state.now_ns >= self._state.sync_deadline_ns:
            self._state.sync_deadline_ns = NEVER
            self._lost(SYNC_LOST, _CYCLE_PERIOD)

    def _check_cob_id(self, value: int) -> None:
        check_can_id(value & ~NOT_VALID)  # bit 31 has no meaning here
        if value & BIT_30:
            raise AccessError(AbortCode.INVALID_VALUE)

    def _check_overflow(self, value: int) -> None:
        if value not in _OVERFLOW_VALUES:
            raise AccessError(AbortCode.INVALID_VALUE)
        if self._period_us.value:
            raise AccessError(AbortCode.DEVICE_STATE)
