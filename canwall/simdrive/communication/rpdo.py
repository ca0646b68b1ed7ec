"""Receive PDOs (CiA 301, 7.5.2.35 and 7.5.2.36)."""

from collections.abc import Callable

from canwall.simdrive.communication.abort import AccessError
from canwall.simdrive.communication.dictionary import Dictionary, Key
from canwall.simdrive.communication.emcy import PDO_TOO_SHORT, RPDO_TIMEOUT, EmergencyProducer
from canwall.simdrive.communication.frame import NS_PER_MS, Clock
from canwall.simdrive.communication.pdo import Pdo
from canwall.simdrive.communication.sync import SyncConsumer

COMMUNICATION = range(0x1400, 0x1600)
_MAPPING_OFFSET = 0x200
_EVENT_TIMER = 5


class Rpdo(Pdo):
    """One receive PDO: taken at once (254, 255), or by the next SYNC (0 to 240).

    A synchronous one that comes after the window of 0x1007 is dropped.
    The event timer is a deadline, watched from the first reception on (0x1400:05).
    """

    transmit = False

    def __init__(
        self,
        dictionary: Dictionary,
        index: int,
        clock: Clock,
        sync: SyncConsumer,
        emcy: EmergencyProducer,
        changed: Callable[[], None],
        timed_out: Callable[[int, Key], None],
    ) -> None:
        """Serve the communication parameter ``index`` and its mapping.

        Args:
            dictionary: has the entries.
            index: of the communication parameter.
            clock: protocol time.
            sync: knows whether a synchronous PDO has come in time.
            emcy: told of PDOs that are too short, and of the end of a time-out.
            changed: called when the PDO became active or inactive, or moved.
            timed_out: called with error code and (index, sub-index) when the deadline passes.

        Raises:
            DictionaryError: as Pdo.
        """
        self._clock = clock
        self._sync = sync
        self._emcy = emcy
        self._timed_out = timed_out
        self._length_source = (index + _MAPPING_OFFSET, 0)
        self._timer_source = (index, _EVENT_TIMER)
        super().__init__(dictionary, index, index + _MAPPING_OFFSET, changed)

    def configure(self) -> None:
        """Compile the mapping and forget what was received."""
        super().configure()
        self._writes = [entry.write for entry in self._entries]
        self._time_ns = self._event_time.value * NS_PER_MS
        self._emcy.gone(RPDO_TIMEOUT, self._timer_source)
        self.stop()

    def stop(self) -> None:
        """Forget what was received: it is not for a later time in OPERATIONAL."""
        self._pending: bytes | None = None
        self._deadline_ns: int | None = None

    def receive(self, data: bytes) -> None:
        """Take a frame; of one that is too long the first bytes count."""
        if len(data) < self._struct.size:
            self._emcy.occurred(PDO_TOO_SHORT, self._length_source)
            return
        if self._emcy.present:
            self._emcy.gone(PDO_TOO_SHORT, self._length_source)
            self._emcy.gone(RPDO_TIMEOUT, self._timer_source)
        if self._time_ns:
            self._deadline_ns = self._clock.now_ns + self._time_ns
        if self.synchronous:
            if self._sync.in_window:
                self._pending = data
        else:
            self._apply(data)

    def sync(self) -> None:
        """Let the last frame since the SYNC before take effect."""
        if self._pending is not None:
            data, self._pending = self._pending, None
            self._apply(data)

    def tick(self) -> None:
        """Report a deadline that has passed, once."""
        if self._deadline_ns is not None and self._clock.now_ns >= self._deadline_ns:
            self._deadline_ns = None
            self._timed_out(RPDO_TIMEOUT, self._timer_source)

    def _apply(self, data: bytes) -> None:
        for write, value in zip(self._writes, self._struct.unpack_from(data), strict=True):
            try:
                write(value)
            except AccessError:
                # There is no one to abort to: the object keeps its value.
                continue
