"""Receive PDOs (CiA 301, 7.5.2.35 and 7.5.2.36)."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled, data_to_number, number_to_data
from canwall.simdrive.communication.abort import AccessError
from canwall.simdrive.communication.dictionary import Dictionary, Key
from canwall.simdrive.communication.emcy import (
    PDO_TOO_LONG,
    PDO_TOO_SHORT,
    RPDO_TIMEOUT,
    EmergencyProducer,
)
from canwall.simdrive.communication.frame import NS_PER_MS
from canwall.simdrive.communication.pdo import MAPPING_OFFSET, MAX_BYTES, Pdo
from canwall.simdrive.state import NEVER, DriveRecord

_EVENT_TIMER = 5


@compiled
def restart_event_timer(drives: NDArray[np.void], number: int) -> None:
    """Begin the time anew in which an RPDO has to come again (0x1400:05)."""
    drive: Record = drives[0]
    pdo = drive.rpdos[number]
    if pdo.event_ns:
        pdo.deadline_ns = drive.now_ns + pdo.event_ns


@compiled
def keep_until_sync(drives: NDArray[np.void], number: int, data: int) -> None:
    """Keep the data of a synchronous RPDO for the next SYNC, unless the window is over."""
    drive: Record = drives[0]
    if drive.now_ns <= drive.sync_window_end_ns:
        pdo = drive.rpdos[number]
        pdo.data = data
        pdo.pending = True


class Rpdo(Pdo):
    """One receive PDO: taken on reception (254, 255), or by the next SYNC (0 to 240).

    A synchronous one that comes after the window of 0x1007 is dropped.
    The event timer is a deadline, watched from the first reception on (0x1400:05).
    """

    transmit = False
    communication = range(0x1400, 0x1600)

    def __init__(
        self,
        dictionary: Dictionary,
        index: int,
        state: DriveRecord,
        emcy: EmergencyProducer,
        changed: Callable[[], None],
        timed_out: Callable[[int, Key], None],
    ) -> None:
        """Serve the communication parameter ``index`` and its mapping.

        Args:
            dictionary: has the entries.
            index: of the communication parameter.
            state: of the drive.
            emcy: reports PDOs that are too short or too long, and the end of a time-out.
            changed: called when the PDO became active or inactive, or moved.
            timed_out: called with error code and (index, sub-index) when the deadline passes.

        Raises:
            DictionaryError: as Pdo.
        """
        self._emcy = emcy
        self._timed_out = timed_out
        self._length_source = (index + MAPPING_OFFSET, 0)
        self._timer_source = (index, _EVENT_TIMER)
        super().__init__(dictionary, index, state, changed)

    @property
    def steady(self) -> bool:
        """True if `steady.take` may take it, as it waits for SYNC and accepts every value."""
        unlimited = all(entry.low is None and entry.high is None for entry in self._entries)
        return self.synchronous and self.in_state and unlimited

    def configure(self) -> None:
        """Compile the mapping and drop what was received."""
        super().configure()
        self._writes = [entry.write for entry in self._entries]
        self._pdo.event_ns = self._event_time.value * NS_PER_MS
        self._emcy.gone(RPDO_TIMEOUT, self._timer_source)
        self.stop()

    def stop(self) -> None:
        """Drop received data, so that it does not take effect on a return to OPERATIONAL."""
        self._pdo.pending = False
        self._pdo.deadline_ns = NEVER

    def receive(self, data: bytes) -> None:
        """Take a frame; one that is too long is reported, and its first bytes count."""
        if len(data) < self._struct.size:
            self._emcy.occurred(PDO_TOO_SHORT, self._length_source)
            return
        if len(data) > self._struct.size:
            self._emcy.occurred(PDO_TOO_LONG, self._length_source)
        else:
            self._emcy.gone(PDO_TOO_LONG, self._length_source)
        if self._emcy.present:
            self._emcy.gone(PDO_TOO_SHORT, self._length_source)
            self._emcy.gone(RPDO_TIMEOUT, self._timer_source)
        restart_event_timer(self._record, self.number)
        if self.synchronous:
            keep_until_sync(self._record, self.number, data_to_number(data))
        else:
            self._apply(data)

    def sync(self) -> None:
        """Let the last frame since the SYNC before take effect."""
        pdo = self._pdo
        if pdo.pending:
            pdo.pending = False
            self._apply(number_to_data(pdo.data, MAX_BYTES))

    def tick(self) -> None:
        """Report a deadline that has passed, once."""
        if self._state.now_ns >= self._pdo.deadline_ns:
            self._pdo.deadline_ns = NEVER
            self._timed_out(RPDO_TIMEOUT, self._timer_source)

    def _apply(self, data: bytes) -> None:
        for write, value in zip(self._writes, self._struct.unpack_from(data), strict=True):
            try:
                write(value)
            except AccessError:
                # There is no one to abort to: the object keeps its value.
                continue
